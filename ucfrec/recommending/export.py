"""Write a trained policy under its rule as an ONNX graph that other runtimes can run."""

import contextlib
import io
import logging
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec import __version__
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.recommending.export_graph import INPUTS, OUTPUTS, RuleGraph
from ucfrec.runs.trained_policy import TrainedPolicy

GRAPH: Final = "model.onnx"
DESCRIPTION: Final = "model.json"
TOLERANCE: Final = 1e-5
"""Largest difference of a score to torch's, relative to the larger of 1 and the score."""
_OPSET: Final = 20
_SESSIONS: Final = 16
"""Random sessions on which the graph is compared with torch."""


@dataclass(frozen=True)
class Exported:
    """What was written."""

    size: int
    """Bytes of the graph and its weights."""
    difference: float
    """Largest difference to torch; see `TOLERANCE`."""


def export(
    trained: TrainedPolicy, out: Path, *, rule: DecisionRule | None = None, k: int = 100
) -> Exported:
    """Write a folder with the graph (`model.onnx`, its weights beside it) and `model.json`.

    The graph is compared with torch on random sessions before the folder appears.

    Args:
        trained: a policy of items.
        out: folder to make.
        rule: the decision rule; None for the run's own.
        k: items that the graph chooses.

    Raises:
        InputError: the extra `export` is not installed, the policy cannot be exported, the graph's
            scores differ from torch's, or `out` exists.
    """
    require_installed()
    graph = RuleGraph(trained, rule or trained.rule, k).eval()
    arguments = random_sessions(graph, trained, 3, seed=0)
    with atomic_folder(out) as scratch:
        _write(graph, arguments, scratch / GRAPH, trained.name)
        compared = random_sessions(graph, trained, _SESSIONS, seed=1)
        difference = _difference(graph, compared, scratch / GRAPH)
        write_json(scratch / DESCRIPTION, _description(graph, trained, rule or trained.rule))
        size = sum(file.stat().st_size for file in scratch.iterdir() if file.name != DESCRIPTION)
    return Exported(size, difference)


def require_installed() -> None:
    """Check that the extra `export` is installed.

    Raises:
        InputError: it is not.
    """
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(
            f"ONNX needs {error.name}, which is not installed; install ucfrec[export]"
        ) from None


def random_sessions(
    graph: RuleGraph, trained: TrainedPolicy, sessions: int, seed: int
) -> dict[str, Tensor]:
    """Inputs of the graph for random sessions of all lengths, by name."""
    rng = np.random.default_rng(seed)
    states, n = trained.item_states, graph.n_items
    assert states is not None
    steps = rng.integers(0, 2 * graph.length + 1, size=sessions)
    places = np.arange(graph.length) >= graph.length - steps[:, None]
    items = np.where(places, rng.integers(n, size=places.shape), -1)
    rewards = rng.choice([states.reward_low, states.reward_high], size=places.shape)
    rewards = np.where(places, rewards, 0.0).astype(np.float32)
    values: dict[str, Array] = {
        "items": items,
        "rewards": rewards,
        "steps": steps,
        "collected": rewards.sum(1, dtype=np.float64),
        "users": rng.integers(-1, max(1, len(trained.user_ids)), size=sessions),
        "excluded": rng.integers(-1, n, size=(sessions, min(5, n // 2 + 1))),
    }
    if graph.observation_size:
        size = (sessions, graph.context, graph.observation_size)
        values["observations"] = rng.normal(size=size).astype(np.float32)
    return {name: torch.from_numpy(values[name]) for name in INPUTS if name in values}


def _write(graph: RuleGraph, arguments: Mapping[str, Tensor], path: Path, name: str) -> None:
    batch = torch.export.Dim("batch", min=1, max=2**20)
    shapes: dict[str, Any] = {each: {0: batch} for each in arguments}
    shapes["excluded"] = {0: batch, 1: torch.export.Dim("excluded_items", min=1, max=2**24)}
    if graph.observation_size == 0:
        shapes["observations"] = None
    given = tuple(arguments.values())
    if graph.observation_size == 0:
        given = (*given, None)  # type: ignore[arg-type]
    remedy = "use `ucfrec serve` or `recommend --stream`"
    write_graph(graph, given, path, (list(arguments), list(OUTPUTS)), name, remedy, shapes)


def write_graph(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    path: Path,
    names: tuple[list[str], list[str]],
    kind: str,
    remedy: str,
    shapes: dict[str, Any] | None = None,
) -> None:
    """Write a module as an ONNX graph, its weights beside it.

    Args:
        module: in evaluation mode.
        arguments: an example.
        path: file to write.
        names: of the inputs and of the outputs.
        kind: of the policy, for messages.
        remedy: what to do where it cannot be exported.
        shapes: sizes that may vary; None for those of the example alone.

    Raises:
        InputError: torch cannot export it.
    """
    try:
        with _quiet(), torch.no_grad():
            torch.onnx.export(
                module,
                arguments,
                path,
                input_names=names[0],
                output_names=names[1],
                dynamic_shapes=shapes,
                opset_version=_OPSET,
                dynamo=True,
                external_data=True,
                verbose=False,
            )
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:  # torch's exporter has no class of errors of its own for all of them
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"torch cannot export policies of kind {kind!r} ({reason[0]:.160}); {remedy}"
        ) from None


@contextlib.contextmanager
def _quiet() -> Any:
    """Keep the exporter from printing."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _difference(graph: RuleGraph, arguments: Mapping[str, Tensor], path: Path) -> float:
    """Largest difference of the graph's scores to torch's, relative to max(1, |score|).

    Raises:
        InputError: it is beyond the tolerance.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(list(OUTPUTS), {name: each.numpy() for name, each in arguments.items()})
    with torch.no_grad():
        expected = [each.numpy() for each in graph(*arguments.values())]
    largest = 0.0
    for name, ours, theirs in zip(OUTPUTS, expected, found, strict=True):
        if name == "top_items":
            continue
        same = np.where(np.isneginf(ours), np.isneginf(theirs), np.isfinite(theirs))
        finite = np.isfinite(ours) & np.isfinite(theirs)
        apart = np.abs(ours[finite] - theirs[finite]) / np.maximum(1.0, np.abs(ours[finite]))
        largest = max(largest, float(apart.max(initial=0.0)), 0.0 if same.all() else np.inf)
    if not largest <= TOLERANCE:
        raise InputError(
            f"the graph's scores differ from torch's by {largest:.2g}, more than {TOLERANCE:g}; "
            "use `ucfrec serve`, and report this"
        )
    return largest


def _description(graph: RuleGraph, trained: TrainedPolicy, rule: DecisionRule) -> dict[str, Any]:
    """What a program needs to know to use the graph."""
    b, length, k = "batch", graph.length, graph.k
    inputs = [
        _entry(
            "items",
            "int64",
            [b, length],
            "index of each item shown in the session, the latest last; -1 before the session began",
        ),
        _entry("rewards", "float32", [b, length], "reward of each; 0 before the session began"),
        _entry("steps", "int64", [b], "number of items that the session has shown"),
        _entry("collected", "float64", [b], "sum of the rewards of the session"),
        _entry("users", "int64", [b], "index of the user in user_ids; -1 for others"),
        _entry(
            "excluded",
            "int64",
            [b, "excluded_items"],
            "items that may not be shown, e.g. those "
            "already seen; padded with -1, at least one column",
        ),
    ]
    if graph.observation_size:
        inputs.append(
            _entry(
                "observations",
                "float32",
                [b, graph.context, graph.observation_size],
                "of the "
                "last steps, the one to decide included; `ucfrec recommend` repeats the last",
            )
        )
    outputs = [
        _entry(
            "scores",
            "float32",
            [b, graph.n_items],
            "log-probability of the policy plus the "
            "reward weight, up to a constant; -inf for items left out",
        ),
        _entry("top_items", "int64", [b, k], "index of the best items; -1 if fewer are left"),
        _entry("top_scores", "float32", [b, k], "their log-probabilities at temperature 1, nats"),
    ]
    assert trained.item_ids is not None
    return {
        "format": 1,
        "ucfrec": __version__,
        "graph": GRAPH,
        "inputs": inputs,
        "outputs": outputs,
        "rule": rule.as_dict(),
        "rule_hash": rule.hash,
        "rule_notes": "the graph applies target, floor, reward_weight, tag_window and tag_run; "
        "with exclude_seen, put the session's items into `excluded`; with a temperature, draw from "
        "`scores`",
        "policy": trained.name,
        "reward": trained.record.reward,
        "session_by": trained.record.session_by,
        "session_gap_ms": trained.record.session_gap_ms,
        "fingerprint": trained.record.fingerprint,
        "item_ids": trained.item_ids.tolist(),
        "user_ids": trained.user_ids.tolist(),
    }


def _entry(name: str, dtype: str, shape: list[int | str], meaning: str) -> dict[str, Any]:
    return {"name": name, "dtype": dtype, "shape": shape, "meaning": meaning}
