"""A trained policy as an actor: it sees the last K steps, and decides by its rule."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.scorer import Scorer
from ucfrec.acting.sessions import History
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.states import ItemStates, SessionStates
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.heads import ItemHead
from ucfrec.schema import FORBIDDEN, USER_IDS


class PolicyActor:
    """Simulates N episodes at once with one batched forward pass per step (an `Actor` of
    `rollout`).

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
        policy = scorer.policy
        n, k = episodes, policy.config.context
        self._scorer, self._policy = scorer, policy
        self._generator = torch.Generator().manual_seed(seed)
        places = np.arange(observation_size + len(dropped))
        self._observed = torch.from_numpy(np.setdiff1d(places, dropped)[:observation_size])
        self._item_ids = item_ids
        kept = item_states is not None and len(item_states.user_features) > 0
        known = kept and user_ids is not None and user_ids.dtype.kind in "iu"
        self._user_ids = IdLookup(user_ids) if known and user_ids is not None else None
        self._absent = None if item_ids is None else torch.from_numpy(item_ids < 0)
        self._forbidden: Tensor | None = None
        self._sessions = None
        if item_states is not None:
            self._sessions = SessionStates(item_states, n, scorer.reach)
        self._shown: Tensor | None = None
        if isinstance(policy.head, ItemHead) and scorer.rule.exclude_seen:
            self._shown = torch.zeros(n, len(policy.head.bias), dtype=torch.bool)
        self._actions = (
            torch.zeros(n, k, dtype=torch.int64)
            if isinstance(policy.head, ItemHead)
            else torch.zeros(n, k, len(policy.head.scale))
        )
        self._states = torch.zeros(n, k, len(policy.state_mean))
        self._rewards = torch.zeros(n, k)
        self._steps = torch.zeros(n, dtype=torch.int64)
        self._reward_sums = torch.zeros(n, dtype=torch.float64)

    def begin(self, rows: IntArray) -> None:
        """Start a new episode in each of `rows`, (M,) environment indices from 0 to N − 1."""
        self._steps[rows] = 0
        self._reward_sums[rows] = 0.0
        if self._sessions is not None:
            self._sessions.begin(rows)
        if self._shown is not None:
            self._shown[rows] = False

    def keep(self, rows: IntArray) -> None:
        """Forget all episodes but those of `rows`, which become the only environments."""
        if self._sessions is not None:
            self._sessions.keep(rows)
        if self._shown is not None:
            self._shown = self._shown[rows]
        for name in ("_actions", "_states", "_rewards", "_steps", "_reward_sums"):
            setattr(self, name, getattr(self, name)[rows])

    def inform(self, info: Mapping[str, Any]) -> None:
        """Record the users of the next step (`USER_IDS`) and its forbidden items (`FORBIDDEN`).

        Raises:
            InputError: items are forbidden, but the policy's actions are vectors.
        """
        users, known = info.get(USER_IDS), self._user_ids
        if users is not None and self._sessions is not None and known is not None:
            self._sessions.users = torch.from_numpy(known.numbers(users))
        forbidden = info.get(FORBIDDEN)
        self._forbidden = None if forbidden is None else self._in_store(forbidden)

    @torch.no_grad()
    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Choose the actions of the live rows; other rows take the first item that is allowed.

        Args:
            observations: (N, O) with all entries that the policy sees.
            live: (N,) true where the action is used.

        Returns:
            (N, A) vectors and None; or (N,) indices of the environment's items and the
            probabilities (N,) with which they were chosen, 1 in rows that are not live.

        Raises:
            InputError: every item is forbidden in some live row.
        """
        observed = torch.as_tensor(observations, dtype=torch.float32)[:, self._observed]
        states = observed if self._sessions is None else self._sessions.current(observed)
        self._states = _appended(self._states, states)
        self._actions = _appended(self._actions, torch.zeros_like(self._actions[:, 0]))
        self._rewards = _appended(self._rewards, torch.zeros_like(self._rewards[:, 0]))
        rows = torch.from_numpy(np.flatnonzero(live))
        if isinstance(self._policy.head, ItemHead):
            return self._items(rows)
        self._actions[rows, -1] = self._scorer.act(self._history(rows))
        self._actions[torch.from_numpy(~live), -1] = 0.0
        return self._actions[:, -1].numpy(), None

    def _items(self, rows: Tensor) -> tuple[Array, Float32Array]:
        """The environment's items (N,) and their probabilities (N,); live are the `rows`."""
        forbidden = self._left_out()
        chances = torch.ones(len(self._steps))
        # The environment steps rows that are not live too, so they also need an allowed action.
        allowed = None if forbidden is None else (~forbidden).int().argmax(1)
        actions = torch.zeros_like(self._actions[:, -1]) if allowed is None else allowed
        of_rows = None if forbidden is None else forbidden[rows]
        actions[rows], chances[rows] = self._decided(rows, self._history(rows), of_rows)
        self._actions[:, -1] = actions
        if self._shown is not None:
            self._shown[rows, actions[rows]] = True
        played = actions.numpy()
        indices = played if self._item_ids is None else self._item_ids[played]
        return indices, chances.numpy().astype(np.float32)

    def _decided(
        self, rows: Tensor, history: History, excluded: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Items and their probabilities, (M,) each, of the `rows` (M,); see `Scorer.scores`."""
        scores = self._scorer.scores(history, excluded=excluded)
        return self._scorer.rule.choose(scores, self._generator)

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Subtract the rewards (N,) from the returns-to-go and advance by one step.

        `actions`, (N, A) or (N,), is not used: `act` has recorded them.
        """
        latest = torch.from_numpy(rewards)
        if self._sessions is not None:
            self._sessions.record(self._actions[:, -1], latest)
        self._reward_sums += latest
        self._rewards[:, -1] = latest
        self._steps += 1

    def _left_out(self) -> Tensor | None:
        """(N, n_items) items that the environment lacks or forbids, or that were shown; None for
        none."""
        n, n_items = len(self._steps), len(self._policy.head.bias)  # type: ignore[arg-type]
        parts = [] if self._absent is None else [self._absent.expand(n, n_items)]
        parts += [] if self._shown is None else [self._shown]
        if self._forbidden is not None:
            # The extra column n_items absorbs forbidden items that the store lacks.
            forbidden = torch.zeros(n, n_items + 1, dtype=torch.bool)
            parts.append(forbidden.scatter_(1, self._forbidden, True)[:, :-1])
        return torch.stack(parts).any(0) if parts else None

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

    def _history(self, rows: Tensor) -> History:
        """What is known in the `rows` (M,)."""
        k, steps = self._states.shape[1], self._steps[rows]
        users = torch.full_like(steps, -1)
        shown = Shown(users.new_zeros(len(rows), 0), torch.zeros(len(rows), 0))
        if self._sessions is not None:
            users, shown = self._sessions.users[rows], Shown(*self._sessions.shown).at(rows)
            # No policy's outputs depend on how much padding is before a session.
            k = min(k, int(steps.max()) + 1)
        windows = Windows.of(
            steps.unsqueeze(1) + torch.arange(1 - k, 1),
            *(each[rows, -k:] for each in (self._states, self._actions, self._rewards)),
        )
        return History(windows, self._reward_sums[rows], users, shown)


def _appended(history: Tensor, latest: Tensor) -> Tensor:
    """`history` (N, K, …) without its first column, and with `latest` (N, …) as its last."""
    return torch.cat([history[:, 1:], latest.unsqueeze(1)], dim=1)
