"""Several decision rules of one policy, played side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.scorer import Scorer
from ucfrec.acting.sessions import History
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows

_ROWS_AT_ONCE = 256
"""Rows of a forward pass, whose logits then stay in the processor's cache."""


class ManyRules(PolicyActor):
    """Plays C rules at once: rows c·n to (c + 1)·n − 1 of the C·n environments follow rule c.

    Every rule has a generator of its own, so that it draws what it would draw if it were played
    alone.
    """

    def __init__(
        self,
        scorers: Sequence[Scorer],
        episodes: int,
        observation_size: int,
        item_states: ItemStates,
        user_ids: Array,
        seed: int,
    ) -> None:
        """
        Args:
            scorers: C rules of the same policy of items; none leaves out seen items.
            episodes: n, number of episodes of each rule.
            observation_size: see `PolicyActor`.
            item_states: see `PolicyActor`.
            user_ids: see `PolicyActor`.
            seed: of the draws of each rule.
        """
        rows = len(scorers) * episodes
        super().__init__(scorers[0], rows, observation_size, item_states, None, user_ids, seed)
        self._scorers = scorers
        self._generators = [torch.Generator().manual_seed(seed) for _ in scorers]
        self._rule = np.repeat(np.arange(len(scorers)), episodes)

    def keep(self, rows: IntArray) -> None:
        """Forget all episodes but those of `rows`, which become the only environments."""
        super().keep(rows)
        self._rule = self._rule[rows]

    def _decided(
        self, rows: Tensor, history: History, excluded: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        decided = []
        for rules, ends in self._batches(self._rule[rows.numpy()]):
            parts = [history.at(slice(*pair)) for pair in pairwise(ends)]
            aimed = [
                self._scorers[rule].with_target(part).windows
                for rule, part in zip(rules, parts, strict=True)
            ]
            together = replace(history.at(slice(ends[0], ends[-1])), windows=Windows.joined(aimed))
            weighted = any(self._scorers[rule].rule.reward_weight for rule in rules)
            query = self._scorer.query(together, rewards=weighted)
            for rule, part, (first, last) in zip(rules, parts, pairwise(ends), strict=True):
                scorer = self._scorers[rule]
                scores = scorer.scores_of(
                    query.at(slice(first - ends[0], last - ends[0])),
                    part,
                    excluded=None if excluded is None else excluded[first:last],
                )
                decided.append(scorer.rule.choose(scores, self._generators[rule]))
        items, chances = zip(*decided, strict=True)
        return torch.cat(items), torch.cat(chances)

    @staticmethod
    def _batches(rules: IntArray) -> Iterator[tuple[list[int], list[int]]]:
        """Whole rules of about `_ROWS_AT_ONCE` rows: their numbers, and where their rows end.

        `rules` (M,) are the rows' rules, sorted. Before the ends comes the beginning of the first.
        """
        numbers, first = np.unique(rules, return_index=True)
        batch, ends = list[int](), [0]
        for number, end in zip(numbers.tolist(), [*first[1:].tolist(), len(rules)], strict=True):
            if batch and end - ends[0] > _ROWS_AT_ONCE:
                yield batch, ends
                batch, ends = [], [ends[-1]]
            batch, ends = [*batch, number], [*ends, end]
        yield batch, ends
