"""The scores of a trained policy under its rule, run by onnxruntime for one user at a time.

A request is some hundreds of small operations, and calling each costs PyTorch more than its
arithmetic. Of a batch of requests, PyTorch computes them together.
"""

import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.acting.scorer import Scorer
from ucfrec.acting.sessions import Sessions
from ucfrec.errors import InputError
from ucfrec.recommending.export_graph import (
    EXCLUDED,
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
_MOST_EXCLUDED: Final = 0.5
"""Largest share of the items that these exclude."""
_REMEDY: Final = "use --engine torch"


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
        example = {**inputs_of(session), EXCLUDED: excluded}
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / GRAPH
            network, names = _Network(scorer).eval(), ([*example], ["scores"])
            write_graph(network, tuple(example.values()), path, names, kind, _REMEDY)
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        for number in range(1, 1 + _COMPARED):
            session, excluded = _example(scorer, seed=number)
            expected = scorer.scores(session, excluded=excluded, empty=True)
            require_close([self(session, excluded).numpy()], [expected], _REMEDY)

    def __call__(self, session: Sessions, excluded: Tensor) -> Tensor:
        """Scores (1, n_items) of one session, of which `excluded` (1, n_items) bool may not be
        shown."""
        inputs = {**inputs_of(session), EXCLUDED: excluded}
        return torch.from_numpy(run_graph(self._session, inputs)[0])


def _example(scorer: Scorer, seed: int) -> tuple[Sessions, Tensor]:
    """A random session, and items that may not be shown."""
    assert scorer.states is not None
    rng, items = np.random.default_rng(seed), len(scorer.states.embeddings)
    excluded = rng.random((1, items)) < rng.uniform(0, _MOST_EXCLUDED)
    return random_sessions(scorer, 1, seed), torch.from_numpy(excluded)


class _Network(nn.Module):
    """The scores of one session as a module."""

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
        *others: Tensor,
    ) -> Tensor:
        """Scores; the arguments are those of `Sessions`, perhaps its observations, and what may
        not be shown."""
        *observations, excluded = others
        session = Sessions(items, rewards, steps, collected, users, *observations)
        return self._scorer.scores(session, excluded=excluded, empty=True)
