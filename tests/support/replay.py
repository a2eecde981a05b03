"""Logged sessions, replayed through an actor: what it would have decided before each step."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.decision import DecisionRule
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.schema import USER_IDS


class Told(DecisionRule):
    """A rule that chooses what it is given, and keeps what it would have chosen."""

    items: Iterator[int]
    thought: list[Tensor]

    @classmethod
    def of(cls, rule: DecisionRule, items: Sequence[int]) -> "Told":
        told = cls(**rule.as_dict())
        object.__setattr__(told, "items", iter(items))
        object.__setattr__(told, "thought", [])
        return told

    def choose(self, scores: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        self.thought.append(self.log_probabilities(scores)[0].exp())
        return torch.tensor([next(self.items)]), torch.ones(1)


def replayed(
    trained: TrainedPolicy,
    rule: DecisionRule,
    items: Sequence[int],
    rewards: Sequence[float],
    user: Any = None,
) -> Tensor:
    """Probabilities (T + 1, n_items) before each of the T steps of a session, and after them, of a
    policy without observations; `items` are indices, and a `user` None is not in the logs."""
    told = Told.of(rule, [*items, 0])
    actor = trained.actor(1, told)
    actor.begin(np.array([0]))
    for reward in [*rewards, 0.0]:
        if user is not None:
            actor.inform({USER_IDS: np.array([user])})
        played, _ = actor.act(np.zeros((1, 0), dtype=np.float32), np.array([True]))
        actor.observe(played, np.array([reward], dtype=np.float32))
    return torch.stack(told.thought)
