"""Write a trained policy under its rule as an ONNX graph that other runtimes can run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ucfrec import __version__
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.recommending.export_graph import (
    EXCLUDED,
    GRAPH,
    INPUTS,
    OUTPUTS,
    RuleGraph,
    draw_sessions,
    measure_magnitude,
    name_inputs,
    require_close,
    require_installed,
    run_graph,
    write_graph,
)
from ucfrec.runs.trained_policy import TrainedPolicy

DESCRIPTION: Final = "model.json"
_SESSIONS: Final = 16
"""Random sessions on which the graph is compared with torch."""
_REMEDY: Final = "use `ucfrec serve` or `recommend --stream`"


@dataclass(frozen=True)
class Exported:
    """What was written."""

    size: int
    """Bytes of the graph and its weights."""
    difference: float
    """Largest difference to torch; see `TOLERANCE`."""


def export(
    trained: TrainedPolicy, out: Path, *, rule: DecisionRule | None = None, k: int | None = None
) -> Exported:
    """Write a folder with the graph (`model.onnx`, see `write_graph`) and `model.json`.

    The graph is compared with torch on random sessions, several and one, before the folder appears.

    Args:
        rule: the decision rule; None for the run's own.

    Raises:
        InputError: the extra `export` is not installed, the policy cannot be exported, the graph's
            scores differ from torch's, or `out` exists.
    """
    require_installed()
    graph = RuleGraph(trained.scorer(rule), trained.name, k).eval()
    with atomic_folder(out) as scratch:
        _write(graph, scratch / GRAPH, trained.name)
        difference = max(_measure_difference(graph, scratch / GRAPH, n) for n in (_SESSIONS, 1))
        sizes = {file.name: file.stat().st_size for file in sorted(scratch.iterdir())}
        description = _describe_graph(graph, trained) | {"files": list(sizes)}
        write_json(scratch / DESCRIPTION, description)
    return Exported(sum(sizes.values()), difference)


def _draw_arguments(graph: RuleGraph, sessions: int, seed: int) -> dict[str, Tensor]:
    """Random inputs of the graph, in the order of its arguments."""
    states = graph.scorer.states
    assert states is not None
    n, rng = len(states.embeddings), np.random.default_rng(seed)
    values = name_inputs(draw_sessions(graph.scorer, sessions, seed))
    left_out = rng.integers(-1, n, size=(sessions, min(5, n // 2 + 1)))
    values[EXCLUDED] = torch.from_numpy(left_out)
    names = (*INPUTS[:-1], EXCLUDED, INPUTS[-1])
    return {name: values[name] for name in names if name in values}


def _write(graph: RuleGraph, path: Path, kind: str) -> None:
    arguments = _draw_arguments(graph, 3, seed=0)
    batch = torch.export.Dim("batch", min=1, max=2**20)
    shapes: dict[str, Any] = {name: {0: batch} for name in arguments}
    shapes[EXCLUDED] = {0: batch, 1: torch.export.Dim("excluded_items", min=1, max=2**24)}
    inputs: tuple[Any, ...] = tuple(arguments.values())
    if INPUTS[-1] not in arguments:
        shapes[INPUTS[-1]] = None
        inputs = (*inputs, None)
    write_graph(graph, inputs, path, (list(arguments), list(OUTPUTS)), kind, _REMEDY, shapes)


def _measure_difference(graph: RuleGraph, path: Path, sessions: int) -> float:
    """Largest difference of the graph's scores to torch's; see `require_close`."""
    import onnxruntime

    arguments = _draw_arguments(graph, sessions, seed=sessions)
    runner = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    scores, _, top_scores = run_graph(runner, arguments)
    with torch.no_grad():
        expected, _, top_expected = graph(*arguments.values())
    size = measure_magnitude(graph.scorer)
    return require_close((scores, top_scores), (expected, top_expected), _REMEDY, size)


def _describe_graph(graph: RuleGraph, trained: TrainedPolicy) -> dict[str, Any]:
    """What a program needs to know to use the graph."""
    rule, record = graph.scorer.rule, trained.record
    return {
        "format": 1,
        "ucfrec": __version__,
        "graph": GRAPH,
        "inputs": _describe_inputs(graph.scorer, record.observation_size),
        "outputs": _describe_outputs(len(trained.items), graph.k),
        "rule": rule.as_dict(),
        "rule_hash": rule.hash,
        "rule_notes": "the graph applies target, minimum_target, policy_weight, reward_weight, "
        "lookahead, tag_window and tag_run; with exclude_seen, put the session's items into "
        "`excluded`; with a temperature, draw from `scores` divided by it, with top_k among so "
        "many best; with explore, draw that share of the requests uniformly, with explore_top "
        "among so many best",
        "policy": trained.name,
        "reward": record.reward,
        "session_by": record.session_by,
        "session_gap_ms": record.session_gap_ms,
        **({"dropped_observations": [*trained.dropped]} if trained.dropped else {}),
        "fingerprint": record.fingerprint,
        "item_ids": trained.items.ids.tolist(),
        "user_ids": trained.user_ids.tolist(),
    }


def _describe_inputs(scorer: Scorer, observed: int) -> list[dict[str, Any]]:
    b, length = "batch", scorer.length
    items = "index of each item shown in the session, the latest last; -1 before the session began"
    excluded = (
        "items that may not be shown, e.g. those already seen; padded with -1, at least one column"
    )
    inputs = [
        _describe("items", "int64", [b, length], items),
        _describe("rewards", "float32", [b, length], "reward of each; 0 before the session began"),
        _describe("steps", "int64", [b], "number of items that the session has shown"),
        _describe("collected", "float64", [b], "sum of the rewards of the session"),
        _describe("users", "int64", [b], "index of the user in user_ids; -1 for others"),
        _describe("excluded", "int64", [b, "excluded_items"], excluded),
    ]
    if observed:
        shape: list[int | str] = [b, scorer.policy.config.context, observed]
        last = "of the last steps, the one to decide included; `ucfrec recommend` repeats the last"
        inputs.append(_describe("observations", "float32", shape, last))
    return inputs


def _describe_outputs(items: int, k: int) -> list[dict[str, Any]]:
    b = "batch"
    scores = (
        "policy_weight times the policy's log-probability plus reward_weight times what the reward "
        "model says, with a lookahead also of what follows, up to a constant; -inf for items that "
        "`excluded`, tag_window or tag_run leave out"
    )
    return [
        _describe("scores", "float32", [b, items], scores),
        _describe("top_items", "int64", [b, k], "index of the best items; -1 if fewer are left"),
        _describe(
            "top_scores", "float32", [b, k], "their log-probabilities at temperature 1, nats"
        ),
    ]


def _describe(name: str, dtype: str, shape: list[int | str], meaning: str) -> dict[str, Any]:
    return {"name": name, "dtype": dtype, "shape": shape, "meaning": meaning}
