"""A trained policy as an actor: it sees the last K steps and the remaining target return."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec.acting.rollout import FORBIDDEN, USER_IDS, BoolArray, FloatArray, IntArray
from ucfrec.episodes.states import ItemStates, SessionStates
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead


class PolicyActor:
    """Plays N episodes at once with one batched forward pass per step (an `Actor` of `rollout`).

    Vector actions are played as predicted. Of items, the most probable one that the environment
    has and allows is played. Users who are in the training logs keep their logged features.
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
        """
        Args:
            policy: in evaluation mode.
            episodes: N, number of episodes played in parallel.
            target_return: target return of every episode, in units of the training reward.
            observation_size: leading entries of the environment's observation that the logs
                contain; 0 ignores the observation.
            item_states: builds states from items; None if the observation is the state.
            item_ids: (n_items,) the environment's index of each item of the store, −1 for items
                that it lacks; None for vector actions.
            user_ids: (n_users,) identifiers of the store's users, sorted; None or text if they are
                not the environment's users.
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
        self._reward_sums = torch.zeros(n, dtype=torch.float64)

    def begin(self, rows: IntArray) -> None:
        """Start a new episode in each of `rows`, (M,) environment indices from 0 to N − 1."""
        self._mask[rows] = False
        self._steps[rows] = 0
        self._reward_sums[rows] = 0.0
        if self._sessions is not None:
            self._sessions.begin(rows)

    def inform(self, info: Mapping[str, Any]) -> None:
        """Record the users of the next step (`USER_IDS`) and its forbidden items (`FORBIDDEN`).

        Raises:
            InputError: items are forbidden, but the policy's actions are vectors.
        """
        users, known = info.get(USER_IDS), self._user_ids
        if users is not None and self._sessions is not None and known is not None:
            at = np.minimum(np.searchsorted(known, users), len(known) - 1)
            self._sessions.users = torch.from_numpy(np.where(known[at] == users, at, -1))
        forbidden = info.get(FORBIDDEN)
        self._forbidden = None if forbidden is None else self._in_store(forbidden)

    @torch.no_grad()
    def act(self, observations: FloatArray, live: BoolArray) -> tuple[npt.NDArray[Any], None]:
        """Choose the actions of the live rows; the other rows are scored as zeros.

        Args:
            observations: (N, O) with O at least `observation_size`.
            live: (N,) true where the action is used.

        Returns:
            (N, A) vectors or (N,) indices of the environment's items; and None, because the
            propensities are unknown.
        """
        observed = torch.as_tensor(observations, dtype=torch.float32)[:, : self._observation_size]
        states = observed if self._sessions is None else self._sessions.current(observed)
        target = torch.full_like(self._reward_sums, self._target)
        self._states = _appended(self._states, states)
        self._returns_to_go = _appended(
            self._returns_to_go, (target - self._reward_sums).float()
        )
        self._mask = _appended(self._mask, torch.ones_like(self._mask[:, 0]))
        self._actions = _appended(self._actions, torch.zeros_like(self._actions[:, 0]))
        self._rewards = _appended(self._rewards, torch.zeros_like(self._rewards[:, 0]))

        rows = torch.from_numpy(np.flatnonzero(live))
        device = self._policy.state_mean.device
        predicted = self._policy.act(self._windows(rows).to(device)).cpu()
        # The environment steps rows that are not live too, so they also need an allowed action.
        outputs = torch.zeros(len(live), predicted.shape[1])
        outputs[rows] = predicted
        actions = self._best(outputs) if isinstance(self._policy.head, ItemHead) else outputs
        self._actions[:, -1] = actions
        played = actions.numpy()
        return (played if self._item_ids is None else self._item_ids[played]), None

    def observe(self, actions: npt.NDArray[Any], rewards: FloatArray) -> None:
        """Subtract the rewards (N,) from the returns-to-go and advance by one step.

        `actions`, (N, A) or (N,), is not used: `act` has recorded them.
        """
        latest = torch.from_numpy(rewards)
        if self._sessions is not None:
            self._sessions.record(self._actions[:, -1], latest)
        self._reward_sums += latest
        self._rewards[:, -1] = latest
        self._steps += 1

    def _best(self, scores: Tensor) -> Tensor:
        """Allowed items (N,) with the highest of the scores (N, n_items)."""
        if self._absent is not None:
            scores[:, self._absent] = -torch.inf
        if self._forbidden is not None:
            # The extra column n_items absorbs forbidden items that the store lacks.
            scores = torch.cat([scores, torch.zeros(len(scores), 1)], dim=1)
            scores = scores.scatter(1, self._forbidden, -torch.inf)[:, :-1]
        return scores.argmax(-1)

    def _in_store(self, items: IntArray) -> Tensor:
        """The store's indices of the environment's items (N, L); n_items for items it lacks."""
        ids = self._item_ids
        if ids is None:
            raise InputError(
                "the environment forbids items, but the policy's actions are vectors; use a policy "
                "trained on items"
            )
        numbers = np.full(max(items.max(), ids.max()) + 2, len(ids))
        numbers[ids[ids >= 0]] = np.flatnonzero(ids >= 0)
        # Index −1, the padding of `items`, reads the last entry.
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


def _appended(history: Tensor, latest: Tensor) -> Tensor:
    """`history` (N, K, …) without its first column, and with `latest` (N, …) as its last."""
    return torch.cat([history[:, 1:], latest.unsqueeze(1)], dim=1)
