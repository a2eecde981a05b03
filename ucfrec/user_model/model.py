"""The user model: reward of every item, session ends and fatigue, fitted and saved together."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from torch import Tensor

from ucfrec.arrays import Float64Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors
from ucfrec.processes import require_blas_memory
from ucfrec.user_model.fatigue import Fatigue, LoggedRuns, MainTags, fit_fatigue
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model
from ucfrec.user_model.reward_report import ItemRewardReport
from ucfrec.user_model.session_end import LoggedEnds, SessionEnd, SessionEndReport, whole_sessions
from ucfrec.user_model.training_users import TrainingUsers, UserCalibration, fit_training_users

SESSIONS: Final = "sessions.safetensors"
"""File of session ends, fatigue and calibration in the model's folder."""
_MOST_STEPS: Final = 100_000
"""Logged steps that session ends, fatigue and calibration are fitted to at most."""


@dataclass(frozen=True)
class UserModel:
    """What users would do: how they reward every item, when they leave, and their fatigue."""

    reward: ItemRewardModel
    """Expected reward of every item, as acting knows it."""
    reward_report: ItemRewardReport
    """Its quality on validation rows."""
    training_users: TrainingUsers | None
    """Users with fixed tastes, who reward what simulated sessions show; nothing that acts learns of
    them but by their rewards. None where no sessions are simulated."""
    calibration: tuple[float, float]
    """Slope and intercept of the scores that rewards are drawn from, on held-out rows."""
    session_end: SessionEnd
    session_end_report: SessionEndReport
    fatigue: Fatigue | None
    """None if the log shows none."""
    main_tags: MainTags
    calibration_report: UserCalibration | None = None
    """How far the calibration can be trusted; None where validation users are new, whose tastes
    no one knows."""

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
        """Fit the parts that are not in `folder` yet; read the others.

        Args:
            train: training episodes of a store of items.
            validation: held-out episodes of the same store.
            simulated: whether sessions are simulated.
            first: folder of the user model of an earlier state of the store, near whose spreads of
                effects the search begins and ends.

        Raises:
            InputError: all training rewards are equal, there are no held-out steps, or a file is
                damaged.
        """
        require_blas_memory()
        reward, report = fit_item_reward_model(train, validation, folder, seed, first=first)
        users = None
        if simulated and train.has_users:
            users = fit_training_users(train, folder, seed, report.new_users, first)
        tags, path = MainTags.of(validation.item_states), folder / SESSIONS
        if not path.exists():
            runs = (LoggedRuns.of(v, tags, reward.lags, _MOST_STEPS) for v in (train, validation))
            tired = fit_fatigue(*runs) if reward.binary else None
            logged, held_out = (
                LoggedEnds.of(view, reward.lags, _MOST_STEPS, seed)
                for view in whole_sessions(train, validation)
            )
            end, end_report = SessionEnd.fit(reward.likeness, logged, held_out, seed)
            line, calibration = users.report.calibration if users else (1.0, 0.0), None
            if users is None or not report.new_users:
                model = users.model if users else reward
                calibration = UserCalibration.fit(model, validation, _MOST_STEPS, seed)
                line = calibration.line
            fitted = {
                "fatigue": None if tired is None else dataclasses.asdict(tired),
                "calibration": line,
                "calibration_report": calibration and dataclasses.asdict(calibration),
                "session_end": dataclasses.asdict(end_report),
            }
            save_tensors(path, dict(end.tensors), fitted)
        tensors, metadata = load_tensors(path)
        with damage_explained(path, REMEDY):
            slope, intercept = metadata["calibration"]
            fatigue = None if metadata["fatigue"] is None else Fatigue(**metadata["fatigue"])
            end_report = SessionEndReport(**metadata["session_end"])
            calibration = metadata["calibration_report"] and UserCalibration(
                **metadata["calibration_report"]
            )
            end = SessionEnd.of(reward.likeness, tensors)
        line = slope, intercept
        return cls(reward, report, users, line, end, end_report, fatigue, tags, calibration)

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
        calibration = self.calibration_report
        users = None if self.training_users is None else self.training_users.report
        return {
            "calibration": list(self.calibration),
            "calibration_report": calibration and dataclasses.asdict(calibration),
            "users": None if users is None else dataclasses.asdict(users),
            "session_end": dataclasses.asdict(self.session_end_report),
            "fatigue": None if self.fatigue is None else dataclasses.asdict(self.fatigue),
        }


def load_session_end(folder: Path, reward: ItemRewardModel | None) -> SessionEnd | None:
    """The model of session ends in the folder of a user model; None if there is none.

    Raises:
        InputError: its file is damaged.
    """
    path = folder / SESSIONS
    if reward is None or not path.exists():
        return None
    tensors, _ = load_tensors(path)
    with damage_explained(path, REMEDY):
        return SessionEnd.of(reward.likeness, tensors)
