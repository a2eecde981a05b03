"""A trained policy under its rule as an ONNX graph, for other runtimes and for single requests."""

import io
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec import __version__
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.episodes.offers import Offers
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError, one_line
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.runs.trained_policy import TrainedPolicy

GRAPH = "model.onnx"
DESCRIPTION = "model.json"
OUTPUTS = ("scores", "top_items", "top_scores")
TOLERANCE = 1e-5
"""Largest difference of a score to torch's, relative to what is added for it: see `require_close`.
"""
_STATE = ("items", "rewards", "steps", "collected", "users", "trained_steps", "observations")
"""Inputs: the first fields of `Sessions`, of which `items` are the actions."""
_TIMES, _EXCLUDED = "times", "excluded"
_OPSET = 20
_DEFAULT_K = 100
_COMPARED = 16
"""Random sessions on which a graph is compared with torch."""
_MOST_EXCLUDED = 0.5
"""Largest share of the items that these exclude, where the graph answers single requests."""
_MEANINGS = {
    "items": "index of each item shown in the session, the latest last; -1 before the session "
    "began",
    "rewards": "reward of each; 0 before the session began",
    "steps": "number of items that the session has shown",
    "collected": "sum of the rewards of the session",
    "users": "index of the user in user_ids; -1 for others",
    "trained_steps": "number of the session's items until trained_until (ms); 0 for unknown users",
    _TIMES: "time of the request in ms since 1970: items not available then are left out, and the "
    "reward model counts how old they are",
    _EXCLUDED: "items that may not be shown, e.g. those already seen; padded with -1, at least one "
    "column",
    "observations": "of the last steps, the one to decide included; `ucfrec recommend` repeats the "
    "last",
    "scores": "policy_weight times the policy's log-probability plus reward_weight times what the "
    "reward model says, with a lookahead also of what follows, up to a constant; -inf for items "
    "that `excluded`, tag_window or tag_run leave out",
    "top_items": "index of the best items; -1 if fewer are left",
    "top_scores": "their log-probabilities at temperature 1, nats",
}
_NOTES = (
    "the graph applies target, minimum_target, policy_weight, reward_weight, lookahead, tag_window "
    "and tag_run; put into `excluded` what is not in stock and, with exclude_seen, the session's "
    "items; with a temperature, draw from `scores` divided by it, with top_k among so many best; "
    "with explore, draw that share of the requests uniformly, with explore_top among so many best; "
    "by_marginal_gain changes nothing, as the reward model has no effect of items above others"
)
_SERVE = "use `ucfrec serve` or `recommend --stream`"
_TORCH = "use --engine torch"


class Exported(NamedTuple):
    """What was written."""

    size: int
    """Bytes of the graph and its weights."""
    difference: float
    """Largest difference to torch; see `TOLERANCE`."""


def export(
    trained: TrainedPolicy,
    out: Path,
    *,
    rule: DecisionRule | None = None,
    k: int | None = None,
) -> Exported:
    """Write a folder with the graph (`model.onnx`) and `model.json`.

    The graph is compared with torch on random sessions, several and one, before the folder appears.
    InputError if the extra `export` is not installed, the policy cannot be exported, the graph's
    scores differ from torch's, or `out` exists.

    Args:
        rule: the decision rule; None for the run's own.
        k: number of best items of the output; None for 100, or all items if there are fewer.
    """
    require_installed()
    graph = RuleGraph(trained.item_scorer(rule), trained.name, k).eval()
    graph.offers = trained.offers
    if graph.scorer.list_term is not None:
        raise InputError(
            f"{trained.folder}: the rule builds lists by marginal gain, which a graph cannot; "
            f"{_SERVE}, or export a rule without"
        )
    example = _draw_inputs(graph, 3, seed=0)
    batch = torch.export.Dim("batch", min=1, max=2**20)
    shapes: list[dict[int, Any]] = [{0: batch} for _ in example]
    shapes[-1][1] = torch.export.Dim("excluded_items", min=1, max=2**24)
    with atomic_folder(out) as scratch:
        path, difference = scratch / GRAPH, 0.0
        sizes = {"inputs": tuple(shapes)}
        write_graph(graph, example, path, list(OUTPUTS), trained.name, _SERVE, sizes)
        runner = start_runner(path)
        for sessions in (_COMPARED, 1):
            example = _draw_inputs(graph, sessions, seed=sessions)
            difference = max(difference, _measure_difference(graph, runner, example, _SERVE))
        files = {file.name: file.stat().st_size for file in sorted(scratch.iterdir())}
        with torch.no_grad():
            outputs = dict(zip(OUTPUTS, graph(*example.values()), strict=True))
        description = _describe_graph(graph.scorer, trained, example, outputs)
        write_json(scratch / DESCRIPTION, description | {"files": list(files)})
    return Exported(sum(files.values()), difference)


class _Network(nn.Module):
    """A scorer as a module, with its weights; InputError if the policy has no vectors of items."""

    offers: Offers | None = None

    def __init__(
        self,
        scorer: Scorer,
        kind: str,
        remedy: str,
    ) -> None:
        super().__init__()
        if not scorer.has_factors:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own, which {remedy}"
            )
        models = (scorer.policy, scorer.reward_model)
        self.scorer = scorer
        self._models = nn.ModuleList(model for model in models if model is not None)

    def forward(self, *inputs: Tensor) -> Any:
        """Scores; the inputs are the fields of `Sessions`, times where there are offers, and last
        what may not be shown."""
        *session, excluded = inputs
        offer = None if self.offers is None else self.offers.at(session.pop())
        sessions = replace(Sessions(*session), offer=offer)  # type: ignore[arg-type]
        return (self.scorer.scores(sessions, excluded=excluded, empty=True),)


class RuleGraph(_Network):
    """Scores of all items for B sessions, see `Scorer.scores`, and the `k` best."""

    def __init__(
        self,
        scorer: Scorer,
        kind: str,
        k: int | None,
    ) -> None:
        assert scorer.states is not None
        super().__init__(
            scorer,
            kind,
            "cannot be exported; train one that predicts from a sequence, such as ucf, dt or bc",
        )
        self._items = len(scorer.states.embeddings)
        self._k = min(_DEFAULT_K, self._items) if k is None else k
        if not 1 <= self._k <= self._items:
            raise InputError(
                f"--k is {k}; the run has {self._items:,} items: give a whole number from 1 to "
                f"{self._items:,}"
            )

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (B, n_items), the k best items (B, k) and their log-probabilities (B, k).

        The inputs are those of a network, but last the items excluded (B, E), padded with −1.
        """
        *session, excluded = inputs
        places = torch.where(excluded < 0, self._items, excluded)
        nothing = torch.zeros(excluded.shape[0], self._items + 1, dtype=torch.bool)
        left_out = nothing.scatter(1, places, torch.ones_like(places, dtype=torch.bool))[:, :-1]
        (scores,) = super().forward(*session, left_out)
        return scores, *find_best(scores, self._k)


def find_best(scores: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k best items (B, k), −1 where fewer are left, and their log-probabilities (B, k)."""
    values, items = scores.topk(k, dim=-1)
    left = values > -torch.inf
    highest = torch.where(left[:, :1], values[:, :1], 0.0)
    total = (scores - highest).exp().sum(1, keepdim=True).log() + highest
    return torch.where(left, items, -1), torch.where(left, values - total, -torch.inf)


def compile_scores(scorer: Scorer, kind: str) -> Callable[[Sessions, Tensor], Tensor]:
    """`Scorer.scores` of one session, given what (1, n_items) bool may not be shown, by onnxruntime
    and one thread. InputError if the extra `export` is not installed, the policy scores items in a
    way of its own or cannot be exported, the rule looks ahead over items that come and go, or what
    the graph gives differs from torch's."""
    require_installed()
    model = scorer.reward_model
    if scorer.rule.looks_ahead and model is not None and model.running.any():
        raise InputError(f"a lookahead depends on the time, as items come and go; {_TORCH}")
    network = _Network(scorer, kind, f"onnxruntime cannot compute; {_TORCH}").eval()
    example = _draw_inputs(network, 1, seed=0, mask=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / GRAPH
        write_graph(network, example, path, ["scores"], kind, _TORCH)
        runner = start_runner(path)
    for number in range(1, 1 + _COMPARED):
        example = _draw_inputs(network, 1, seed=number, mask=True)
        _measure_difference(network, runner, example, _TORCH)

    def score(session: Sessions, excluded: Tensor) -> Tensor:
        fields = zip(_STATE, vars(session).values(), strict=False)
        inputs = {name: value for name, value in fields if value is not None}
        return torch.from_numpy(_run_graph(runner, inputs | {_EXCLUDED: excluded})[0])

    return score


def _draw_inputs(
    network: _Network,
    sessions: int,
    seed: int,
    mask: bool = False,
) -> dict[str, Tensor]:
    """Random inputs of a graph, of sessions of at most twice as many steps as the scorer reads; the
    items excluded are numbers, or a `mask` of all items."""
    scorer, rng = network.scorer, np.random.default_rng(seed)
    states, length = scorer.states, scorer.length
    assert states is not None
    n = len(states.embeddings)
    steps = rng.integers(0, 2 * length + 1, size=sessions)
    inside = np.arange(length) >= length - steps[:, None]
    rewards = rng.choice([states.reward_low, states.reward_high], size=inside.shape)
    rewards = np.where(inside, rewards, 0.0).astype(np.float32)
    arrays: dict[str, Array] = {
        "items": np.where(inside, rng.integers(n, size=inside.shape), -1),
        "rewards": rewards,
        "steps": steps,
        "collected": rewards.sum(1, dtype=np.float64),
        "users": rng.integers(-1, max(1, len(states.user_features)), size=sessions),
        "trained_steps": rng.integers(0, steps + 1),
    }
    if observed := scorer.policy.state_mean.shape[0] - states.size:
        size = (sessions, scorer.policy.config.context, observed)
        arrays["observations"] = rng.normal(size=size).astype(np.float32)
    if network.offers is not None:
        bounds = np.append(network.offers.intervals[1:], 0)
        arrays[_TIMES] = rng.choice(bounds[abs(bounds) < ALWAYS[1]], size=sessions)
    if mask:
        arrays[_EXCLUDED] = rng.random((sessions, n)) < rng.uniform(0, _MOST_EXCLUDED)
    else:
        arrays[_EXCLUDED] = rng.integers(-1, n, size=(sessions, min(5, n // 2 + 1)))
    return {name: torch.from_numpy(values) for name, values in arrays.items()}


def start_runner(path: Path) -> Any:
    """An `onnxruntime.InferenceSession` with one thread."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _run_graph(runner: Any, inputs: dict[str, Tensor]) -> list[Array]:
    arrays = {name: value.contiguous().numpy() for name, value in inputs.items()}
    outputs: list[Array] = runner.run(None, arrays)
    return outputs


def _measure_difference(
    network: _Network,
    runner: Any,
    inputs: dict[str, Tensor],
    remedy: str,
) -> float:
    """`require_close` of the scores that a graph and its network give."""
    with torch.no_grad():
        expected = network(*inputs.values())[::2]  # without the numbers of items
    pairs = zip(_run_graph(runner, inputs)[::2], expected, strict=True)
    return require_close(pairs, remedy, measure_magnitude(network.scorer))


def measure_magnitude(scorer: Scorer) -> float:
    """Size of what is added up to a score under the scorer's rule, at least 1.

    A sum is rounded relative to its terms, even if what is left of them is about 0.
    """
    rule, model = scorer.rule, scorer.reward_model
    added = rule.reward_weight
    if rule.looks_ahead and model is not None:
        low, high = float(model.reward_low), float(model.reward_high)
        added *= (max(abs(low), abs(high)) + rule.lookahead) / (high - low)
    return max(1.0, rule.policy_weight, added)


def require_close(pairs: Iterable[tuple[Array, Tensor]], remedy: str, size: float) -> float:
    """The largest difference of a graph's numbers to torch's, relative to max(size, |number|), with
    the size of `measure_magnitude`; InputError beyond the tolerance."""
    largest = 0.0
    for theirs, tensor in pairs:
        ours = tensor.numpy()
        differ = ours != theirs  # −∞ does not differ from itself
        ours, theirs = ours[differ], theirs[differ]
        sizes = np.where(np.isinf(ours), size, abs(ours))
        apart = np.abs(ours - theirs) / np.maximum(size, sizes)
        largest = float(np.maximum(largest, apart.max(initial=0.0)))
    if not largest <= TOLERANCE:
        raise InputError(
            f"what onnxruntime computes differs from torch's by {largest:.2g}, more than "
            f"{TOLERANCE:g}; {remedy}, and report this"
        )
    return largest


def require_installed() -> None:
    """Check that the packages of the extra `export` are there; InputError without one."""
    for name in ("onnx", "onnxruntime", "onnxscript"):
        if find_spec(name) is None:
            raise InputError(f"ONNX needs {name}, which is not installed; install ucfrec[export]")


def write_graph(
    module: nn.Module,
    inputs: dict[str, Tensor],
    path: Path,
    outputs: list[str],
    kind: str,
    remedy: str,
    shapes: dict[str, Any] | None = None,
) -> None:
    """Write a module in evaluation mode as an ONNX graph with its weights.

    Weights of more than 1.5 GB lie beside it, in a file with `.data` appended to its name: the file
    of a graph ends at 2 GB.

    Args:
        inputs: an example of each, by name.
        outputs: their names.
        shapes: sizes that may vary; None for those of the example alone.
    """
    level = logging.root.manager.disable
    try:
        logging.disable(logging.ERROR)
        with (
            warnings.catch_warnings(action="ignore"),
            redirect_stdout(io.StringIO()),
            torch.no_grad(),
        ):
            # What is computed once must not be a part of the graph.
            module(*inputs.values())
            torch.onnx.export(
                module,
                tuple(inputs.values()),
                path,
                input_names=list(inputs),
                output_names=outputs,
                dynamic_shapes=shapes,
                opset_version=_OPSET,
                dynamo=True,
                external_data=False,  # torch still puts more than 1.5 GB of them beside it
                verbose=False,
            )
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:  # torch's exporter has no class of errors of its own for all of them
        # The exporter's own message lists its steps; the reason is that of the error behind it.
        reason = one_line(str(error.__cause__ or error).strip()) or type(error).__name__
        raise InputError(
            f"torch cannot export policies of kind {kind!r} ({reason}); {remedy}"
        ) from None
    finally:
        logging.disable(level)


def _describe_graph(
    scorer: Scorer,
    trained: TrainedPolicy,
    inputs: dict[str, Tensor],
    outputs: dict[str, Tensor],
) -> dict[str, Any]:
    """What a program needs to know to use the graph."""
    rule, record = scorer.rule, trained.record

    def describe(tensors: dict[str, Tensor]) -> list[dict[str, Any]]:
        return [
            {
                "name": name,
                "dtype": str(tensor.dtype).removeprefix("torch."),
                "shape": [
                    "batch",
                    *(["excluded_items"] if name == _EXCLUDED else tensor.shape[1:]),
                ],
                "meaning": _MEANINGS[name],
            }
            for name, tensor in tensors.items()
        ]

    return {
        "format": 1,
        "ucfrec": __version__,
        "graph": GRAPH,
        "inputs": describe(inputs),
        "outputs": describe(outputs),
        "rule": rule.as_dict(),
        "rule_hash": rule.hash,
        "rule_notes": _NOTES,
        "policy": trained.name,
        "reward": record.reward,
        "session_by": record.session_by,
        "session_gap_ms": record.session_gap_ms,
        "trained_until": None if (of := scorer.reward_model) is None else int(of.interests.until),
        "fingerprint": record.fingerprint,
        "item_ids": trained.items.ids.tolist(),
        "user_ids": trained.user_ids.tolist(),
    }
