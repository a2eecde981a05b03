"""Sessions played in a model of the users that was learned from logs."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.exposure import Likeness, Shown
from ucfrec.episodes.main_tags import MainTags
from ucfrec.episodes.states import ItemStates, SessionStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.schema import USER_IDS
from ucfrec.user_model.fatigue import Fatigue

if TYPE_CHECKING:
    from ucfrec.user_model.reward import ItemRewardModel

_PENALTY = 1.0
"""L2 penalty of the logistic regressions on standardised inputs."""


@dataclass(frozen=True)
class LoggedEnds:
    """Logged steps, what was shown before each, and whether it ended its session."""

    shown: Shown
    """The items shown before, (N, L)."""
    items: Tensor
    """(N,) int64 items shown at the step."""
    rewards: Float64Array
    """(N,) in reward units."""
    steps: IntArray
    """(N,) number of the step in its session."""
    ended: BoolArray
    """(N,)."""

    @classmethod
    def of(cls, store: EpisodeStore, lags: int, most: int, seed: int) -> "LoggedEnds":
        """Steps of a view of a store of items, at most `most` of them, drawn at random.

        The last step of a user's last session, and of a session that was cut, is left out: the
        log may simply have ended there.
        """
        users = store.episode_values(schema.USER) if store.has_users else np.arange(len(store))
        last_session = np.zeros(len(store), dtype=bool)
        last_session[len(store) - 1 - np.unique(users[::-1], return_index=True)[1]] = True
        unknown = last_session | ~store.terminated
        # Of an episode whose end is unknown, all steps but the last are known.
        ends = np.cumsum(store.lengths - unknown)
        kept = int(ends[-1])
        numbers = np.arange(kept)
        if kept > most:
            drawn = np.random.default_rng(seed).choice(kept, most, replace=False)
            numbers = np.sort(drawn)
        episodes = np.searchsorted(ends, numbers, side="right")
        steps = numbers - (ends - (store.lengths - unknown))[episodes]
        ended = steps == store.lengths[episodes] - 1
        window = store.windows(episodes, steps, lags + 1)
        rewards = window.rewards[:, -1].double().numpy()
        return cls(Shown.before_last(window), window.actions[:, -1], rewards, steps, ended)


class SessionEnd:
    """The probability that a session ends with a step: a logistic regression.

    Inputs are the number of the step, its reward, and how often and how alike the item was shown in
    the last 1, 3 and all of the steps before.
    """

    def __init__(self, likeness: Likeness, logged: LoggedEnds) -> None:
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        self._likeness = likeness
        ended = logged.ended
        self._rate, self._model = float(ended.mean()) if len(ended) else 0.0, None
        if 0 < self._rate < 1:
            inputs = self._inputs(logged.shown, logged.items, logged.rewards, logged.steps)
            regression = LogisticRegression(C=1 / _PENALTY, max_iter=1000)
            self._model = make_pipeline(StandardScaler(), regression).fit(inputs, ended)

    def probabilities(
        self, shown: Shown, items: Tensor, rewards: Float64Array, steps: IntArray
    ) -> Float64Array:
        """Probabilities (M,) that sessions end with a step; arguments as in `LoggedEnds`."""
        if self._model is None:
            return np.full(len(steps), self._rate)
        inputs = self._inputs(shown, items, rewards, steps)
        return np.asarray(self._model.predict_proba(inputs)[:, 1])

    def _inputs(
        self, shown: Shown, items: Tensor, rewards: Float64Array, steps: IntArray
    ) -> Float32Array:
        columns = [np.log1p(steps), steps, np.minimum(steps, 1), rewards]
        repeated = (shown.items == items.unsqueeze(1)).double()
        for reach in (1, 3, shown.items.shape[1]):
            recent = shown.items.clone()
            recent[:, reach:] = -1
            profile = self._likeness.profile(recent, torch.ones(recent.shape))
            alike = self._likeness.to_items(profile, items.unsqueeze(1))
            columns += [repeated[:, :reach].sum(1).numpy(), alike.numpy(), (alike > 0).numpy()]
        return np.stack(columns, axis=1).astype(np.float32)


class UserSimulator:
    """N parallel sessions of logged users whose rewards and ends are drawn from models.

    A session begins as a logged one did: its user, and its observations step by step. It follows
    the interface of `gymnasium.vector.VectorEnv` as far as `ucfrec.acting.rollout.rollout` uses it.
    """

    def __init__(
        self,
        store: EpisodeStore,
        reward_model: "ItemRewardModel",
        calibration: tuple[float, float],
        end: SessionEnd,
        sessions: int,
        longest: int,
        copies: int = 1,
        fatigue: Fatigue | None = None,
    ) -> None:
        """
        Args:
            store: view of the sessions that are begun; session i is the i-th modulo their number.
            reward_model: of rewards.
            calibration: slope and intercept of the reward model's scores on held-out steps.
            end: of the ends of sessions.
            sessions: number of sessions that differ.
            longest: steps after which a session ends in any case.
            copies: how often each session is played; N is `copies` times `sessions`. Environment i
                draws the same numbers as environment i modulo `sessions`.
            fatigue: of the users, where rewards have two values.
        """
        from gymnasium.vector import AutoresetMode

        self.num_envs = sessions * copies
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self._different = sessions
        self._store, self._model, self._end = store, reward_model, end
        self._slope, self._intercept = calibration
        self._longest = longest
        self._states: ItemStates = store.item_states
        self._users = np.full(len(store), -1)
        if store.has_users:
            self._users = store.episode_values(schema.USER).astype(np.int64)
        found = [np.unique(store.step_values(schema.REWARD, *s)) for s in store.step_batches()]
        rewards = np.unique(np.concatenate(found))
        self._outcomes = rewards if len(rewards) == 2 else None
        self._fatigue, self._tags = fatigue, MainTags.of(self._states)

    def reset(self, seed: int) -> tuple[Float32Array, dict[str, Any]]:
        """Begin N sessions; all draws come from `seed`."""
        n = self.num_envs
        self._rng = np.random.default_rng(seed)
        self._sessions = SessionStates(self._states, n)
        lags = self._model.lags
        self._shown = Shown(torch.full((n, lags), -1), torch.zeros(n, lags))
        self._steps = np.zeros(n, dtype=np.int64)
        self._numbers = np.arange(n) % self._different
        self._episodes = self._numbers % self._store.n_episodes
        self._sessions.users = torch.from_numpy(self._users[self._episodes])
        return self._observe(), self._info()

    def keep(self, rows: IntArray) -> None:
        """End all sessions but those of `rows`, which are the only environments until `reset`."""
        self._sessions.keep(rows)
        self._shown = self._shown.at(torch.from_numpy(rows))
        self._steps, self._episodes = self._steps[rows], self._episodes[rows]
        self._numbers = self._numbers[rows]

    def _draws(self) -> Float64Array:
        """(N,) from [0, 1)."""
        return self._rng.random(self._different)[self._numbers]

    def step(
        self, actions: Array
    ) -> tuple[Float32Array, Float32Array, BoolArray, BoolArray, dict[str, Any]]:
        """Show one item in every session; those that end begin anew in the same step."""
        items = torch.from_numpy(np.asarray(actions, dtype=np.int64))
        states = self._sessions.current(torch.from_numpy(self._observe()))
        scores = self._model.score(states, self._shown, self._sessions.users, items)
        scores = self._slope * scores + self._intercept
        rewards = self._model.expected(scores).double().numpy()
        if self._outcomes is not None:
            low, high = self._outcomes
            chance = (rewards - low) / (high - low)
            if self._fatigue is not None:
                tired = self._fatigue.tired(self._tags.runs(self._shown)).numpy()
                chance = np.where(tired, self._fatigue.factor * chance, chance)
            rewards = np.where(self._draws() < chance, high, low)
        ends = self._end.probabilities(self._shown, items, rewards, self._steps)
        self._sessions.record(items, torch.from_numpy(rewards))
        latest = Shown(items.unsqueeze(1), torch.from_numpy(rewards).float().unsqueeze(1))
        self._shown = Shown(
            *(
                torch.cat([new, old[:, :-1]], 1)
                for new, old in zip(latest, self._shown, strict=True)
            )
        )
        self._steps += 1
        terminated = self._draws() < ends
        truncated = (self._steps >= self._longest) & ~terminated
        ended = terminated | truncated
        info: dict[str, Any] = {}
        if ended.any():
            info = {"final_obs": self._observe(), "_final_obs": ended}
        rows = np.flatnonzero(ended)
        self._sessions.begin(rows)
        self._shown.items[rows], self._shown.rewards[rows] = -1, 0.0
        self._steps[rows] = 0
        self._episodes[rows] = (self._episodes[rows] + self._different) % self._store.n_episodes
        self._sessions.users = torch.from_numpy(self._users[self._episodes])
        info |= self._info()
        return self._observe(), rewards.astype(np.float32), terminated, truncated, info

    def _observe(self) -> Float32Array:
        size = self._store.observation_size
        if not size:
            return np.zeros((len(self._steps), 0), dtype=np.float32)
        steps = np.minimum(self._steps, self._store.lengths[self._episodes] - 1)
        values = self._store.step_values(schema.OBSERVATION, self._episodes, steps)
        return np.asarray(values, dtype=np.float32)

    def _info(self) -> dict[str, Any]:
        return {USER_IDS: self._users[self._episodes]}
