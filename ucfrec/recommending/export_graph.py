"""Graphs of ONNX: the scores of a policy under its rule, and how a module becomes a graph."""

import contextlib
import io
import logging
import tempfile
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError, one_line

GRAPH: Final = "model.onnx"
INPUTS: Final = ("items", "rewards", "steps", "collected", "users", "observations")
"""Inputs: the first fields of `Sessions`, of which `items` are the actions; without the last where
a policy has no observations."""
EXCLUDED: Final = "excluded"
OUTPUTS: Final = ("scores", "top_items", "top_scores")
TOLERANCE: Final = 1e-5
"""Largest difference of a score to torch's, relative to what is added for it: see `require_close`.
"""
_OPSET: Final = 20
_DEFAULT_K: Final = 100
_CHUNK: Final = 2**16
"""Items among which the best are looked for at once."""
_COMPARED: Final = 16
"""Random sessions on which the graph is compared with torch."""
_MOST_EXCLUDED: Final = 0.5
"""Largest share of the items that these exclude."""
_REMEDY: Final = "use --engine torch"


class RuleGraph(nn.Module):
    """Scores of all items for B sessions, see `Scorer.scores`, and the `k` best."""

    def __init__(self, scorer: Scorer, kind: str, k: int | None) -> None:
        """
        Args:
            k: None for 100, or all items if there are fewer.

        Raises:
            InputError: the policy has vector actions, or scores items in a way of its own.
        """
        super().__init__()
        if scorer.states is None:
            raise InputError(
                "this policy's actions are vectors; only policies of items can be exported"
            )
        if not scorer.has_factors:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own, which "
                "cannot be exported; train one that predicts from a sequence, such as ucf, dt or bc"
            )
        items = len(scorer.states.embeddings)
        most = min(items, _CHUNK)
        k = min(_DEFAULT_K, items) if k is None else k
        if not 1 <= k <= most:
            raise InputError(
                f"--k is {k}; the run has {items:,} items: give a whole number from 1 to {most:,}"
            )
        self.scorer, self.k = scorer, k
        self._parts = _modules(scorer)

    def forward(
        self,
        items: Tensor,
        rewards: Tensor,
        steps: Tensor,
        collected: Tensor,
        users: Tensor,
        excluded: Tensor,
        observations: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (B, n_items), the k best items (B, k) and their log-probabilities (B, k).

        Args:
            items: as all but `excluded`, see `Sessions`.
            rewards: see `Sessions`.
            steps: see `Sessions`.
            collected: see `Sessions`.
            users: see `Sessions`.
            excluded: (B, E) int64 items that may not be shown; padded with −1.
            observations: see `Sessions`; None if the policy has none.
        """
        assert self.scorer.states is not None
        n_items = len(self.scorer.states.embeddings)
        places = torch.where(excluded < 0, n_items, excluded)
        nothing = torch.zeros(excluded.shape[0], n_items + 1, dtype=torch.bool)
        left_out = nothing.scatter(1, places, torch.ones_like(places, dtype=torch.bool))[:, :-1]
        sessions = Sessions(items, rewards, steps, collected, users, observations)
        scores = self.scorer.scores(sessions, excluded=left_out, empty=True)
        return scores, *_best(scores, self.k)


def _best(scores: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k best items (B, k), −1 where fewer are left, and their log-probabilities (B, k).

    Exact: the best of all are among the best of each chunk.
    """
    n = scores.shape[1]
    chunks = -(-n // _CHUNK)
    if chunks > 1:
        padded = F.pad(scores, (0, chunks * _CHUNK - n), value=-torch.inf)
        best = padded.view(-1, chunks, _CHUNK).topk(k, dim=-1)
        offsets = torch.arange(0, chunks * _CHUNK, _CHUNK).view(1, -1, 1)
        numbers = (best.indices + offsets).flatten(1)
        values, places = best.values.flatten(1).topk(k, dim=-1)
        items = numbers.gather(1, places)
    else:
        values, items = scores.topk(k, dim=-1)
    left = values > -torch.inf
    highest = torch.where(left[:, :1], values[:, :1], 0.0)
    total = (scores - highest).exp().sum(1, keepdim=True).log() + highest
    return torch.where(left, items, -1), torch.where(left, values - total, -torch.inf)


def draw_sessions(scorer: Scorer, sessions: int, seed: int) -> Sessions:
    """Random sessions of at most twice as many steps as the scorer reads."""
    states, length = scorer.states, scorer.length
    assert states is not None
    rng = np.random.default_rng(seed)
    steps = rng.integers(0, 2 * length + 1, size=sessions)
    inside = np.arange(length) >= length - steps[:, None]
    items = np.where(inside, rng.integers(len(states.embeddings), size=inside.shape), -1)
    rewards = rng.choice([states.reward_low, states.reward_high], size=inside.shape)
    rewards = np.where(inside, rewards, 0.0).astype(np.float32)
    users = rng.integers(-1, max(1, len(states.user_features)), size=sessions)
    observed, observations = scorer.policy.state_mean.shape[0] - states.size, None
    if observed:
        size = (sessions, scorer.policy.config.context, observed)
        observations = torch.from_numpy(rng.normal(size=size).astype(np.float32))
    return Sessions(
        actions=torch.from_numpy(items),
        rewards=torch.from_numpy(rewards),
        steps=torch.from_numpy(steps),
        collected=torch.from_numpy(rewards.sum(1, dtype=np.float64)),
        users=torch.from_numpy(users),
        observations=observations,
    )


def name_inputs(sessions: Sessions) -> dict[str, Tensor]:
    """The inputs of a graph, by name."""
    values = {"items": sessions.actions} | {name: getattr(sessions, name) for name in INPUTS[1:]}
    return {name: value for name, value in values.items() if value is not None}


def run_graph(session: Any, inputs: dict[str, Tensor]) -> list[Array]:
    """All outputs of an `onnxruntime.InferenceSession`."""
    outputs: list[Array] = session.run(
        None, {name: value.contiguous().numpy() for name, value in inputs.items()}
    )
    return outputs


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


def require_close(
    outputs: Iterable[Array], expected: Iterable[Tensor], remedy: str, size: float
) -> float:
    """The largest difference of a graph's numbers to torch's, relative to max(size, |number|).

    Args:
        size: see `measure_magnitude`.

    Raises:
        InputError: it is beyond the tolerance.
    """
    largest = 0.0
    for theirs, tensor in zip(outputs, expected, strict=True):
        ours = tensor.numpy()
        same = np.where(np.isneginf(ours), np.isneginf(theirs), np.isfinite(theirs))
        finite = np.isfinite(ours) & np.isfinite(theirs)
        apart = np.abs(ours[finite] - theirs[finite]) / np.maximum(size, np.abs(ours[finite]))
        largest = max(largest, float(apart.max(initial=0.0)), 0.0 if same.all() else np.inf)
    if not largest <= TOLERANCE:
        raise InputError(
            f"what onnxruntime computes differs from torch's by {largest:.2g}, more than "
            f"{TOLERANCE:g}; {remedy}, and report this"
        )
    return largest


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


def write_graph(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    path: Path,
    names: tuple[list[str], list[str]],
    kind: str,
    remedy: str,
    shapes: dict[str, Any] | None = None,
) -> None:
    """Write a module as an ONNX graph with its weights.

    Weights of more than 1.5 GB lie beside it, in a file with `.data` appended to its name: the file
    of a graph ends at 2 GB.

    Args:
        module: in evaluation mode.
        names: of the inputs and of the outputs.
        remedy: what to do where it cannot be exported.
        shapes: sizes that may vary; None for those of the example alone.

    Raises:
        InputError: torch cannot export it.
    """
    try:
        with _quiet(), torch.no_grad():
            # What is computed once must not be a part of the graph.
            module(*arguments)
            torch.onnx.export(
                module,
                arguments,
                path,
                input_names=names[0],
                output_names=names[1],
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
            f"torch cannot export policies of kind {kind!r} ({reason:.160}); {remedy}"
        ) from None


@contextlib.contextmanager
def _quiet() -> Any:
    """Keep the exporter from printing."""
    level = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)


class ScoreGraph:
    """`Scorer.scores` of one session, by onnxruntime and one thread."""

    def __init__(self, scorer: Scorer, kind: str) -> None:
        """
        Args:
            scorer: of a policy; its weights must not change afterwards.

        Raises:
            InputError: the extra `export` is not installed, the policy scores items in a way of its
                own or cannot be exported, or what the graph gives differs from torch's.
        """
        require_installed()
        if not scorer.has_factors:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own, which onnxruntime "
                f"cannot compute; {_REMEDY}"
            )
        import onnxruntime

        session, excluded = _example(scorer, seed=0)
        example = {**name_inputs(session), EXCLUDED: excluded}
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / GRAPH
            network, names = _Network(scorer).eval(), ([*example], ["scores"])
            write_graph(network, tuple(example.values()), path, names, kind, _REMEDY)
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        size = measure_magnitude(scorer)
        for number in range(1, 1 + _COMPARED):
            session, excluded = _example(scorer, seed=number)
            expected = scorer.scores(session, excluded=excluded, empty=True)
            require_close([self(session, excluded).numpy()], [expected], _REMEDY, size)

    def __call__(self, session: Sessions, excluded: Tensor) -> Tensor:
        """Scores (1, n_items) of one session, of which `excluded` (1, n_items) bool may not be
        shown."""
        inputs = {**name_inputs(session), EXCLUDED: excluded}
        return torch.from_numpy(run_graph(self._session, inputs)[0])


def _example(scorer: Scorer, seed: int) -> tuple[Sessions, Tensor]:
    """A random session, and items that may not be shown."""
    assert scorer.states is not None
    rng, items = np.random.default_rng(seed), len(scorer.states.embeddings)
    excluded = rng.random((1, items)) < rng.uniform(0, _MOST_EXCLUDED)
    return draw_sessions(scorer, 1, seed), torch.from_numpy(excluded)


def _modules(scorer: Scorer) -> nn.ModuleList:
    models = (scorer.policy, scorer.reward_model)
    return nn.ModuleList(model for model in models if model is not None)


class _Network(nn.Module):
    """The scores of one session as a module."""

    def __init__(self, scorer: Scorer) -> None:
        super().__init__()
        self._scorer, self._parts = scorer, _modules(scorer)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Scores; the inputs are the fields of `Sessions`, and last what may not be shown."""
        *session, excluded = inputs
        return self._scorer.scores(Sessions(*session), excluded=excluded, empty=True)
