"""The steps that reward models of items are fitted to, and how good they are on held-out ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
import pydantic
import torch
from pydantic import ConfigDict
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.user_model.reward import PLACES, ItemRewardModel

_BINS = 10
_AT_ONCE = 16_384
_LARGEST_WEIGHT = 10.0
"""Larger weights are cut off, so that no single row decides."""
SAVED = ConfigDict(extra="forbid")
"""Of reports that are saved beside their subject, and read again."""
Line = tuple[float, float]


@dataclass(frozen=True)
class RewardRows:
    """M logged steps: what was shown to whom, after what, and the reward."""

    items: Tensor
    users: Tensor
    """(M,) int64 numbers in the store; −1 if the store does not name its users."""
    times: Tensor
    """(M,) int64 ms of the decisions; (0,) if the store does not have them."""
    history: Shown
    """The items shown earlier in the session, (M, lags)."""
    states: Tensor
    """(M, S) float32 states before the step."""
    rewards: Tensor
    """(M,) float32, in reward units."""
    observations: int
    """O, the last numbers of the states: what was observed beside the session itself."""
    offer: Offer | None
    """What was on offer; None for everything."""
    above: Tensor
    """(M, P) int64 items above it in its own list, −1 for none; P is 0 where there are no lists."""

    def __len__(self) -> int:
        return len(self.items)

    @classmethod
    def of(
        cls,
        view: EpisodeStore,
        lags: int,
        limit: int,
        seed: int,
    ) -> "RewardRows":
        """All steps of a view of a store of items; of more than `limit`, so many drawn."""
        episodes, steps = draw_steps(view, limit, seed)
        return cls.at(view, episodes, steps, lags)

    @classmethod
    def at(
        cls,
        view: EpisodeStore,
        episodes: IntArray,
        steps: IntArray,
        lags: int,
    ) -> "RewardRows":
        """The given steps (M,) of a view, with the latest `lags` items shown before them."""
        states = torch.empty(len(steps), view.state_size)
        for start in range(0, len(steps), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            states[part] = view.windows(episodes[part], steps[part], 1).states[:, 0]
        users = np.full(view.n_episodes, -1)
        if view.has_users:
            users = view.episode_values(schema.USER)
        starts = view.decision_starts(episodes, steps)
        times = np.zeros(0, dtype=np.int64)
        if schema.TIMESTAMP in view.record.columns:
            times = view.step_values(schema.TIMESTAMP, episodes, starts)
        return cls(
            torch.from_numpy(view.items_at(episodes, steps)),
            torch.from_numpy(users[episodes]),
            torch.from_numpy(times),
            Shown.before(view, episodes, starts, lags),
            states,
            torch.from_numpy(view.step_values(schema.REWARD, episodes, steps)),
            view.observation_size,
            view.offer(episodes, steps),
            torch.from_numpy(view.items_above(episodes, steps, PLACES)),
        )


def draw_steps(view: EpisodeStore, limit: int, seed: int) -> tuple[IntArray, IntArray]:
    """Episodes and steps (M,) of all steps of a view; of more than `limit`, so many drawn."""
    return view.locate(draw_numbers(view.n_steps, limit, seed))


def draw_episodes(view: EpisodeStore, most: int, seed: int | list[int]) -> IntArray:
    """Positions of episodes of a view in a drawn order; of many, the first with `most` steps."""
    order = np.random.default_rng(seed).permutation(view.n_episodes)
    last = int(np.searchsorted(np.cumsum(view.lengths[order]), most))
    return order[: last + 1]


def draw_numbers(count: int, limit: int, seed: int) -> IntArray:
    """The numbers below `count`; of more than `limit`, so many drawn."""
    if count <= limit:
        return np.arange(count)
    return np.sort(np.random.default_rng(seed).choice(count, limit, replace=False))


def mean_gain(losses: Tensor, lower: Tensor) -> tuple[float, float]:
    """By how much the mean of `lower` is lower, and the standard error; 0 without rows."""
    decrease = losses - lower
    if not len(decrease):
        return 0.0, 0.0
    return float(decrease.mean()), float(decrease.std(correction=0)) / len(decrease) ** 0.5


def weigh_by_propensity(
    view: EpisodeStore,
    episodes: IntArray,
    steps: IntArray,
    items: int,
) -> Tensor | None:
    """What logged steps (M,) count for, as if all of `items` had been shown alike: of each user in
    proportion to 1 / (p · items), cut off at 10, with the sum (Σ w)² / Σ w², their effective number
    (Pfeffermann et al., 1998, "Weighting for unequal selection probabilities in multilevel
    models"). None if the log does not have every p."""
    propensities = read_propensities(view, episodes, steps)
    if propensities is None:
        return None
    shares = np.minimum(1 / (propensities * items), _LARGEST_WEIGHT)
    users = np.unique(number_users(view), return_inverse=True)[1][episodes]
    factors = np.bincount(users, shares) / np.bincount(users, np.square(shares))
    return torch.from_numpy(shares * factors[users]).float()


def read_propensities(
    view: EpisodeStore, episodes: IntArray, steps: IntArray
) -> Float64Array | None:
    """Propensities of logged steps (M,); None if the log does not have every one."""
    if schema.PROPENSITY not in view.record.columns:
        return None
    values = view.step_values(schema.PROPENSITY, episodes, steps).astype(np.float64)
    return values if (values > 0).all() else None


def number_users(view: EpisodeStore) -> IntArray:
    """Users (E,) of the episodes of a view; the episodes, where users are not named."""
    return view.episode_values(schema.USER) if view.has_users else np.arange(view.n_episodes)


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class EffectTried:
    """One effect, with the spread that predicts held-out rewards best."""

    effect: str
    spread: float
    """Standard deviation, a priori, of what it adds to the linear predictor."""
    gain: float
    gain_error: float
    kept: bool
    """Whether it is part of the model: the gain is above its standard error."""


@pydantic.dataclasses.dataclass(frozen=True)
class ItemRewardReport:
    """Losses of the reward model of items on held-out rows: nats if rewards have two values, else
    squared errors of standardised rewards."""

    effects: tuple[EffectTried, ...]
    """The effects in the order in which they were tried."""
    base_loss: float
    item_loss: float
    loss: float
    new_users: bool = False
    """Whether held-out users have no training rows, and effects of users are not kept."""

    @property
    def kept(self) -> Mapping[str, float]:
        """Spreads of the effects that are part of the model, by name."""
        return {entry.effect: entry.spread for entry in self.effects if entry.kept}


def score_rows(model: ItemRewardModel, rows: RewardRows) -> Tensor:
    """Linear predictors (M,) of the items shown in `rows`."""
    sums = None if model.user_rows is None else model.sums_before(rows.users, rows.times)
    scores = [
        model.score(
            rows.states[part],
            rows.history.at(part),
            rows.users[part],
            rows.items[part],
            rows.offer and rows.offer.change(itemgetter(part)),
            rows.above[part],
            None if sums is None else sums[part],
        )
        for part in torch.split(torch.arange(len(rows)), _AT_ONCE)
    ]
    return torch.cat(scores)


def calibration_error(predicted: Float64Array, observed: Float64Array) -> float:
    """Mean over rows (M,), in 10 bins of equal size by predicted reward, of the difference between
    the mean predicted and the mean observed reward of their bin."""
    order = np.argsort(predicted, kind="stable")
    off = [part.sum() for part in np.array_split((predicted - observed)[order], _BINS)]
    return float(np.abs(off).sum()) / len(order)


def fit_line(
    scores: Tensor,
    target: Tensor,
    binary: bool,
    weights: Tensor | None = None,
) -> Line:
    """Slope and intercept of the scores (M,) that fit the target (M,) best: by logistic regression
    if it is `binary`, otherwise by least squares."""
    from sklearn.linear_model import LinearRegression, LogisticRegression

    inputs = scores.double().numpy().reshape(-1, 1)
    outcomes = target.double().numpy()
    counts = None if weights is None else weights.double().numpy()
    if binary and 0 < outcomes.mean() < 1:
        model = LogisticRegression(C=np.inf, max_iter=1000).fit(inputs, outcomes > 0, counts)
        return float(model.coef_[0, 0]), float(model.intercept_[0])
    if binary:
        return 1.0, 0.0
    model = LinearRegression().fit(inputs, outcomes, counts)
    return float(model.coef_[0]), float(model.intercept_)


def calibrate(
    model: ItemRewardModel,
    view: EpisodeStore,
    limit: int,
    seed: int,
) -> Line:
    """Slope and intercept that turn scores into rewards, from at most `limit` drawn steps of a
    view, weighted by propensities if all steps have one."""
    episodes, steps = draw_steps(view, limit, seed)
    rows = RewardRows.at(view, episodes, steps, model.reach)
    weights = weigh_by_propensity(view, episodes, steps, len(model.item))
    target = model.target(rows.rewards)
    return fit_line(score_rows(model, rows), target, bool(model.binary), weights)
