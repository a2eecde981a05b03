"""The steps that the reward model of items is fitted to, and how good it is on held-out ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import pydantic
import torch
from pydantic import BeforeValidator, ConfigDict
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.results.statistics import group_auc, ratio_with_error
from ucfrec.user_model.reward import ItemRewardModel

_BINS: Final = 10
_PRIOR: Final = 10.0
"""Impressions at the mean rate that are added to an item's counts in `item_rates`."""
_CHUNK: Final = 16_384
_READ_AT_ONCE: Final = 65_536
SAVED: Final = ConfigDict(extra="forbid")
"""Of reports that are saved beside what they are of, and read again."""
_OrNaN = Annotated[float, BeforeValidator(lambda value: np.nan if value is None else value)]
"""Undefined in a log that shows too little, and then null in JSON."""


@dataclass(frozen=True)
class RewardRows:
    """M logged steps: what was shown to whom, after what, and the reward."""

    items: Tensor
    """(M,) int64."""
    users: Tensor
    """(M,) int64 numbers in the store; −1 if the store does not name its users."""
    shown: Shown
    """The items shown earlier in the session, (M, lags)."""
    states: Tensor
    """(M, S) float32 states before the step."""
    rewards: Tensor
    """(M,) float32, in reward units."""
    observations: int
    """O, the last numbers of the states: what was observed beside the session itself."""

    def __len__(self) -> int:
        return len(self.items)

    @classmethod
    def of(cls, view: EpisodeStore, lags: int, limit: int, seed: int) -> "RewardRows":
        """All steps of a view of a store of items; of more than `limit`, so many drawn by `seed`.

        Of what was shown earlier, the latest `lags` steps are read. Nothing of a step but its item
        and reward is read, nor anything of later steps.
        """
        return cls.at(view, *drawn_steps(view, limit, seed), lags)

    @classmethod
    def at(cls, view: EpisodeStore, episodes: IntArray, steps: IntArray, lags: int) -> "RewardRows":
        """The given steps (M,) of a view."""
        states = torch.empty(len(steps), view.state_size)
        for start in range(0, len(steps), _READ_AT_ONCE):
            part = slice(start, start + _READ_AT_ONCE)
            states[part] = view.windows(episodes[part], steps[part], 1).states[:, 0]
        return cls(
            torch.from_numpy(view.step_values(schema.ITEM, episodes, steps).astype(np.int64)),
            torch.from_numpy(_users(view)[episodes]),
            _shown(view, episodes, steps, lags),
            states,
            torch.from_numpy(view.step_values(schema.REWARD, episodes, steps)),
            view.observation_size,
        )


def drawn_steps(view: EpisodeStore, limit: int, seed: int) -> tuple[IntArray, IntArray]:
    """Episodes and steps (M,) of all steps of a view; of more than `limit`, so many drawn."""
    numbers = np.arange(view.n_steps)
    if view.n_steps > limit:
        sample = np.random.default_rng(seed).choice(view.n_steps, limit, replace=False)
        numbers = np.sort(sample)
    return view.locate(numbers)


def _shown(view: EpisodeStore, episodes: IntArray, steps: IntArray, lags: int) -> Shown:
    earlier = steps[:, None] - np.arange(1, lags + 1)
    at = (episodes[:, None], np.maximum(earlier, 0))
    items = np.where(earlier >= 0, view.step_values(schema.ITEM, *at), -1).astype(np.int64)
    rewards = np.where(earlier >= 0, view.step_values(schema.REWARD, *at), 0).astype(np.float32)
    return Shown(torch.from_numpy(items), torch.from_numpy(rewards))


def _users(view: EpisodeStore) -> IntArray:
    if not view.has_users:
        return np.full(view.n_episodes, -1)
    return view.episode_values(schema.USER).astype(np.int64)


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class EffectTried:
    """One effect, with the spread that predicts held-out rewards best."""

    effect: str
    """Its name, one of `EFFECTS`."""
    spread: float
    """Standard deviation, a priori, of what it adds to the linear predictor."""
    gain: float
    """Decrease of the held-out loss by the effect."""
    gain_error: float
    """Standard error of `gain`."""
    kept: bool
    """Whether it is part of the model: the gain is above its standard error."""


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class Calibration:
    """Held-out rows in 10 bins of equal size by predicted reward, in ascending order."""

    predicted: tuple[float, ...]
    """Mean predicted reward of each bin, in reward units."""
    observed: tuple[float, ...]
    """Mean reward of each bin."""
    count: tuple[int, ...]
    """Rows of each bin."""
    error: float
    """Expected calibration error: mean over rows of |predicted − observed| of their bins."""


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class ItemRewardReport:
    """Quality of the reward model of items, on held-out rows."""

    train_rows: int
    """Number of rows fitted to."""
    validation_rows: int
    """Number of held-out rows."""
    binary: bool
    """Whether rewards have two values: the loss is the log loss in nats, otherwise half the squared
    error of standardised rewards."""
    effects: tuple[EffectTried, ...]
    """The effects in the order in which they were tried."""
    base_loss: float
    """Held-out loss of the training mean."""
    item_loss: float
    """Held-out loss of item effects alone."""
    loss: float
    """Held-out loss of the model."""
    r2: _OrNaN
    """R² of the expected reward on held-out rows."""
    calibration: Calibration
    """Predicted and observed rewards."""
    gauc: _OrNaN
    """Probability that a liked step scores higher than another of the same user, by impressions.

    What all items share at a step (user and state) is excluded of the scores: it does not rank
    items, and as the state contains the last reward, it would compare a user's steps by what was
    liked before them."""
    gauc_error: _OrNaN
    """Standard error of `gauc`, over users."""
    item_rate_gauc: _OrNaN
    """`gauc` of the items' training rates of liked steps, 10 impressions at the mean added."""
    gauc_gain: _OrNaN
    """`gauc` minus `item_rate_gauc`."""
    gauc_gain_error: _OrNaN
    """Standard error of `gauc_gain`, over users."""
    seconds: float
    """Processor time of the fit."""
    new_users: bool = False
    """Whether held-out rows are of users without training rows: the effects of users only served to
    tell those of items, and are not part of the model."""

    @property
    def kept(self) -> Mapping[str, float]:
        """Spreads of the effects that are part of the model, by name."""
        return {entry.effect: entry.spread for entry in self.effects if entry.kept}


def scores_of(model: ItemRewardModel, rows: RewardRows) -> tuple[Tensor, Tensor]:
    """Linear predictors (M,) of the items shown in `rows`, and what all items share in them."""
    scores, levels = [torch.zeros(0)], [torch.zeros(0)]
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        states, users = rows.states[part], rows.users[part]
        scores.append(model.score(states, rows.shown.at(part), users, rows.items[part]))
        levels.append(model.level(states, users, model.tastes_after(rows.shown.at(part))))
    return torch.cat(scores), torch.cat(levels)


def calibration(predicted: Float64Array, observed: Float64Array) -> Calibration:
    """The calibration of predicted rewards (M,) against observed ones (M,)."""
    order = np.argsort(predicted, kind="stable")
    bins = [part for part in np.array_split(order, _BINS) if len(part)]
    means = np.array([[predicted[part].mean(), observed[part].mean()] for part in bins])
    count = np.array([len(part) for part in bins])
    return Calibration(
        predicted=tuple(means[:, 0].tolist()),
        observed=tuple(means[:, 1].tolist()),
        count=tuple(count.tolist()),
        error=float((np.abs(means[:, 0] - means[:, 1]) * count).sum() / count.sum()),
    )


def fit_line(
    scores: Tensor, target: Tensor, binary: bool, weights: Tensor | None = None
) -> tuple[float, float]:
    """Slope and intercept of the scores (M,) that fit the target (M,) best.

    By logistic regression of targets 0 and 1 if `binary`, by least squares otherwise. Rows of
    `weights` (M,) count so many times.
    """
    from sklearn.linear_model import LinearRegression, LogisticRegression

    inputs, outcomes = scores.double().numpy().reshape(-1, 1), target.double().numpy()
    counts = None if weights is None else weights.double().numpy()
    if binary and 0 < outcomes.mean() < 1:
        fitted = LogisticRegression(C=np.inf, max_iter=1000).fit(inputs, outcomes > 0, counts)
        return float(fitted.coef_[0, 0]), float(fitted.intercept_[0])
    if binary:
        return 1.0, 0.0
    fitted = LinearRegression().fit(inputs, outcomes, counts)
    return float(fitted.coef_[0]), float(fitted.intercept_)


def item_rates(rows: RewardRows, liked: Tensor, n_items: int) -> Tensor:
    """(n_items,) share of liked rows of each item, 10 impressions at the mean added."""
    shown = torch.bincount(rows.items, minlength=n_items).double()
    likes = torch.bincount(rows.items, weights=liked.double(), minlength=n_items)
    return (likes + _PRIOR * likes.sum() / shown.sum()) / (shown + _PRIOR)


def gauc_against(
    scores: Tensor, reference: Tensor, liked: Tensor, users: Tensor
) -> Mapping[str, float]:
    """GAUC of `scores` and of `reference`, each (M,), and their difference, as report fields."""
    _, owner = np.unique(users.numpy(), return_inverse=True)
    n_users = int(owner.max(initial=-1)) + 1
    above, below = group_auc(scores.double().numpy(), liked.numpy(), owner, n_users)
    baseline, _ = group_auc(reference.double().numpy(), liked.numpy(), owner, n_users)
    value, error = ratio_with_error(above, below)
    gain, gain_error = ratio_with_error(above - baseline, below)
    return {
        "gauc": value,
        "gauc_error": error,
        "item_rate_gauc": value - gain,
        "gauc_gain": gain,
        "gauc_gain_error": gain_error,
    }
