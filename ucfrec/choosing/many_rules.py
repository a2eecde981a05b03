"""Several decision rules of one policy, played side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.decision import Decider
from ucfrec.acting.policy_actor import PolicyActor
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
        deciders: Sequence[Decider],
        episodes: int,
        observation_size: int,
        item_states: ItemStates,
        user_ids: Array,
        seed: int,
    ) -> None:
        """
        Args:
            deciders: C rules of the same policy of items; none leaves out seen items.
            episodes: n, number of episodes of each rule.
            observation_size: see `PolicyActor`.
            item_states: see `PolicyActor`.
            user_ids: see `PolicyActor`.
            seed: of the draws of each rule.
        """
        rows = len(deciders) * episodes
        super().__init__(deciders[0], rows, observation_size, item_states, None, user_ids, seed)
        self._deciders = deciders
        self._generators = [torch.Generator().manual_seed(seed) for _ in deciders]
        self._rule = np.repeat(np.arange(len(deciders)), episodes)

    def keep(self, rows: IntArray) -> None:
        """Forget all episodes but those of `rows`, which become the only environments."""
        super().keep(rows)
        self._rule = self._rule[rows]

    def _decided(
        self, rows: Tensor, windows: Windows, collected: Tensor, *given: Any
    ) -> tuple[Tensor, Tensor]:
        decided = []
        for rules, ends in self._batches(self._rule[rows.numpy()]):
            parts = [slice(*pair) for pair in pairwise(ends)]
            asked = [
                self._deciders[rule].asked(_at(windows, part), collected[part])
                for rule, part in zip(rules, parts, strict=True)
            ]
            logits = self._policy.act(_joined(asked).to(self._policy.state_mean.device)).cpu()
            of_rules = torch.split(logits, [len(each.mask) for each in asked])
            for rule, part, window, values in zip(rules, parts, asked, of_rules, strict=True):
                decider, (forbidden, users, shown) = self._deciders[rule], given
                scores = decider.scores_from(
                    values,
                    window,
                    None if forbidden is None else forbidden[part],
                    None if users is None else users[part],
                    None if shown is None else shown.at(part),
                )
                decided.append(decider.rule.choose(scores, self._generators[rule]))
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


def _at(windows: Windows, rows: slice) -> Windows:
    columns = {each.name: getattr(windows, each.name)[rows] for each in fields(windows)}
    return replace(windows, **columns)


def _joined(parts: Sequence[Windows]) -> Windows:
    return Windows(
        *(torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Windows))
    )
