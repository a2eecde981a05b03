"""A trained policy as an actor: last K steps, return-to-go lowered by what is earned."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec.acting.rollout import FORBIDDEN, USER_IDS, BoolArray, FloatArray, IntArray
from ucfrec.episodes.returns import remaining_return
from ucfrec.episodes.states import ItemStates, SessionStates
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead


class PolicyActor:
    """Plays N episodes at once with one batched forward pass a step (an `Actor` of `rollout`).

    Vector actions are played as predicted; of items, the one with the highest probability among
    those that the environment has and allows. Users of the logs have their features.
    """

    def __init__(
        self,
        policy: SequencePolicy,
        episodes: int,
        target_return: float,
        observation_size: int,
        item_states: ItemStates | None = None,
        item_ids: IntArray | None = None,
        user_ids: npt.NDArray[Any] | None = None,
    ) -> None:
        """Args:
        policy: in evaluation mode.
        episodes: N, episodes side by side.
        target_return: of every episode.
        observation_size: how many of the environment's observed numbers the logs had; 0 ignores
            the environment's observation.
        item_states: how states are made of items; None where the observation is the state.
        item_ids: (n_items,) the environment's number of each item of the store; −1 where it has
            none.
        user_ids: (n_users,) sorted identifiers in the logs of the store's users; None or text
            where the environment has other users.
        """
        n, k = episodes, policy.config.context
        self._policy, self._target = policy, float(target_return)
        self._observation_size, self._item_ids = observation_size, item_ids
        featured = item_states is not None and item_states.user_features.shape[1] > 0
        known = featured and user_ids is not None and user_ids.dtype.kind in "iu"
        self._user_ids = user_ids if known else None
        self._absent = None if item_ids is None else torch.from_numpy(item_ids < 0)
        self._forbidden: Tensor | None = None
        self._sessions = None if item_states is None else SessionStates(item_states, n)
        self._actions = (
            torch.zeros(n, k, dtype=torch.int64)
            if isinstance(policy.head, ItemHead)
            else torch.zeros(n, k, len(policy.head.scale))
        )
        self._states = torch.zeros(n, k, len(policy.state_mean))
        self._returns_to_go, self._rewards = torch.zeros(2, n, k)
        self._mask = torch.zeros(n, k, dtype=torch.bool)
        self._steps = torch.zeros(n, dtype=torch.int64)
        self._earned = torch.zeros(n, dtype=torch.float64)

    def begin(self, rows: IntArray) -> None:
        """The episodes in `rows` (positions among the N) start afresh."""
        self._mask[rows] = False
        self._steps[rows] = 0
        self._earned[rows] = 0.0
        if self._sessions is not None:
            self._sessions.begin(rows)

    def inform(self, info: Mapping[str, Any]) -> None:
        """Take note of the users of the next step, and of items that may not be played."""
        users, known = info.get(USER_IDS), self._user_ids
        if users is not None and self._sessions is not None and known is not None:
            at = np.minimum(np.searchsorted(known, users), len(known) - 1)
            self._sessions.users = torch.from_numpy(np.where(known[at] == users, at, -1))
        forbidden = info.get(FORBIDDEN)
        self._forbidden = None if forbidden is None else self._in_store(forbidden)

    @torch.no_grad()
    def act(self, observations: FloatArray, live: BoolArray) -> tuple[npt.NDArray[Any], None]:
        """Choose for the live rows; the rest get a zero action.

        Args:
            observations: (N, at least `observation_size`).
            live: (N,) episodes whose action counts.

        Returns:
            (N, A) vectors or (N,) numbers of items in the environment; propensities are unknown.
        """
        observed = torch.as_tensor(observations, dtype=torch.float32)[:, : self._observation_size]
        states = observed if self._sessions is None else self._sessions.current(observed)
        target = torch.full_like(self._earned, self._target)
        self._states = _pushed(self._states, states)
        self._returns_to_go = _pushed(
            self._returns_to_go, remaining_return(target, self._earned).float()
        )
        self._mask = _pushed(self._mask, torch.ones_like(self._mask[:, 0]))
        self._actions = _pushed(self._actions, torch.zeros_like(self._actions[:, 0]))
        self._rewards = _pushed(self._rewards, torch.zeros_like(self._rewards[:, 0]))

        rows = torch.from_numpy(np.flatnonzero(live))
        device = self._policy.state_mean.device
        predicted = self._policy.act(self._windows(rows).to(device)).cpu()
        # Rows that no longer count are played too, and need an allowed action: they keep zeros.
        filled = torch.zeros(len(live), predicted.shape[1])
        filled[rows] = predicted
        actions = self._best(filled) if isinstance(self._policy.head, ItemHead) else filled
        self._actions[:, -1] = actions
        played = actions.numpy()
        return (played if self._item_ids is None else self._item_ids[played]), None

    def observe(self, actions: npt.NDArray[Any], rewards: FloatArray) -> None:
        """Lower the returns-to-go by the rewards (N,) and go on to the next step.

        The actions (N, …) are those that `act` chose; they are on record already.
        """
        earned = torch.from_numpy(rewards)
        if self._sessions is not None:
            self._sessions.record(self._actions[:, -1], earned)
        self._earned += earned
        self._rewards[:, -1] = earned
        self._steps += 1

    def _best(self, scores: Tensor) -> Tensor:
        """Items (N,) with the highest of scores (N, n_items) among those that may be played."""
        if self._absent is not None:
            scores[:, self._absent] = -torch.inf
        if self._forbidden is not None:
            # Column n_items takes what the environment forbids and the store does not have.
            scores = torch.cat([scores, torch.zeros(len(scores), 1)], dim=1)
            scores = scores.scatter(1, self._forbidden, -torch.inf)[:, :-1]
        return scores.argmax(-1)

    def _in_store(self, items: IntArray) -> Tensor:
        """The store's numbers of the environment's items (N, L); n_items where it has none."""
        ids = self._item_ids
        if ids is None:
            raise InputError(
                "an environment that forbids items needs a policy whose actions are items"
            )
        numbers = np.full(max(items.max(), ids.max()) + 2, len(ids))
        numbers[ids[ids >= 0]] = np.flatnonzero(ids >= 0)
        # The last place stands for −1, no item.
        numbers[-1] = len(ids)
        return torch.from_numpy(numbers[items])

    def _windows(self, rows: Tensor) -> Windows:
        mask = self._mask[rows]
        k = mask.shape[1]
        steps = self._steps[rows].unsqueeze(1) + torch.arange(1 - k, 1)
        actions = self._actions[rows]
        keep = mask if actions.ndim == 2 else mask.unsqueeze(-1)
        return Windows(
            states=self._states[rows].masked_fill(~mask.unsqueeze(-1), 0.0),
            actions=actions.masked_fill(~keep, 0),
            rewards=self._rewards[rows].masked_fill(~mask, 0.0),
            returns_to_go=self._returns_to_go[rows].masked_fill(~mask, 0.0),
            timesteps=steps.clamp(min=0),
            mask=mask,
        )


def _pushed(history: Tensor, latest: Tensor) -> Tensor:
    """(N, K, …) without its oldest column and with `latest` (N, …) at the end."""
    return torch.cat([history[:, 1:], latest.unsqueeze(1)], dim=1)
