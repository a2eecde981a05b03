"""The user model: reward of every item, session ends and fatigue, fitted and saved together."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from torch import Tensor

from ucfrec.arrays import Float64Array
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors
from ucfrec.processes import require_blas_memory
from ucfrec.user_model.fatigue import Fatigue, LoggedRuns, fit_fatigue
from ucfrec.user_model.main_tags import MainTags
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model
from ucfrec.user_model.reward_report import ItemRewardReport, calibrate
from ucfrec.user_model.reward_rows import RewardRows
from ucfrec.user_model.session_end import LoggedEnds, SessionEnd
from ucfrec.user_model.training_users import TrainingUsers, fit_training_users

_SESSIONS: Final = "sessions.safetensors"
"""File of session ends, fatigue and calibration in the model's folder."""
_MOST_STEPS: Final = 100_000
"""Logged steps that session ends, fatigue and calibration are fitted to at most."""


@dataclass(frozen=True)
class UserModel:
    """What users would do: how they reward every item, when they leave, and what tires them."""

    reward: ItemRewardModel
    """Expected reward of every item, as acting knows it."""
    reward_report: ItemRewardReport
    """Its quality on validation rows."""
    training_users: TrainingUsers | None
    """Where users are new: training users, whose tastes give the rewards of simulated sessions, and
    nothing that acts knows them."""
    calibration: tuple[float, float]
    """Slope and intercept of the scores that rewards are drawn from, on held-out rows."""
    session_end: SessionEnd
    fatigue: Fatigue | None
    """None if the log shows none."""
    main_tags: MainTags

    @classmethod
    def fit(
        cls, train: EpisodeStore, validation: EpisodeStore, folder: Path, seed: int
    ) -> "UserModel":
        """Fit the parts that are not in `folder` yet; read the others.

        Args:
            train: training episodes of a store of items.
            validation: held-out episodes of the same store.
            folder: receives the fitted parts.
            seed: of rows drawn from large logs.

        Raises:
            InputError: all training rewards are equal, there are no held-out steps, or a file is
                damaged.
        """
        require_blas_memory()
        reward, report = fit_item_reward_model(train, validation, folder, seed)
        users = fit_training_users(train, folder, seed) if report.new_users else None
        tags, path = MainTags.of(validation.item_states), folder / _SESSIONS
        if not path.exists():
            runs = (LoggedRuns.of(v, tags, reward.lags, _MOST_STEPS) for v in (train, validation))
            tired = fit_fatigue(*runs) if reward.binary else None
            ends = LoggedEnds.of(train, reward.lags, _MOST_STEPS, seed)
            if users is None:
                rows = RewardRows.of(validation, reward.reach, _MOST_STEPS, seed)
                line = calibrate(reward, rows)
            else:
                line = users.report.calibration
            fitted = {
                "fatigue": None if tired is None else dataclasses.asdict(tired),
                "calibration": line,
            }
            save_tensors(path, dict(SessionEnd.fit(reward.likeness, ends).tensors), fitted)
        tensors, about = load_tensors(path)
        with damage_explained(path, REMEDY):
            slope, intercept = about["calibration"]
            fatigue = None if about["fatigue"] is None else Fatigue(**about["fatigue"])
        end = SessionEnd(reward.likeness, tensors)
        return cls(reward, report, users, (slope, intercept), end, fatigue, tags)

    @property
    def rewarding(self) -> ItemRewardModel:
        """The model that rewards of simulated sessions are drawn from."""
        return self.reward if self.training_users is None else self.training_users.model

    def expected(
        self, states: Tensor, shown: Shown, users: Tensor | None, items: Tensor
    ) -> Float64Array:
        """Expected rewards (M,) of one item (M,) each, in reward units.

        Args:
            states: (M, S) before the step.
            shown: what the sessions showed before.
            users: (M,) rows of the training store's users.
            items: (M,) int64.
        """
        slope, intercept = self.calibration
        scores = self.rewarding.score(states, shown, users, items)
        rewards = self.rewarding.expected(slope * scores + intercept).double().numpy()
        if self.fatigue is None:
            return rewards
        low = float(self.rewarding.reward_low)
        tired = self.fatigue.tired(self.main_tags.runs(shown)).numpy()
        return np.where(tired, low + self.fatigue.factor * (rewards - low), rewards)

    def report(self) -> dict[str, Any]:
        """What simulated sessions are drawn from, as a JSON object."""
        users = None if self.training_users is None else self.training_users.report
        return {
            "calibration": list(self.calibration),
            "users": None if users is None else dataclasses.asdict(users),
            "fatigue": None if self.fatigue is None else dataclasses.asdict(self.fatigue),
        }
