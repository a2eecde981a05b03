"""Several decision rules of one policy, rolled out side by side."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.decision import Decider
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows
from ucfrec.progress import progress
from ucfrec.schema import USER_IDS
from ucfrec.user_model.simulator import UserSimulator

_ROWS_AT_ONCE: Final = 256
"""Rows of a forward pass, whose logits then stay in the processor's cache."""


def roll_out(
    simulator: UserSimulator,
    deciders: Sequence[Decider],
    sessions: int,
    states: ItemStates,
    observation_size: int,
    seed: int,
) -> tuple[Float64Array, IntArray, IntArray]:
    """Simulate sessions by each of C rules of the same policy of items.

    Args:
        simulator: of C · n sessions that have just begun; those from c · n on follow rule c.
        deciders: C; none leaves out seen items.
        sessions: n, number of sessions of each rule.
        states: builds states from items.
        observation_size: of the simulator's observations.
        seed: of the draws of each rule.

    Returns:
        Returns (C · n,), lengths (C · n,), and the session and item of every step, (M, 2).
    """
    actor = _ManyRules(deciders, sessions, states, observation_size, seed)
    live = np.arange(len(deciders) * sessions)
    returns, lengths = np.zeros(len(live)), np.zeros(len(live), dtype=np.int64)
    shown = list[IntArray]()
    with progress(len(live), "choose the rule", "sessions") as bar:
        while len(live):
            actor.inform({USER_IDS: simulator.users})
            items, _ = actor.act(simulator.observations(), np.ones(len(live), dtype=bool))
            rewards, going = simulator.step(items)
            actor.observe(items, rewards)
            returns[live] += rewards
            lengths[live] += 1
            shown.append(np.stack([live, items], axis=1))
            bar.update(len(live) - len(going))
            if len(going) < len(live):
                live = live[going]
                actor.keep(going)
    return returns, lengths, np.concatenate(shown)


class _ManyRules(PolicyActor):
    """Acts by the rule of each session.

    Every rule has a generator of its own, so that it draws what it would draw alone.
    """

    def __init__(
        self,
        deciders: Sequence[Decider],
        sessions: int,
        states: ItemStates,
        observation_size: int,
        seed: int,
    ) -> None:
        users, rows = np.arange(len(states.user_features)), len(deciders) * sessions
        super().__init__(deciders[0], rows, observation_size, states, None, users, seed)
        self._deciders = deciders
        self._generators = [torch.Generator().manual_seed(seed) for _ in deciders]
        self._rule = np.repeat(np.arange(len(deciders)), sessions)

    def keep(self, rows: IntArray) -> None:
        super().keep(rows)
        self._rule = self._rule[rows]

    def _decided(
        self, rows: Tensor, windows: Windows, collected: Tensor, *given: Any
    ) -> tuple[Tensor, Tensor]:
        decided = []
        for batch in _batches(self._rule[rows.numpy()]):
            asked = [
                self._deciders[rule].asked(_at(windows, part), collected[part])
                for rule, part in batch
            ]
            logits = self._policy.act(_joined(asked).to(self._policy.state_mean.device)).cpu()
            of_rules = torch.split(logits, [len(each.mask) for each in asked])
            for (rule, part), window, values in zip(batch, asked, of_rules, strict=True):
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


def _at(windows: Windows, rows: slice) -> Windows:
    columns = {each.name: getattr(windows, each.name)[rows] for each in fields(windows)}
    return replace(windows, **columns)


def _joined(parts: Sequence[Windows]) -> Windows:
    return Windows(
        *(torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Windows))
    )
