"""Sessions simulated in a user model."""

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.states import SessionStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.model import UserModel


class UserSimulator:
    """N sessions of logged users at once, whose rewards and ends are drawn from a user model.

    A session begins as a logged one did: its user, and its observations step by step. Sessions that
    have ended are dropped: M ≤ N go on.
    """

    def __init__(
        self,
        model: UserModel,
        store: EpisodeStore,
        sessions: int,
        longest: int,
        seed: int,
        times: int = 1,
    ) -> None:
        """
        Args:
            store: view of the sessions that are begun; session i is the i-th modulo their number.
            longest: steps after which a session ends in any case.
            times: how often each session is simulated; N is `times` times `sessions`. Session i
                draws the same numbers as session i modulo `sessions`.
        """
        self._model, self._store, self._longest = model, store, longest
        self._different, self._rng = sessions, np.random.default_rng(seed)
        rewards = (store.step_values(schema.REWARD, *steps) for steps in store.step_batches())
        outcomes = np.unique(np.concatenate([np.unique(each) for each in rewards]))
        self._outcomes = outcomes if len(outcomes) == 2 else None
        n, lags = sessions * times, model.rewarding.lags
        self._numbers, self._steps = np.arange(n) % sessions, np.zeros(n, dtype=np.int64)
        self._episodes = self._numbers % store.n_episodes
        self._shown = Shown(torch.full((n, lags), -1), torch.zeros(n, lags))
        self._states = SessionStates(store.item_states, n)
        self._states.users = torch.full((n,), -1)
        if store.has_users:
            users = store.episode_values(schema.USER).astype(np.int64)
            self._states.users = torch.from_numpy(users[self._episodes])

    @property
    def users(self) -> IntArray:
        """(M,) rows of the store's users, −1 where it does not name them."""
        return self._states.users.numpy()

    def observations(self) -> Float32Array:
        """(M, O) observations before the next step."""
        if not self._store.observation_size:
            return np.zeros((len(self._steps), 0), dtype=np.float32)
        steps = np.minimum(self._steps, self._store.lengths[self._episodes] - 1)
        values = self._store.step_values(schema.OBSERVATION, self._episodes, steps)
        return np.asarray(values, dtype=np.float32)

    def step(self, actions: Array) -> tuple[Float32Array, IntArray]:
        """Show one item in every session.

        Args:
            actions: (M,) items.

        Returns:
            Rewards (M,), and the positions of the sessions that go on, which are the only ones from
            then on.
        """
        items = torch.from_numpy(np.asarray(actions, dtype=np.int64))
        states = self._states.current(torch.from_numpy(self.observations()))
        rewards = self._model.expected(states, self._shown, self._states.users, items)
        if self._outcomes is not None:
            low, high = self._outcomes
            rewards = np.where(self._draws() < (rewards - low) / (high - low), high, low)
        ends = self._model.session_end.probabilities(self._shown, items, rewards, self._steps)
        paid = torch.from_numpy(rewards)
        self._states.record(items, paid)
        latest = Shown(items.unsqueeze(1), paid.float().unsqueeze(1))
        pairs = zip(latest, self._shown, strict=True)
        self._shown = Shown(*(torch.cat([new, old[:, :-1]], 1) for new, old in pairs))
        self._steps += 1
        ended: BoolArray = (self._draws() < ends) | (self._steps >= self._longest)
        going = np.flatnonzero(~ended)
        if len(going) < len(ended):
            self._keep(going)
        return rewards.astype(np.float32), going

    def _draws(self) -> Float64Array:
        """(M,) from [0, 1)."""
        return self._rng.random(self._different)[self._numbers]

    def _keep(self, rows: IntArray) -> None:
        self._states.keep(rows)
        self._shown = self._shown.at(torch.from_numpy(rows))
        for name in ("_steps", "_episodes", "_numbers"):
            setattr(self, name, getattr(self, name)[rows])
