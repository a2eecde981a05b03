"""The user model, reward of every item, session ends and fatigue, and sessions simulated in it."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions, Shown
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors
from ucfrec.processes import require_blas_memory
from ucfrec.user_model.fatigue import Fatigue, LoggedRuns, MainTags, fit_fatigue
from ucfrec.user_model.interest import find_user_rows
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import (
    TrainingUsersReport,
    fit_item_reward_model,
    fit_training_users,
    score_unseen,
)
from ucfrec.user_model.reward_report import ItemRewardReport, RewardRows, calibrate, score_rows
from ucfrec.user_model.running import RunningRates
from ucfrec.user_model.session_end import (
    SESSIONS,
    LoggedEnds,
    SessionEnd,
    SessionEndReport,
    whole_sessions,
)

_MOST_STEPS = 100_000
"""Logged steps that session ends, fatigue and calibration are fitted to at most."""
_GROUPS = 32
"""Most rewards to draw from."""
_BEYOND = 3, 100
"""Simulated sessions may have so many times the longest logged one's steps, up to so many, …"""
_CHANCE = 0.001
"""… unless chance ends all sessions that get there with a lower probability than this."""


@dataclass(frozen=True)
class UserModel:
    """What users would do: how they reward every item, when they leave, and their fatigue."""

    reward: ItemRewardModel
    """Expected reward of every item, as acting knows it."""
    reward_report: ItemRewardReport
    training_users: tuple[ItemRewardModel, TrainingUsersReport] | None
    """Who reward what simulated sessions show; None where no sessions are simulated."""
    calibration: tuple[float, float]
    """Slope and intercept of the scores that rewards are drawn from, on held-out rows."""
    session_end: SessionEnd
    session_end_report: SessionEndReport
    fatigue: Fatigue | None
    main_tags: MainTags

    @classmethod
    def fit(
        cls,
        train: EpisodeStore,
        validation: EpisodeStore,
        folder: Path,
        seed: int,
        simulated: bool = True,
        first: Path | None = None,
    ) -> "UserModel":
        """Fit the parts that are not in `folder` yet; read the others. Searches begin near the user
        model of an earlier state of the store, in the folder `first`. InputError if training
        rewards are equal, no steps are held out, or a file is damaged.
        """
        require_blas_memory()
        reward, report = fit_item_reward_model(train, validation, folder, seed, first)
        users = None
        if simulated and train.has_users:
            users = fit_training_users(train, folder, seed, report.new_users, first)
            users[0].likeness = reward.likeness  # of the same items, in memory once
        for model in filter(None, (reward, users and users[0])):
            model.rates = RunningRates.of(train, model.target)
        tags, path = MainTags.of(validation.item_states), folder / SESSIONS
        if not path.exists():
            fatigue = None
            if reward.binary:
                first_runs, later_runs = (
                    LoggedRuns.of(view, tags, reward.lags, _MOST_STEPS)
                    for view in (train, validation)
                )
                fatigue = fit_fatigue(first_runs, later_runs)
            logged, held_out = (
                LoggedEnds.of(view, reward.likeness, reward.lags, _MOST_STEPS, seed)
                for view in whole_sessions(train, validation)
            )
            end, end_report = SessionEnd.fit(reward.likeness, logged, held_out, seed)
            if users is not None and report.new_users:
                line = users[1].calibration
            else:
                if users is None and reward.interests.are_known:
                    reward.user_rows = find_user_rows(train.whole)
                line = calibrate(users[0] if users else reward, validation, _MOST_STEPS, seed)
            fitted: dict[str, Any] = {
                "calibration": line,
                "session_end": asdict(end_report),
                "fatigue": fatigue and asdict(fatigue),
            }
            save_tensors(path, dict(end.tensors), fitted)
        reward.user_rows = None  # only those of training and the session count from here on
        tensors, metadata = load_tensors(path)
        with damage_explained(path, REMEDY):
            slope, intercept = metadata["calibration"]
            of_fatigue = metadata["fatigue"]
            return cls(
                reward=reward,
                reward_report=report,
                training_users=users,
                calibration=(slope, intercept),
                session_end=SessionEnd.of(reward.likeness, tensors),
                session_end_report=SessionEndReport(**metadata["session_end"]),
                fatigue=of_fatigue and Fatigue(**of_fatigue),
                main_tags=tags,
            )

    @property
    def rewarding(self) -> ItemRewardModel:
        """The model that rewards of simulated sessions are drawn from."""
        return self.reward if self.training_users is None else self.training_users[0]

    def expect(
        self,
        states: Tensor,
        history: Shown,
        users: Tensor | None,
        items: Tensor,
        offer: Offer | None = None,
        above: Tensor | None = None,
    ) -> Float64Array:
        """Expected rewards (M,) of items (M,), in states (M, S) of training users (M,)."""
        scores = self.rewarding.score(states, history, users, items, offer, above)
        return self._expect_of(scores, history)

    def expect_unseen(self, sessions: EpisodeStore) -> Float64Array:
        """Expected rewards (M,) of all steps of training sessions, by fits to other steps."""
        report = self.training_users[1] if self.training_users else self.reward_report
        weighted = self.reward_report.new_users
        rows, scores = score_unseen(self.rewarding, report.effects, weighted, sessions)
        return self._expect_of(scores, rows.history)

    def expect_held_out(self, sessions: EpisodeStore) -> Float64Array:
        """Expected rewards (M,) of all steps of sessions that it was not fitted to."""
        rows = RewardRows.of(sessions, self.rewarding.reach, sessions.n_steps, 0)
        return self._expect_of(score_rows(self.rewarding, rows), rows.history)

    def _expect_of(self, scores: Tensor, history: Shown) -> Float64Array:
        slope, intercept = self.calibration
        rewards = self.rewarding.expect(slope * scores + intercept).double().numpy()
        if self.fatigue is None:
            return rewards
        low = float(self.rewarding.reward_low)
        tired = self.fatigue.is_tired(self.main_tags.runs(history)).numpy()
        return np.where(tired, low + self.fatigue.factor * (rewards - low), rewards)


class LoggedRewards:
    """Rewards to draw: those of a log, weighted by exp(slope · reward) so that their mean is the
    expected reward, as what follows, such as the session's end, is not linear in the reward."""

    def __init__(self, store: EpisodeStore) -> None:
        rewards, counts = np.unique(store.column(schema.REWARD), return_counts=True)
        values, counts = rewards[::-1].astype(np.float64), counts[::-1]
        if len(values) > _GROUPS:
            middle = (counts.cumsum() - counts / 2) / counts.sum()
            groups = np.unique((_GROUPS * middle).astype(int), return_inverse=True)[1]
            sums, counts = np.bincount(groups, counts * values), np.bincount(groups, counts)
            values = sums / counts
        self.values: Float64Array = values
        """(K,) distinct rewards, or means of `_GROUPS` groups of equal size, from the highest."""
        self._log_shares = np.log(counts / counts.sum())
        span = max(float(np.ptp(values)), 1e-12)
        self._slopes = np.sinh(np.linspace(-8, 8, 801)) / span
        self._means = self._weigh(self._slopes) @ values

    def _weigh(self, slopes: Float64Array) -> Float64Array:
        """(M, K) shares of the values (K,) under slopes (M,) per unit of reward."""
        exponents = self._log_shares + slopes[:, None] * self.values
        return torch.from_numpy(exponents).softmax(1).numpy()

    def draw(self, expected: Float64Array, uniform: Float64Array) -> Float64Array:
        """Rewards (M,) with the means `expected` (M,), from `uniform` (M,) in [0, 1)."""
        if len(self.values) == 2:
            high, low = self.values
            return np.asarray(np.where(uniform < (expected - low) / (high - low), high, low))
        bounds = self._weigh(np.interp(expected, self._means, self._slopes)).cumsum(axis=1)
        numbers = (uniform[:, None] >= bounds[:, :-1]).sum(axis=1)
        return np.asarray(self.values[numbers])


class UserSimulator:
    """N sessions of logged users at once, whose rewards and ends are drawn from a user model.

    A session begins as a logged one did: its user, and its observations step by step. M ≤ N go on.
    """

    def __init__(
        self,
        model: UserModel,
        store: EpisodeStore,
        sessions: int,
        longest: int,
        seed: int,
        times: int = 1,
        length: int = 1,
    ) -> None:
        """Begins session i as the i-th of `store`, modulo their number, to end after `longest`
        steps; of N = `sessions` · `times`, it draws what session i modulo `sessions` draws.
        Decisions are lists of `length` items, shown in so many steps, after which sessions end."""
        self._length = min(length, len(store.item_states.embeddings))
        self._place = 0
        self._model, self._store, self._longest = model, store, longest
        self._different, self._rng = sessions, np.random.default_rng(seed)
        self._logged, self._lags = LoggedRewards(store), model.rewarding.lags
        self._numbers = np.arange(sessions * times) % sessions
        self._episodes = self._numbers % store.n_episodes
        length = max(self._lags, store.item_states.window)
        self._sessions = Sessions.begun(sessions * times, length)
        if store.has_users:
            users = store.episode_values(schema.USER)[self._episodes]
            self._sessions = replace(self._sessions, users=torch.from_numpy(users))

    @property
    def users(self) -> IntArray:
        """(M,) rows of the store's users, −1 where it does not name them."""
        return self._sessions.users.numpy()

    def observations(self) -> Float32Array:
        """(M, O) observations before the next step."""
        if not self._store.observation_size:
            return np.zeros((len(self._numbers), 0), dtype=np.float32)
        values = self._store.step_values(schema.OBSERVATION, self._episodes, self._logged_steps)
        return np.asarray(values, dtype=np.float32)

    @property
    def offer(self) -> Offer | None:
        """What is on offer at the next step, at the time of the logged one; None for everything."""
        return self._store.offer(self._episodes, self._logged_steps)

    @property
    def _logged_steps(self) -> IntArray:
        """(M,) logged steps that the next ones stand for."""
        return self._sessions.steps.numpy().clip(max=self._store.lengths[self._episodes] - 1)

    def step(self, actions: Array) -> tuple[Float32Array, IntArray]:
        """Show one item (M,) in every session: rewards (M,), and positions of those that go on;
        `expected` then has the expected rewards (M,)."""
        items = torch.from_numpy(np.asarray(actions, dtype=np.int64))
        history = self._sessions.shown.latest(self._lags)
        users = self._sessions.users
        if not self._place:
            # What a user thinks of a list depends on what was shown before it.
            observations = torch.from_numpy(self.observations())
            states = self._sessions.latest_states(self._store.item_states, observations)
            self._before = states, history
        above = self._sessions.shown.latest(self._place)
        self._place = (self._place + 1) % self._length
        steps = self._sessions.steps.numpy()
        self.expected = self._model.expect(*self._before, users, items, self.offer, above.items)
        rewards = self._logged.draw(self.expected, self._draw_uniform())
        of_list = rewards + above.rewards.sum(1).double().numpy()
        ends = self._model.session_end.probabilities(history, items, of_list, steps)
        self._sessions = self._sessions.add_step(items, torch.from_numpy(rewards))
        ended = (self._draw_uniform() < ends) | (steps + 1 >= self._longest)
        ended &= self._place == 0
        going = np.flatnonzero(~ended)
        if len(going) < len(ended):
            self._sessions = self._sessions.at(going)
            self._episodes, self._numbers = self._episodes[going], self._numbers[going]
        return rewards.astype(np.float32), going

    def _draw_uniform(self) -> Float64Array:
        return self._rng.random(self._different)[self._numbers]


def longest_session(lengths: IntArray) -> int:
    """Steps after which a simulated session ends in any case, from those of logged sessions (E,):
    more than logged, unless more of the longest sessions end there than chance explains."""
    longest = int(lengths.max())
    late = lengths[lengths > longest // 2]
    ended = int((late < longest).sum())
    hazard = ended / int((np.minimum(late, longest - 1) - longest // 2).sum() or 1)
    if hazard ** (len(late) - ended) < _CHANCE:
        return longest
    times, most = _BEYOND
    return max(longest, min(times * longest, most))
