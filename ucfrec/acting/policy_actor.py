"""A trained policy as an actor: it sees the last K steps, and decides by its rule."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.policies.heads import ItemHead
from ucfrec.schema import FORBIDDEN, OFFER, USER_IDS


class PolicyActor:
    """Simulates N episodes at once with one forward pass per step (an `Actor` of `rollout`).

    Vector actions are taken as predicted. Items are chosen by the decision rule among those that
    the environment has and allows. Users who are in the training logs keep their logged features.
    """

    def __init__(
        self,
        scorer: Scorer,
        episodes: int,
        observation_size: int,
        item_states: ItemStates | None = None,
        item_ids: IntArray | None = None,
        user_ids: Array | None = None,
        seed: int = 0,
        dropped: Sequence[int] = (),
    ) -> None:
        """
        Args:
            episodes: N, number of episodes simulated in parallel.
            observation_size: leading entries of the environment's observation that the logs
                contain, less those in `dropped`; 0 ignores the observation.
            item_states: builds states from items; None if the observation is the state.
            item_ids: (n_items,) the environment's index of each item of the store, −1 for items
                that it lacks; None for vector actions.
            user_ids: (n_users,) identifiers of the store's users, sorted; None or text if they are
                not the environment's users.
            seed: of the draws of a rule with a temperature.
            dropped: entries before those that the policy does not see.
        """
        policy, head = scorer.policy, scorer.policy.head
        vector_size = 0 if isinstance(head, ItemHead) else len(head.scale)
        self._n_items = len(head.bias) if isinstance(head, ItemHead) else 0
        self._scorer, self._item_states = scorer, item_states
        self._generator = torch.Generator().manual_seed(seed)
        places = np.arange(observation_size + len(dropped))
        self._observed = torch.from_numpy(np.setdiff1d(places, dropped)[:observation_size])
        self._item_ids = item_ids
        self._user_ids: IdLookup | None = None
        has_users = item_states is not None and len(item_states.user_features) > 0
        if has_users and user_ids is not None and user_ids.dtype.kind in "iu":
            self._user_ids = IdLookup(user_ids)
        self._absent = None if item_ids is None else torch.from_numpy(item_ids < 0)
        self._forbidden: Tensor | None = None
        length = max(policy.config.context - 1, 1)
        if item_states is not None:
            length = max(length, item_states.window, scorer.reach)
        sessions = Sessions.begun(episodes, length, vector_size)
        states = torch.zeros(episodes, policy.config.context, len(policy.state_mean))
        self._sessions = replace(sessions, states=states)
        self._actions = sessions.actions[:, -1]
        """(N,) or (N, A), those of the step."""
        self._shown: Tensor | None = None
        if self._n_items and scorer.rule.exclude_seen:
            self._shown = torch.zeros(episodes, self._n_items, dtype=torch.bool)

    def begin(self, rows: IntArray) -> None:
        """Start a new episode in each of `rows`, (M,) environment indices from 0 to N − 1."""
        self._sessions.begin(rows)
        if self._shown is not None:
            self._shown[rows] = False

    def keep(self, rows: IntArray) -> None:
        """Forget all episodes but those of `rows`, which become the only environments."""
        self._sessions = self._sessions.at(rows)
        if self._shown is not None:
            self._shown = self._shown[rows]

    def inform(self, info: Mapping[str, Any]) -> None:
        """Record the users of the next step (`USER_IDS`), its forbidden items (`FORBIDDEN`) and
        what is on offer (`OFFER`). InputError if items are forbidden, but the policy's actions are
        vectors."""
        users, lookup, ids = info.get(USER_IDS), self._user_ids, self._item_ids
        if users is not None and lookup is not None:
            numbers = torch.from_numpy(lookup.numbers(users))
            self._sessions = replace(self._sessions, users=numbers)
        self._sessions = replace(self._sessions, offer=info.get(OFFER))
        self._forbidden, forbidden = None, info.get(FORBIDDEN)
        if forbidden is None:
            return
        if ids is None:
            raise InputError(
                "the environment forbids items, but the policy's actions are vectors; use a policy "
                "trained on items"
            )
        # The store's index of each item; that of items it lacks, and of the padding −1, which reads
        # the last entry, is n_items.
        indices = np.full(max(forbidden.max(), ids.max()) + 2, len(ids))
        indices[ids[ids >= 0]] = np.flatnonzero(ids >= 0)
        self._forbidden = torch.from_numpy(indices[forbidden])

    @torch.no_grad()
    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Choose the actions of the live rows; other rows take the first item that is allowed.
        InputError if every item is forbidden in some live row.

        Args:
            observations: (N, O) with all entries that the policy sees.
            live: (N,) true where the action is used.

        Returns:
            (N, A) vectors and None; or (N,) indices of the environment's items and the
            probabilities (N,) with which they were chosen, 1 in rows that are not live.
        """
        observed = torch.as_tensor(observations, dtype=torch.float32)[:, self._observed]
        latest = observed
        if self._item_states is not None:
            latest = self._sessions.latest_states(self._item_states, observed)
        assert self._sessions.states is not None
        states = torch.cat([self._sessions.states[:, 1:], latest.unsqueeze(1)], dim=1)
        self._sessions = replace(self._sessions, states=states)
        rows = torch.from_numpy(np.flatnonzero(live))
        sessions = self._sessions if live.all() else self._sessions.at(rows)
        if not self._n_items:
            self._actions = torch.zeros_like(self._sessions.actions[:, -1])
            self._actions[rows] = self._scorer.act(sessions)
            return self._actions.numpy(), None
        excluded, excluded_in_rows = self._find_excluded(), None
        chances = torch.ones(len(live))
        self._actions = torch.zeros_like(self._sessions.steps)
        if excluded is not None:
            # The environment steps rows that are not live too, so they also need an allowed action.
            self._actions = (~excluded).int().argmax(1)
            excluded_in_rows = excluded[rows]
        self._actions[rows], chances[rows] = self._decide(rows, sessions, excluded_in_rows)
        if self._shown is not None:
            self._shown[rows, self._actions[rows]] = True
        items = self._actions.numpy()
        return items if self._item_ids is None else self._item_ids[items], chances.numpy()

    def _decide(
        self,
        rows: Tensor,
        sessions: Sessions,
        excluded: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Items and their probabilities, (M,) each, of the `rows` (M,); see `Scorer.scores`."""
        scores = self._scorer.scores(sessions, excluded=excluded)
        return self._scorer.rule.choose(scores, self._generator)

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Advance by one step with rewards (N,); `act` has recorded the actions."""
        self._sessions = self._sessions.add_step(self._actions, torch.from_numpy(rewards))

    def _find_excluded(self) -> Tensor | None:
        """(N, n_items) items that the environment lacks or forbids, or that were shown, if any."""
        n, n_items = len(self._sessions.steps), self._n_items
        parts = [] if self._absent is None else [self._absent.expand(n, n_items)]
        parts += [] if self._shown is None else [self._shown]
        if self._forbidden is not None:
            # The extra column n_items absorbs forbidden items that the store lacks.
            forbidden = torch.zeros(n, n_items + 1, dtype=torch.bool)
            parts.append(forbidden.scatter_(1, self._forbidden, True)[:, :-1])
        return torch.stack(parts).any(0) if parts else None
