"""What the scores of simulated users are worth on validation rows, and how far that can be trusted.

Logs show what their policy took to be good. Where they have propensities, rows are weighted as if
all items had been shown alike (`propensity_weights`): scores that are right for what was shown are
too high for what another policy would show.
"""

from typing import Final

import numpy as np
import torch
from pydantic.dataclasses import dataclass

from ucfrec import schema
from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_report import SAVED, fit_line, scores_of
from ucfrec.user_model.reward_rows import RewardRows, drawn_steps
from ucfrec.user_model.training_users import propensity_weights

Line = tuple[float, float]
_FEWEST: Final = 50
"""Rows of a half from which on a line is fitted to it."""


@dataclass(frozen=True, config=SAVED)
class UserCalibration:
    """Slope and intercept that turn scores into rewards, from validation rows."""

    line: Line
    """Of all rows."""
    halves: tuple[Line, Line]
    """Of the rows of either half of the users; `line` where they are too few."""
    optimism: float
    """Expected over observed reward, less 1, where each half is predicted by the other's line."""
    optimism_error: float
    """Its standard error over users."""
    weighted: bool
    """Whether rows are weighted by propensities."""

    @classmethod
    def fit(
        cls, model: ItemRewardModel, view: EpisodeStore, limit: int, seed: int
    ) -> "UserCalibration":
        """Calibrate the scores of a model on at most `limit` drawn steps of a view."""
        episodes, steps = drawn_steps(view, limit, seed)
        rows, half = RewardRows.at(view, episodes, steps, model.reach), half_of(view)[episodes]
        weights = propensity_weights(view, episodes, steps, len(model.item))
        counts = torch.ones(len(rows)) if weights is None else weights
        scores, target = scores_of(model, rows)[0], model.target(rows.rewards)

        def line_of(chosen: BoolArray) -> Line:
            part = torch.from_numpy(chosen)
            return fit_line(scores[part], target[part], bool(model.binary), counts[part])

        line = line_of(np.ones(len(rows), dtype=bool))
        parts = [half == number for number in (0, 1)]
        halves = [line_of(part) if part.sum() >= _FEWEST else line for part in parts]
        slope, intercept = (
            torch.tensor([other[n] for other in reversed(halves)])[torch.from_numpy(half)]
            for n in (0, 1)
        )
        expected = (counts * model.expected(slope * scores + intercept)).double().numpy()
        observed = (counts * rows.rewards).double().numpy()
        off = expected.sum() / observed.sum() - 1 if observed.sum() > 0 else 0.0
        by_user = np.bincount(episodes, expected - (1 + off) * observed)
        error = float(np.sqrt(np.square(by_user).sum()) / abs(observed.sum() or 1.0))
        return cls(line, (halves[0], halves[1]), float(off), error, weights is not None)


def half_of(view: EpisodeStore) -> IntArray:
    """Half (E,) of the users, 0 or 1, to which the episodes of a view belong; of the episodes,
    where users are not named."""
    if not view.has_users:
        return np.arange(view.n_episodes) % 2
    return view.episode_values(schema.USER).astype(np.int64) % 2
