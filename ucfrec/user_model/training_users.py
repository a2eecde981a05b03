"""The users of a training log, as those whose sessions a decision rule is tried in.

For new users, policy and reward model learn tastes from the session. In sessions whose rewards are
drawn from that reward model, a policy is paid for its own guesses: an item that pays once, by luck,
counts as liked and goes on paying. Here tastes are there before a session begins: those of training
users, and nothing that acts knows them.

Logs of policies that knew more of their users than the log shows make what they showed look better
than it is for anybody else. Where the log has all propensities p, and users are new, rows are
therefore weighted by 1 / (p · items), cut off at 10, as if all items had been shown alike (inverse
propensity weighting). So that a few rows of large weight do not pass for much knowledge of a user's
tastes, the weights of each user's rows are scaled to add up to their effective number (Pfeffermann
et al., 1998, "Weighting for unequal selection probabilities in multilevel models"). Known users are
calibrated on weighted validation rows instead (`fit_calibration`), and their tastes fitted without
weights, which there only cost data.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pydantic
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, load_weights
from ucfrec.progress import progress
from ucfrec.user_model.effect_search import Beginning, EffectSearch, save_fit
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_effects import EFFECTS, Design, fit_effects
from ucfrec.user_model.reward_fit import WARM_ROWS, reward_model_sizes, set_statistics
from ucfrec.user_model.reward_report import (
    SAVED,
    EffectTried,
    RewardRows,
    drawn_steps,
    fit_line,
    scores_of,
)

_FITTED: Final = "training_users.safetensors"
_MAX_STEPS: Final = 100_000
_LARGEST_WEIGHT: Final = 10.0
"""Larger weights are cut off, so that no single row decides."""
Line = tuple[float, float]
_FEWEST: Final = 50
"""Rows of a half from which on a line is fitted to it."""


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class TrainingUsersReport:
    """How the tastes of training users were found."""

    calibration: tuple[float, float]
    """Slope and intercept of the model's scores on training rows that were held back."""
    effects: tuple[EffectTried, ...]
    """The effects that were tried, evaluated on these rows."""
    steps: int
    """Logged steps that the effects are fitted to."""
    effective_steps: float
    """As many steps of equal weight count as much; `steps` without propensities."""
    weighted: bool
    """Whether the effects are fitted to rows weighted by propensities."""


@dataclass(frozen=True)
class TrainingUsers:
    """Training users, and how their tastes were found."""

    model: ItemRewardModel
    """Rewards of items for them."""
    report: TrainingUsersReport


def fit_training_users(
    train: EpisodeStore,
    folder: Path,
    seed: int,
    weighted: bool = True,
    first: Path | None = None,
) -> TrainingUsers:
    """Fit the effects of training users, or read them from `folder` if they were fitted before.

    Effects are chosen as in `ucfrec.user_model.effect_search`, on a fifth of the rows.

    Args:
        train: view of a store of items whose episodes name their users.
        seed: of the sessions drawn by `draw_sessions`.
        weighted: whether rows are weighted by propensities, if there are any.
        first: folder of the fit to an earlier state of the store, near whose spreads the search
            begins and ends; of known users, on fewer rows.

    Raises:
        InputError: all training rewards are equal, or the file is damaged.
    """
    model, path = ItemRewardModel(reward_model_sizes(train)), folder / _FITTED
    if path.exists():
        tensors, metadata = load_tensors(path)
        load_weights(path, model, tensors)
        with damage_explained(path, REMEDY):
            return TrainingUsers(model.eval(), TrainingUsersReport(**metadata))
    sessions = draw_sessions(train, seed)
    episodes, steps = sessions.all_steps()
    rows = RewardRows.at(sessions, episodes, steps, model.lags)
    set_statistics(model, rows, rows, train.item_states)
    # What the session shows of tastes is known already: states are features and observations.
    of_session = train.item_states.size - train.item_states.user_features.shape[1]
    model.state_std[:of_session] = torch.inf
    weights = None
    if weighted:
        weights = propensity_weights(sessions, episodes, steps, len(model.item))
    design = Design.of(model, rows, weights)
    begin = None if first is None else Beginning.of(first / _FITTED, design)
    search_design = design
    if begin is not None and not weighted:
        search_design = design.select(torch.arange(len(rows)) < WARM_ROWS)
    search = EffectSearch(search_design, search_design, begin).of_training()
    with progress(len(EFFECTS), "training users", "effects") as bar:
        for name in EFFECTS:
            search.add(name)
            bar.update()
    entries, held_back = search.report(), search.held_out
    spreads = {entry.effect: entry.spread for entry in entries if entry.kept}
    start = design.mean_effect() if begin is None else search.effects
    effects = fit_effects(design, start, spreads)
    model.set_effects(effects, design.of_content)
    scores = held_back.predictor(search.effects)
    line = fit_line(scores, held_back.target, held_back.binary, held_back.weights)
    report = TrainingUsersReport(line, entries, len(rows), design.count, weights is not None)
    save_fit(path, model, effects, dataclasses.asdict(report))
    return TrainingUsers(model.eval(), report)


def draw_sessions(train: EpisodeStore, seed: int) -> EpisodeStore:
    """The training sessions, in an order drawn by `seed`; of many, the first 100,000 steps."""
    order = np.random.default_rng([seed, 5]).permutation(train.n_episodes)
    last = int(np.searchsorted(np.cumsum(train.lengths[order]), _MAX_STEPS))
    return train.select(order[: last + 1])


def propensity_weights(
    view: EpisodeStore, episodes: IntArray, steps: IntArray, items: int
) -> Tensor | None:
    """What logged steps (M,) count for, as if all of `items` had been shown alike.

    Of each user in proportion to 1 / (p · items), cut off at 10. Their sum is the number of the
    user's steps of equal weight that count as much, (Σ w)² / Σ w² (Kish). None if the log does not
    have every p.
    """
    if schema.PROPENSITY not in view.record.columns:
        return None
    propensities = view.step_values(schema.PROPENSITY, episodes, steps).astype(np.float64)
    if not (propensities > 0).all():
        return None
    shares = np.minimum(1 / (propensities * items), _LARGEST_WEIGHT)
    owners = view.episode_values(schema.USER) if view.has_users else np.arange(view.n_episodes)
    users = np.unique(owners, return_inverse=True)[1][episodes]
    sums, squares = (np.bincount(users, weights=entry) for entry in (shares, np.square(shares)))
    return torch.from_numpy(shares * (sums / squares)[users]).float()


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
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
        rows, half = RewardRows.at(view, episodes, steps, model.reach), halve_users(view)[episodes]
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
            torch.tensor([half_line[n] for half_line in reversed(halves)])[torch.from_numpy(half)]
            for n in (0, 1)
        )
        expected = (counts * model.expected(slope * scores + intercept)).double().numpy()
        observed = (counts * rows.rewards).double().numpy()
        off = expected.sum() / observed.sum() - 1 if observed.sum() > 0 else 0.0
        by_user = np.bincount(episodes, expected - (1 + off) * observed)
        error = float(np.sqrt(np.square(by_user).sum()) / abs(observed.sum() or 1.0))
        return cls(line, (halves[0], halves[1]), float(off), error, weights is not None)


def halve_users(view: EpisodeStore) -> IntArray:
    """Half (E,) of the users, 0 or 1, to which the episodes of a view belong; of the episodes,
    where users are not named."""
    if not view.has_users:
        return np.arange(view.n_episodes) % 2
    return view.episode_values(schema.USER).astype(np.int64) % 2
