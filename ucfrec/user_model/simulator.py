"""Sessions simulated in a user model."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions
from ucfrec.user_model.model import UserModel

_GROUPS: Final = 32
"""Most rewards to draw from."""
_BEYOND: Final = 3, 100
"""Simulated sessions may have so many times the steps of the longest logged one, but then no more
than so many, …"""
_CHANCE: Final = 0.001
"""… unless chance ends all sessions that get there with a lower probability than this."""


@dataclass(frozen=True)
class LoggedRewards:
    """Rewards to draw: those of a log, weighted by exp(slope · reward) so that their mean is the
    expected reward. Paying the mean itself would be wrong where what follows, as the end of the
    session, is not linear in the reward."""

    values: Float64Array
    """(K,) distinct rewards, or means of `_GROUPS` groups of equal size, from the highest."""
    log_shares: Float64Array
    """(K,) log of their shares of the steps."""
    slopes: Float64Array
    """(G,) ascending, per unit of reward."""
    means: Float64Array
    """(G,) mean reward under each slope."""

    @classmethod
    def of(cls, store: EpisodeStore) -> "LoggedRewards":
        """Those of all steps of a store."""
        parts = [
            np.unique(rewards, return_counts=True)
            for (rewards,) in store.column_batches(schema.REWARD)
        ]
        rewards, place = np.unique(
            np.concatenate([distinct for distinct, _ in parts]), return_inverse=True
        )
        counts = np.bincount(place, np.concatenate([distinct for _, distinct in parts]))
        values, counts = rewards[::-1].astype(np.float64), counts[::-1]
        if len(values) > _GROUPS:
            middle = (counts.cumsum() - counts / 2) / counts.sum()
            groups = np.unique((_GROUPS * middle).astype(int), return_inverse=True)[1]
            sums, counts = np.bincount(groups, counts * values), np.bincount(groups, counts)
            values = sums / counts
        log_shares = np.log(counts / counts.sum())
        slopes = np.sinh(np.linspace(-8, 8, 801)) / max(float(np.ptp(values)), 1e-12)
        return cls(values, log_shares, slopes, _shares(log_shares, slopes, values) @ values)

    def drawn(self, expected: Float64Array, uniform: Float64Array) -> Float64Array:
        """Rewards (M,) with the means `expected` (M,), from `uniform` (M,) in [0, 1)."""
        if len(self.values) == 2:
            high, low = self.values
            drawn: Float64Array = np.where(uniform < (expected - low) / (high - low), high, low)
            return drawn
        slopes = np.interp(expected, self.means, self.slopes)
        bounds = _shares(self.log_shares, slopes, self.values).cumsum(axis=1)[:, :-1]
        drawn = self.values[(uniform[:, None] >= bounds).sum(axis=1)]
        return drawn


def _shares(log_shares: Float64Array, slopes: Float64Array, values: Float64Array) -> Float64Array:
    """(M, K) shares of the values (K,) under slopes (M,)."""
    shares = torch.from_numpy(log_shares + slopes[:, None] * values).softmax(dim=1)
    return np.asarray(shares)


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
        self._logged = LoggedRewards.of(store)
        n, self._lags = sessions * times, model.rewarding.lags
        self._numbers = np.arange(n) % sessions
        self._episodes = self._numbers % store.n_episodes
        self._sessions = Sessions.begun(n, max(self._lags, store.item_states.window))
        if store.has_users:
            users = store.episode_values(schema.USER).astype(np.int64)[self._episodes]
            self._sessions = replace(self._sessions, users=torch.from_numpy(users))

    @property
    def users(self) -> IntArray:
        """(M,) rows of the store's users, −1 where it does not name them."""
        return self._sessions.users.numpy()

    def observations(self) -> Float32Array:
        """(M, O) observations before the next step."""
        if not self._store.observation_size:
            return np.zeros((len(self._numbers), 0), dtype=np.float32)
        steps = np.minimum(self._sessions.steps.numpy(), self._store.lengths[self._episodes] - 1)
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
        observations = torch.from_numpy(self.observations())
        states = self._sessions.latest_states(self._store.item_states, observations)
        shown, users = self._sessions.shown.latest(self._lags), self._sessions.users
        before = self._sessions.steps.numpy()
        expected = self._model.expected(states, shown, users, items)
        rewards = self._logged.drawn(expected, self._draws())
        ends = self._model.session_end.probabilities(shown, items, rewards, before)
        self._sessions = self._sessions.with_step(items, torch.from_numpy(rewards))
        ended: BoolArray = (self._draws() < ends) | (before + 1 >= self._longest)
        going = np.flatnonzero(~ended)
        if len(going) < len(ended):
            self._sessions = self._sessions.at(going)
            self._episodes, self._numbers = self._episodes[going], self._numbers[going]
        return rewards.astype(np.float32), going

    def _draws(self) -> Float64Array:
        """(M,) from [0, 1)."""
        return self._rng.random(self._different)[self._numbers]


def longest_session(lengths: IntArray) -> int:
    """Steps after which a simulated session ends in any case, from those of logged sessions (E,).

    Policies may make sessions longer than any logged one, unless something ends them there: more
    of the longest sessions than chance explains.
    """
    longest = int(lengths.max())
    late = lengths[lengths > longest // 2]
    ended = int((late < longest).sum())
    hazard = ended / int((np.minimum(late, longest - 1) - longest // 2).sum() or 1)
    if hazard ** (len(late) - ended) < _CHANCE:
        return longest
    times, most = _BEYOND
    return max(longest, min(times * longest, most))
