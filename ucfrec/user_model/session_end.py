"""When users leave: the probability that a session ends with a step, fitted to logged steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import pydantic
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.user_model.reward_report import SAVED
from ucfrec.user_model.trees import BoostedTrees

_PENALTY: Final = 1.0
"""L2 penalty of the logistic regression on standardised inputs."""
_LAGS: Final = 10
"""Items shown before that count: as many as a tag window of a decision rule may keep from being
repeated."""
_INPUTS: Final = 4 + _LAGS + 4 + 3
"""Number of inputs; see `_columns`."""
_STEPS: Final = [0, 1]
"""Numbers of the inputs that grow with the number of the step."""
_REWARD: Final = 3
"""Number of the input that is the step's reward."""
_FEWEST: Final = 20
"""Fewest steps that end a session, and that do not, from which more than their share is
estimated."""
_STEP: Final = 2.0**-10
"""Likeness is rounded to multiples of this: what torch and onnxruntime round differently then lies
on one side of a tree's threshold."""
_LOGISTIC: Final = ("highest", "mean", "scale", "weights", "bias")
_MOST: Final = 20.0
"""Largest log-odds against what happened that count, so that no single step decides."""


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
    followed: BoolArray
    """(N,) whether another session of the same user follows; true where users are not named."""

    @classmethod
    def of(cls, store: EpisodeStore, lags: int, most: int, seed: int) -> "LoggedEnds":
        """Steps of a view of a store of items, at most `most` of them, drawn at random.

        The last step of a session that is not terminated is excluded: the log may simply have ended
        there.
        """
        usable = store.lengths - ~store.terminated
        ends = np.cumsum(usable)
        numbers = np.arange(int(ends[-1]))
        if len(numbers) > most:
            sample = np.random.default_rng(seed).choice(len(numbers), most, replace=False)
            numbers = np.sort(sample)
        episodes = np.searchsorted(ends, numbers, side="right")
        steps = numbers - (ends - usable)[episodes]
        ended = steps == store.lengths[episodes] - 1
        shown = Shown.before(store, episodes, steps, lags)
        items = torch.from_numpy(store.step_values(schema.ITEM, episodes, steps).astype(np.int64))
        rewards = store.step_values(schema.REWARD, episodes, steps).astype(np.float64)
        followed = ~last_sessions(store) if store.has_users else np.ones(len(store), dtype=bool)
        return cls(shown, items, rewards, steps, ended, followed[episodes])

    def select(self, rows: BoolArray) -> "LoggedEnds":
        """Some of the steps."""
        shown, items = self.shown.at(torch.from_numpy(rows)), self.items[torch.from_numpy(rows)]
        columns = self.steps[rows], self.ended[rows], self.followed[rows]
        return LoggedEnds(shown, items, self.rewards[rows], *columns)


def last_sessions(store: EpisodeStore) -> BoolArray:
    """Whether each episode (E,) of a view is the last of its user."""
    users = store.episode_values(schema.USER)
    last = np.zeros(len(users), dtype=bool)
    last[len(users) - 1 - np.unique(users[::-1], return_index=True)[1]] = True
    return last


def whole_sessions(
    train: EpisodeStore, validation: EpisodeStore
) -> tuple[EpisodeStore, EpisodeStore]:
    """Sessions to fit models of their ends to, and held-out ones to choose a model by.

    These are training and validation sessions. But where most validation sessions go on from
    training sessions that the split by time cut, they lack the steps that say when they end: the
    training sessions of a fifth of the users are held out instead.
    """
    if not (train.has_users and validation.has_users):
        return train, validation
    users, cut = train.episode_values(schema.USER), ~train.terminated & last_sessions(train)
    if np.isin(validation.episode_values(schema.USER), users[cut]).mean() < 0.5:
        return train, validation
    held_out = users.astype(np.int64) % 5 == 4
    return train.select(np.flatnonzero(~held_out)), train.select(np.flatnonzero(held_out))


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class SessionEndReport:
    """How well session ends are predicted."""

    rows: int
    """Number of training steps fitted to."""
    validation_rows: int
    """Number of held-out steps."""
    loss: Mapping[str, float]
    """Held-out log loss (nats) of each kind of model: `constant`, `logistic` and `boosted`."""
    gain: Mapping[str, tuple[float, float]]
    """By how much it is below that of the kind that would be kept otherwise, and the standard
    error."""
    kept: str
    """The kind that is kept: each must lower the loss of simpler ones by more than the error."""
    last_sessions: bool = True
    """Whether ends of users' last sessions count; see `SessionEnd.fit`."""


@dataclass(frozen=True)
class SessionEnd:
    """The probability that a session ends with a step.

    A constant, a logistic regression, or boosted trees, of the number of the step, its reward, how
    alike its item is to each of the last ten, the largest of these over the last 2, 3, 4 and 10,
    and how often the item was shown in the last 1, 3 and 10.
    """

    likeness: Likeness
    tensors: Mapping[str, Tensor]
    """Those of `BoostedTrees`; or the `highest` (F,) inputs that count, so that steps later than
    logged ones are like the last, `mean` and `scale` (F,) of the inputs, `weights` (F,) and `bias`
    (), all float64."""
    uses_rewards: bool = field(init=False)
    """Whether the reward of the step counts."""
    _trees: BoostedTrees | None = field(init=False)

    @classmethod
    def fit(
        cls, likeness: Likeness, logged: LoggedEnds, held_out: LoggedEnds, seed: int
    ) -> tuple["SessionEnd", SessionEndReport]:
        """Fit every kind to logged steps, and keep the best on held-out ones.

        What looks like the end of a user's last session may only be the end of the user's rows. So
        everything is fitted without these ends, too, and that is kept if it clearly (by three
        standard errors) predicts held-out sessions better that another one follows.
        """
        every = cls._best(likeness, logged, held_out, seed)
        certain = held_out.select(held_out.followed)
        if logged.followed.all() or certain.ended.sum() < _FEWEST:
            return every
        sure, held_out = (
            entry.select(entry.followed | ~entry.ended) for entry in (logged, held_out)
        )
        without, report = cls._best(likeness, sure, held_out, seed)
        gain, error = _gain(every[0]._losses(certain), without._losses(certain))
        if gain <= 3 * error:
            return every
        return without, replace(report, last_sessions=False)

    @classmethod
    def _best(
        cls, likeness: Likeness, logged: LoggedEnds, held_out: LoggedEnds, seed: int
    ) -> tuple["SessionEnd", SessionEndReport]:
        """The best kind, fitted to all of `logged`."""
        inputs, ended = _inputs(likeness, logged), logged.ended
        kinds = {"constant": _logistic(inputs, ended, weights=False)}
        if _FEWEST <= ended.sum() <= len(ended) - _FEWEST:
            kinds["logistic"] = _logistic(inputs, ended)
            kinds["boosted"] = BoostedTrees.fit(inputs.numpy(), ended, seed).tensors()
        models = {kind: cls(likeness, tensors) for kind, tensors in kinds.items()}
        losses = {kind: model._losses(held_out) for kind, model in models.items()}
        gains, best = dict[str, tuple[float, float]](), "constant"
        for kind in kinds:
            gain, error = gains[kind] = _gain(losses[best], losses[kind])
            if gain > error:
                best = kind
        means = {kind: float(entry.mean()) if len(entry) else 0.0 for kind, entry in losses.items()}
        report = SessionEndReport(len(ended), len(held_out.ended), means, gains, best)
        return models[best], report

    def _losses(self, logged: LoggedEnds) -> Tensor:
        """Log losses (N,) of logged steps."""
        scores = self._log_odds(_inputs(self.likeness, logged))
        signed = torch.where(torch.from_numpy(logged.ended), -scores, scores)
        return F.softplus(signed.clamp(max=_MOST))

    @classmethod
    def of(cls, likeness: Likeness, tensors: Mapping[str, Tensor]) -> "SessionEnd":
        """From tensors of a file.

        Raises:
            KeyError: some are missing.
            ValueError: they are neither trees nor a regression of these inputs.
        """
        if "thresholds" in tensors:
            return cls(likeness, BoostedTrees.of(tensors, _INPUTS).tensors())
        parts = {name: tensors[name] for name in _LOGISTIC}
        for name, entry in parts.items():
            if (
                entry.shape != (() if name == "bias" else (_INPUTS,))
                or entry.dtype != torch.float64
            ):
                raise ValueError(f"{name} does not fit the inputs")
        return cls(likeness, parts)

    def __post_init__(self) -> None:
        trees = BoostedTrees(**self.tensors) if "thresholds" in self.tensors else None
        object.__setattr__(self, "_trees", trees)
        if trees is None:
            uses = bool(self.tensors["weights"][_REWARD] != 0)
        else:
            uses = bool((trees.inputs == _REWARD).any())
        object.__setattr__(self, "uses_rewards", uses)

    def probabilities(
        self, shown: Shown, items: Tensor, rewards: Float64Array, steps: IntArray
    ) -> Float64Array:
        """Probabilities (M,) that sessions end with a step; arguments as in `LoggedEnds`."""
        nothing = np.zeros(len(steps), dtype=bool)
        inputs = _inputs(self.likeness, LoggedEnds(shown, items, rewards, steps, nothing, nothing))
        return torch.sigmoid(self._log_odds(inputs)).numpy()

    def of_items(
        self, shown: Shown, items: Tensor, rewards: Sequence[Tensor], steps: Tensor
    ) -> list[Tensor]:
        """Probabilities (B, C) that sessions end if they show items, for each of some rewards.

        Args:
            items: (B, C) int64.
            rewards: R of (B, C) that the items would be given.
            steps: (B,) number of the step.
        """
        batch, count = items.shape
        lately = _pad_to_lags(shown.items).reshape(-1, 1)
        profiles = self.likeness.profile(lately, torch.ones(lately.shape))
        alike = self.likeness.to_candidates(profiles.view(batch, _LAGS, -1), items)
        repeated = shown.items.unsqueeze(2) == items.unsqueeze(1)
        number = steps.unsqueeze(1)
        if self._trees is None:
            inputs = [
                torch.stack(_columns(alike, repeated, entry, number), -1) for entry in rewards
            ]
            odds = self._log_odds(torch.cat(inputs).flatten(0, 1))
            return [*torch.sigmoid(odds).view(-1, batch, count).unbind(0)]
        columns = torch.stack(_columns(alike, repeated, rewards[0], number)).flatten(1)
        values = [entry.flatten() for entry in rewards]
        odds_of_each = self._trees.with_values(columns.T, _REWARD, values)
        return [torch.sigmoid(entry).view(batch, count) for entry in odds_of_each]

    def _log_odds(self, inputs: Tensor) -> Tensor:
        """(M,) from inputs (M, F), float64."""
        tensors = self.tensors
        if self._trees is not None:
            return self._trees(inputs)
        standard = (inputs.minimum(tensors["highest"]) - tensors["mean"]) / tensors["scale"]
        return standard @ tensors["weights"] + tensors["bias"]


def _logistic(inputs: Tensor, ended: BoolArray, weights: bool = True) -> dict[str, Tensor]:
    """Tensors of a logistic regression; without `weights`, of its bias alone."""
    from sklearn.linear_model import LogisticRegression

    size = inputs.shape[1]
    zeros, highest = inputs.new_zeros(size), inputs.new_full((size,), torch.inf)
    if not weights:
        bias = torch.logit(torch.tensor(float(ended.mean()) if len(ended) else 0.0).double())
        parts = {"mean": zeros, "scale": zeros + 1, "weights": zeros.clone(), "bias": bias}
        return {"highest": highest, **parts}
    # The last steps of the longest sessions are too few to tell more than those before.
    highest[_STEPS] = inputs[:, _STEPS].topk(_FEWEST, 0).values[-1]
    inputs = inputs.minimum(highest)
    mean, spread = inputs.mean(0), inputs.std(0, correction=0)
    scale = torch.where(spread > 0, spread, 1.0)
    model = LogisticRegression(C=1 / _PENALTY, max_iter=1000)
    model.fit(((inputs - mean) / scale).numpy(), ended)
    fitted = {
        "weights": torch.from_numpy(model.coef_[0]),
        "bias": torch.tensor(model.intercept_[0]),
    }
    return {"highest": highest, "mean": mean, "scale": scale, **fitted}


def _pad_to_lags(items: Tensor) -> Tensor:
    """The latest items of (M, L) shown, (M, 10); −1 where there are fewer."""
    return F.pad(items[:, :_LAGS], (0, max(0, _LAGS - items.shape[1])), value=-1)


def _gain(losses: Tensor, columns: Tensor) -> tuple[float, float]:
    """By how much the mean of `others` is lower, and the standard error; 0 without rows."""
    decrease = losses - columns
    if not len(decrease):
        return 0.0, 0.0
    return float(decrease.mean()), float(decrease.std(correction=0)) / len(decrease) ** 0.5


def _inputs(likeness: Likeness, logged: LoggedEnds) -> Tensor:
    """(M, F) inputs of logged steps."""
    shown, items = logged.shown, logged.items.unsqueeze(1)
    alike = likeness.between(_pad_to_lags(shown.items), items)
    rewards, steps = torch.from_numpy(logged.rewards), torch.from_numpy(logged.steps)
    return torch.stack(_columns(alike, shown.items == items, rewards, steps), -1)


def _columns(alike: Tensor, repeated: Tensor, rewards: Tensor, steps: Tensor) -> list[Tensor]:
    """F inputs (M, ...) from likeness (M, 10, ...) and repetition (M, L, ...), latest first."""
    numbers = steps.double().expand(rewards.shape)
    columns = [torch.log1p(numbers), numbers, numbers.clamp(max=1), rewards.double()]
    alike = (alike.double() / _STEP).round() * _STEP
    columns += [*alike.unbind(1)]
    columns += [alike[:, :reach].amax(1) for reach in (2, 3, 4, _LAGS)]
    columns += [repeated[:, :reach].sum(1).double() for reach in (1, 3, _LAGS)]
    return columns
