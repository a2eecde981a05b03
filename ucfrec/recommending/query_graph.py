"""The network of a policy, run by onnxruntime for one user at a time.

A request is some hundreds of small operations, and calling each costs PyTorch more than its
arithmetic. Of a batch of requests, PyTorch computes them together.
"""

import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.acting.session_scorer import Query, SessionScorer
from ucfrec.acting.sessions import Sessions
from ucfrec.errors import InputError
from ucfrec.recommending.export import GRAPH, TOLERANCE, require_installed, write_graph

_INPUTS: Final = ("items", "rewards", "steps", "collected", "users", "observations")
_COMPARED: Final = 16
"""Random sessions on which the graph is compared with torch."""
_REMEDY: Final = "use --engine torch"


class QueryGraph:
    """`SessionScorer.query` of one session, by onnxruntime and one thread."""

    def __init__(self, scorer: SessionScorer, kind: str) -> None:
        """
        Args:
            scorer: of a policy; its weights must not change afterwards.
            kind: of the policy, for messages.

        Raises:
            InputError: the extra `export` is not installed, the policy scores items in a way of its
                own or cannot be exported, or what the graph gives differs from torch's.
        """
        require_installed()
        if not scorer.has_query:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own, which onnxruntime "
                f"cannot compute; {_REMEDY}"
            )
        import onnxruntime

        rng = np.random.default_rng(0)
        one, *others = (_session(scorer, rng) for _ in range(1 + _COMPARED))
        given = _values(one)
        self._names = _INPUTS[: len(given)]
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / GRAPH
            names = [*self._names], [f"query_{name}" for name in Query._fields]
            write_graph(_Network(scorer).eval(), given, path, names, kind, _REMEDY)
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        self._compare(scorer, others)

    def __call__(self, sessions: Sessions) -> Query:
        """The query of one session."""
        values = zip(self._names, _values(sessions), strict=True)
        given = {name: value.contiguous().numpy() for name, value in values}
        return Query(*map(torch.from_numpy, self._session.run(None, given)))

    def _compare(self, scorer: SessionScorer, sessions: list[Sessions]) -> None:
        """
        Raises:
            InputError: what the graph gives differs from torch's by more than the tolerance.
        """
        for session in sessions:
            for ours, theirs in zip(scorer.query(session), self(session), strict=True):
                apart = (ours - theirs).abs() / ours.abs().clamp(min=1.0)
                # A comparison with NaN is false too.
                if not bool((apart <= TOLERANCE).all()):
                    largest = float(apart.max())
                    raise InputError(
                        f"what onnxruntime computes differs from torch's by {largest:.2g}, more "
                        f"than {TOLERANCE:g}; {_REMEDY}, and report this"
                    )


class _Network(nn.Module):
    """The query of one session as a module."""

    def __init__(self, scorer: SessionScorer) -> None:
        super().__init__()
        self._parts = nn.ModuleList(scorer.modules)
        self._scorer = scorer

    def forward(
        self,
        items: Tensor,
        rewards: Tensor,
        steps: Tensor,
        collected: Tensor,
        users: Tensor,
        observations: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """The parts of `Query`; the arguments are those of `Sessions`."""
        sessions = Sessions(items, rewards, steps, collected, users, observations)
        return tuple(self._scorer.query(sessions))


def _values(sessions: Sessions) -> tuple[Tensor, ...]:
    values = tuple(getattr(sessions, name) for name in _INPUTS)
    return values if values[-1] is not None else values[:-1]


def _session(scorer: SessionScorer, rng: np.random.Generator) -> Sessions:
    """A random session of at most twice as many steps as are read."""
    length, steps = scorer.length, int(rng.integers(2 * scorer.length + 1))
    shown = torch.from_numpy(rng.integers(scorer.n_items, size=(1, length)))
    before = torch.arange(length) < length - steps
    rewards = torch.from_numpy(rng.random((1, length), dtype=np.float32)).masked_fill(before, 0.0)
    observations = None
    if scorer.observation_size:
        size = (1, scorer.context, scorer.observation_size)
        observations = torch.from_numpy(rng.normal(size=size).astype(np.float32))
    return Sessions(
        items=shown.masked_fill(before, -1),
        rewards=rewards,
        steps=torch.tensor([steps]),
        collected=rewards.sum(1, dtype=torch.float64),
        users=torch.from_numpy(rng.integers(-1, scorer.n_users, size=1)),
        observations=observations,
    )
