"""The network of a policy, run by onnxruntime for one user at a time.

A request is some hundreds of small operations, and calling each costs PyTorch more than its
arithmetic. Of a batch of requests, PyTorch computes them together.
"""

import tempfile
from pathlib import Path
from typing import Final

import torch
from torch import Tensor, nn

from ucfrec.acting.item_product import Factors
from ucfrec.acting.scorer import Scorer
from ucfrec.acting.sessions import Sessions
from ucfrec.errors import InputError
from ucfrec.recommending.export_graph import (
    GRAPH,
    inputs_of,
    random_sessions,
    require_close,
    require_installed,
    run_graph,
    write_graph,
)

_COMPARED: Final = 16
"""Random sessions on which the graph is compared with torch."""
_REMEDY: Final = "use --engine torch"


class QueryGraph:
    """`Scorer.factors` of one session, by onnxruntime and one thread."""

    def __init__(self, scorer: Scorer, kind: str) -> None:
        """
        Args:
            scorer: of a policy; its weights must not change afterwards.

        Raises:
            InputError: the extra `export` is not installed, the policy scores items in a way of its
                own or cannot be exported, or what the graph gives differs from torch's.
        """
        require_installed()
        if not scorer.is_product:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own, which onnxruntime "
                f"cannot compute; {_REMEDY}"
            )
        import onnxruntime

        example = inputs_of(random_sessions(scorer, 1, seed=0))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / GRAPH
            names = [*example], [f"of_{name}" for name in Factors._fields]
            write_graph(
                _Network(scorer).eval(), tuple(example.values()), path, names, kind, _REMEDY
            )
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        for number in range(1, 1 + _COMPARED):
            session = random_sessions(scorer, 1, seed=number)
            found = [each.numpy() for each in self(session)]
            require_close(found, scorer.factors(session), _REMEDY)

    def __call__(self, sessions: Sessions) -> Factors:
        """The factors of one session."""
        return Factors(*map(torch.from_numpy, run_graph(self._session, inputs_of(sessions))))


class _Network(nn.Module):
    """The factors of one session as a module."""

    def __init__(self, scorer: Scorer) -> None:
        super().__init__()
        models = (scorer.policy, scorer.reward_model)
        self._parts = nn.ModuleList(each for each in models if each is not None)
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
        """The parts of `Factors`; the arguments are those of `Sessions`."""
        sessions = Sessions(items, rewards, steps, collected, users, observations)
        return tuple(self._scorer.factors(sessions))
