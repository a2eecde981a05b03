"""Several decision rules of one policy, rolled out side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Sessions, Windows
from ucfrec.progress import progress
from ucfrec.schema import USER_IDS
from ucfrec.user_model.simulator import UserSimulator

_ROWS_AT_ONCE: Final = 256
"""Rows of a forward pass, whose logits then stay in the processor's cache."""


@dataclass(frozen=True)
class Outcomes:
    """What happened in n simulated sessions of one rule."""

    returns: Float64Array
    """(n,), in reward units."""
    lengths: IntArray
    """(n,), steps."""
    items: IntArray
    """(M,), all that were shown."""

    def followed_by(self, more: "Outcomes") -> "Outcomes":
        """These sessions and more of the same rule."""
        pairs = zip(vars(self).values(), vars(more).values(), strict=True)
        return Outcomes(*(np.concatenate(pair) for pair in pairs))


def roll_out(
    simulator: UserSimulator,
    scorers: Sequence[Scorer],
    sessions: int,
    states: ItemStates,
    observation_size: int,
    seed: int,
) -> list[Outcomes]:
    """Simulate sessions by each of C rules of the same policy of items.

    Args:
        simulator: of C · n sessions that have just begun; those from c · n on follow rule c.
        scorers: C; none excludes seen items.
        sessions: n, number of sessions of each rule.
        observation_size: of the simulator's observations.
        seed: of the draws of each rule.

    Returns:
        The sessions of each rule.
    """
    actor = _ManyRules(scorers, sessions, states, observation_size, seed)
    live = np.arange(len(scorers) * sessions)
    returns, lengths = np.zeros(len(live)), np.zeros(len(live), dtype=np.int64)
    decisions = list[IntArray]()
    with progress(len(live), "choose the rule", "sessions") as bar:
        while len(live):
            actor.inform({USER_IDS: simulator.users})
            items, _ = actor.act(simulator.observations(), np.ones(len(live), dtype=bool))
            rewards, going = simulator.step(items)
            actor.observe(items, rewards)
            returns[live] += rewards
            lengths[live] += 1
            decisions.append(np.stack([live, items], axis=1))
            bar.update(len(live) - len(going))
            if len(going) < len(live):
                live = live[going]
                actor.keep(going)
    numbers, items = np.concatenate(decisions).T
    parts = (slice(n * sessions, (n + 1) * sessions) for n in range(len(scorers)))
    return [
        Outcomes(returns[part], lengths[part], items[numbers // sessions == rule])
        for rule, part in enumerate(parts)
    ]


class _ManyRules(PolicyActor):
    """Acts by the rule of each session.

    Every rule has a generator of its own, so that it draws what it would draw alone.
    """

    def __init__(
        self,
        scorers: Sequence[Scorer],
        sessions: int,
        states: ItemStates,
        observation_size: int,
        seed: int,
    ) -> None:
        users, rows = np.arange(len(states.user_features)), len(scorers) * sessions
        super().__init__(scorers[0], rows, observation_size, states, None, users, seed)
        self._scorers = scorers
        self._generators = [torch.Generator().manual_seed(seed) for _ in scorers]
        self._rule = np.repeat(np.arange(len(scorers)), sessions)

    def keep(self, rows: IntArray) -> None:
        super().keep(rows)
        self._rule = self._rule[rows]

    def _decide(
        self, rows: Tensor, sessions: Sessions, excluded: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        decisions = []
        for batch in _batches(self._rule[rows.numpy()]):
            windows = [self._scorers[rule].windows(sessions.at(part)) for rule, part in batch]
            begin, end = batch[0][1].start, batch[-1][1].stop
            weighted = any(self._scorers[rule].rule.reward_weight for rule, _ in batch)
            together = sessions.at(slice(begin, end))
            query = self._scorer.query(together, Windows.joined(windows), weighted)
            for rule, part in batch:
                scorer = self._scorers[rule]
                rows_of_rule = slice(part.start - begin, part.stop - begin)
                of_rule = None if excluded is None else excluded[part]
                scores = scorer.scores_of(query.at(rows_of_rule), excluded=of_rule)
                decisions.append(scorer.rule.choose(scores, self._generators[rule]))
        items, chances = zip(*decisions, strict=True)
        return torch.cat(items), torch.cat(chances)


def _batches(rules: IntArray) -> list[list[tuple[int, slice]]]:
    """Whole rules of about `_ROWS_AT_ONCE` rows, and where their rows are.

    Args:
        rules: (M,) the rows' rules, sorted.
    """
    numbers, first = np.unique(rules, return_index=True)
    batches, size = [list[tuple[int, slice]]()], 0
    for rule, begin, end in zip(numbers, first, [*first[1:], len(rules)], strict=True):
        if size and size + end - begin > _ROWS_AT_ONCE:
            batches.append([])
            size = 0
        batches[-1].append((int(rule), slice(int(begin), int(end))))
        size += int(end - begin)
    return batches
