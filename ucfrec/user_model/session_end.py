"""When users leave: the probability that a session ends with a step, fitted to logged steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float64Array, IntArray
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors
from ucfrec.user_model.reward import ItemRewardModel, compare_to_history
from ucfrec.user_model.reward_report import draw_numbers, mean_gain

SESSIONS = "sessions.safetensors"
"""File of session ends, fatigue and calibration in the model's folder."""
_PENALTY = 1.0
"""L2 penalty of the logistic regression on standardised inputs."""
_LAGS = 10
"""Items shown before that count, as many as a tag window may keep from being repeated."""
_INPUTS = 4 + _LAGS + 4 + 3
"""Number of inputs; see `_columns`."""
_STEPS = [0, 1]
"""Numbers of the inputs that grow with the number of the step."""
_REWARD = 3
"""Number of the input that is the reward: of the step, or of the whole list."""
_FEWEST = 20
"""Fewest steps that end a session, and that do not, that tell more than their share."""
_STEP = 2.0**-10
"""Likeness is rounded to multiples of this, so that torch and onnxruntime agree on thresholds."""
_HIGHEST = 20.0
"""Largest log-odds against what happened that count, so that no single step decides."""
TREES = 100
LEAVES = 8
"""Most trees, and leaves of a tree."""
_SETTINGS: dict[str, Any] = {
    "learning_rate": 0.2,
    "max_iter": TREES,
    "max_leaf_nodes": LEAVES,
    "early_stopping": True,
}
_ROWS = 256
"""Rows that trees are evaluated on at once, whose numbers the processor keeps at hand."""
_SPLITS = LEAVES - 1
_LOGISTIC = ("highest", "mean", "scale", "weights", "bias")


@dataclass(frozen=True)
class LoggedEnds:
    """Logged steps, and whether they ended their sessions."""

    inputs: Tensor
    """(N, F) of `describe_steps`."""
    ended: BoolArray
    followed: BoolArray
    """(N,) whether another session of the same user follows; true where users are not named."""

    @classmethod
    def of(
        cls,
        store: EpisodeStore,
        likeness: Likeness,
        lags: int,
        most: int,
        seed: int,
    ) -> "LoggedEnds":
        """Steps of a view, at most `most` of them, drawn at random; without the last one of a
        session that is not terminated, where the log may simply have ended."""
        usable = store.lengths - ~store.terminated
        ends = np.cumsum(usable)
        numbers = draw_numbers(int(ends[-1]), most, seed)
        episodes = np.searchsorted(ends, numbers, side="right")
        steps = numbers - (ends - usable)[episodes]
        # A list is shown whole: sessions end with the last row of a decision.
        last = store.decision_ends(episodes, steps) == steps + 1
        episodes, steps = episodes[last], steps[last]
        items = store.items_at(episodes, steps)
        starts = store.decision_starts(episodes, steps)
        counts = steps + 1 - starts
        owner = np.repeat(np.arange(len(steps)), counts)
        of_list = starts[owner] + np.arange(len(owner)) - (counts.cumsum() - counts)[owner]
        earned = store.step_values(schema.REWARD, episodes[owner], of_list)
        rewards = np.bincount(owner, earned, len(steps)).astype(np.float64)
        history = Shown.before(store, episodes, steps, lags)
        inputs = describe_steps(likeness, history, torch.from_numpy(items), rewards, steps)
        followed = ~last_sessions(store) if store.has_users else np.ones(len(store), dtype=bool)
        return cls(inputs, steps == store.lengths[episodes] - 1, followed[episodes])

    def select(self, rows: BoolArray) -> "LoggedEnds":
        inputs = self.inputs[torch.from_numpy(rows)]
        return LoggedEnds(inputs, self.ended[rows], self.followed[rows])


def last_sessions(store: EpisodeStore) -> BoolArray:
    """Whether each episode (E,) of a view is the last of its user."""
    users = store.episode_values(schema.USER)
    last = np.zeros(len(users), dtype=bool)
    last[len(users) - 1 - np.unique(users[::-1], return_index=True)[1]] = True
    return last


def whole_sessions(
    train: EpisodeStore, validation: EpisodeStore
) -> tuple[EpisodeStore, EpisodeStore]:
    """Sessions to fit models of their ends to, and held-out ones: of a fifth of training users
    where most validation sessions go on from training sessions that the split cut."""
    if not (train.has_users and validation.has_users):
        return train, validation
    users = train.episode_values(schema.USER)
    cut = ~train.terminated & last_sessions(train)
    if np.isin(validation.episode_values(schema.USER), users[cut]).mean() < 0.5:
        return train, validation
    return train.divide(users % 5 == 4)


@pydantic.dataclasses.dataclass(frozen=True)
class SessionEndReport:
    """How well session ends are predicted."""

    loss: Mapping[str, float]
    """Held-out log loss (nats) of each kind of model: `constant`, `logistic` and `boosted`."""
    kept: str
    """The kind that is kept: each must lower the loss of simpler ones by more than the error."""
    last_sessions: bool = True
    """Whether ends of users' last sessions count; see `SessionEnd.fit`."""


class SessionEnd:
    """The probability that a session ends with a step: a constant, a logistic regression, or
    boosted trees, of the number of the step, its reward or that of its whole list, how alike its
    item is to each of the last ten, the largest of these over the last 2, 3, 4 and 10, and how
    often the item was shown in the last 1, 3 and 10."""

    def __init__(self, likeness: Likeness, tensors: Mapping[str, Tensor]) -> None:
        """Of tensors of `BoostedTrees`; or, float64, of the `highest` (F,) inputs that count, their
        `mean` and `scale` (F,), `weights` (F,) and `bias` ()."""
        self.tensors, self._likeness = tensors, likeness
        self._trees = BoostedTrees(**tensors) if "thresholds" in tensors else None
        uses = tensors["weights"][_REWARD] if self._trees is None else tensors["inputs"] == _REWARD
        self.uses_rewards = bool(uses.any())
        """Whether the reward of the step counts."""

    @classmethod
    def of(cls, likeness: Likeness, tensors: Mapping[str, Tensor]) -> "SessionEnd":
        """From tensors of a file; KeyError or ValueError unless they fit these inputs."""
        shapes: dict[str, tuple[int, ...]] = {**dict.fromkeys(_LOGISTIC, (_INPUTS,)), "bias": ()}
        parts = {}
        if "thresholds" in tensors:
            parts["inputs"] = inputs = tensors["inputs"]
            trees, splits = inputs.shape
            is_beyond = bool(((inputs < 0) | (inputs >= _INPUTS)).any())
            if is_beyond or splits > _SPLITS or inputs.dtype != torch.int64:
                raise ValueError("inputs are beyond the last input")
            shapes = {"thresholds": (trees, splits), "leaves": (trees, 2**splits), "base": ()}
        for name, shape in shapes.items():
            parts[name] = tensors[name]
            if parts[name].shape != shape or parts[name].dtype != torch.float64:
                raise ValueError(f"{name} does not fit the inputs")
        return cls(likeness, parts)

    @classmethod
    def fit(
        cls,
        likeness: Likeness,
        logged: LoggedEnds,
        held_out: LoggedEnds,
        seed: int,
    ) -> tuple["SessionEnd", SessionEndReport]:
        """Fit every kind to logged steps, and keep the best on held-out ones: without the ends of
        users' last sessions, which may only be those of their rows, if that clearly (by three
        standard errors) predicts held-out sessions better that another one follows."""
        best = cls._fit_best(likeness, logged, held_out, seed)
        certain = held_out.select(held_out.followed)
        if logged.followed.all() or certain.ended.sum() < _FEWEST:
            return best
        sure, held_out = (rows.select(rows.followed | ~rows.ended) for rows in (logged, held_out))
        without, report = cls._fit_best(likeness, sure, held_out, seed)
        gain, error = mean_gain(best[0]._losses(certain), without._losses(certain))
        if gain <= 3 * error:
            return best
        return without, replace(report, last_sessions=False)

    @classmethod
    def _fit_best(
        cls,
        likeness: Likeness,
        logged: LoggedEnds,
        held_out: LoggedEnds,
        seed: int,
    ) -> tuple["SessionEnd", SessionEndReport]:
        inputs, ended = logged.inputs, logged.ended
        kinds = {"constant": _logistic(inputs, ended, weights=False)}
        if _FEWEST <= ended.sum() <= len(ended) - _FEWEST:
            kinds["logistic"] = _logistic(inputs, ended)
            kinds["boosted"] = fit_trees(inputs.numpy(), ended, seed)
        models = {kind: cls(likeness, tensors) for kind, tensors in kinds.items()}
        losses = {kind: model._losses(held_out) for kind, model in models.items()}
        best = "constant"
        for kind in kinds:
            gain, error = mean_gain(losses[best], losses[kind])
            if gain > error:
                best = kind
        means = {kind: float(entry.mean()) if len(entry) else 0.0 for kind, entry in losses.items()}
        return models[best], SessionEndReport(means, best)

    def _losses(self, rows: LoggedEnds) -> Tensor:
        odds = self._log_odds(rows.inputs)
        signed = torch.where(torch.from_numpy(rows.ended), -odds, odds)
        return F.softplus(signed.clamp(max=_HIGHEST))

    def probabilities(
        self,
        history: Shown,
        items: Tensor,
        rewards: Float64Array,
        steps: IntArray,
    ) -> Float64Array:
        """Probabilities (M,) that sessions end with a step; see `describe_steps`."""
        inputs = describe_steps(self._likeness, history, items, rewards, steps)
        return torch.sigmoid(self._log_odds(inputs)).numpy()

    def score_items(
        self,
        history: Shown,
        items: Tensor,
        rewards: Sequence[Tensor],
        steps: Tensor,
    ) -> list[Tensor]:
        """Probabilities (B, C) that sessions end after items (B, C) at steps (B,), by reward."""
        batch, count = items.shape
        lately, _ = history.padded(_LAGS)
        profiles = self._likeness.profile(lately.reshape(-1, 1), torch.ones(batch * _LAGS, 1))
        alike = self._likeness.to_candidates(profiles.view(batch, _LAGS, -1), items)
        repeated = history.items.unsqueeze(2) == items.unsqueeze(1)
        number = steps.unsqueeze(1)
        columns = (_columns(alike, repeated, entry, number) for entry in rewards)
        inputs = torch.cat([torch.stack(entries).flatten(1) for entries in columns], 1)
        odds = self._log_odds(inputs.T)
        return [*torch.sigmoid(odds).view(-1, batch, count).unbind(0)]

    def _log_odds(self, inputs: Tensor) -> Tensor:
        if self._trees is not None:
            return self._trees(inputs)
        highest, mean, scale, weights, bias = map(self.tensors.__getitem__, _LOGISTIC)
        return (inputs.minimum(highest) - mean) / scale @ weights + bias


def load_session_end(folder: Path, reward: ItemRewardModel | None) -> SessionEnd | None:
    """The model of session ends in the folder of a user model; None if there is none."""
    path = folder / SESSIONS
    if reward is None or not path.exists():
        return None
    tensors, _ = load_tensors(path)
    with damage_explained(path, REMEDY):
        return SessionEnd.of(reward.likeness, tensors)


def _logistic(inputs: Tensor, ended: BoolArray, weights: bool = True) -> dict[str, Tensor]:
    """Tensors of a logistic regression; without `weights`, of its bias alone."""
    from sklearn.linear_model import LogisticRegression

    size = inputs.shape[1]
    zeros, highest = inputs.new_zeros(size), inputs.new_full((size,), torch.inf)
    if not weights:
        bias = torch.logit(torch.tensor(float(ended.mean()) if len(ended) else 0.0).double())
        return dict(zip(_LOGISTIC, (highest, zeros, zeros + 1, zeros, bias), strict=True))
    # The last steps of the longest sessions are too few to tell more than those before.
    highest[_STEPS] = inputs[:, _STEPS].topk(_FEWEST, 0).values[-1]
    inputs = inputs.minimum(highest)
    mean, spread = inputs.mean(0), inputs.std(0, correction=0)
    scale = torch.where(spread > 0, spread, 1.0)
    model = LogisticRegression(C=1 / _PENALTY, max_iter=1000)
    model.fit(((inputs - mean) / scale).numpy(), ended)
    slopes, bias = torch.from_numpy(model.coef_[0]), torch.tensor(model.intercept_[0])
    return dict(zip(_LOGISTIC, (highest, mean, scale, slopes, bias), strict=True))


def describe_steps(
    likeness: Likeness,
    history: Shown,
    items: Tensor,
    rewards: Float64Array,
    steps: IntArray,
) -> Tensor:
    """(M, F) inputs of steps at which items (M,) were shown, after what was shown before."""
    alike = compare_to_history(likeness, history.padded(_LAGS).items, items)
    repeated = history.items == items.unsqueeze(1)
    columns = _columns(alike, repeated, torch.from_numpy(rewards), torch.from_numpy(steps))
    return torch.stack(columns, -1)


def _columns(
    alike: Tensor,
    repeated: Tensor,
    rewards: Tensor,
    steps: Tensor,
) -> list[Tensor]:
    """F inputs (M, ...) from likeness (M, 10, ...) and repetition (M, L, ...), latest first."""
    numbers = steps.double().expand(rewards.shape)
    alike = (alike.double() / _STEP).round() * _STEP
    return [
        *(torch.log1p(numbers), numbers, numbers.clamp(max=1), rewards.double()),
        *alike.unbind(1),
        *(alike[:, :reach].amax(1) for reach in (2, 3, 4, _LAGS)),
        *(repeated[:, :reach].sum(1).double() for reach in (1, 3, _LAGS)),
    ]


class BoostedTrees:
    """The sum of T regression trees of at most S splits, as tables: which of its splits' inputs are
    at most their threshold selects a tree's leaf."""

    def __init__(
        self,
        inputs: Tensor,
        thresholds: Tensor,
        leaves: Tensor,
        base: Tensor,
    ) -> None:
        """From int64 numbers of the splits' `inputs` (T, S) and, float64, their `thresholds`
        (T, S), the `base` () of the sum, and `leaves` (T, 2^S) by numbers whose bit s is set where
        split s finds an input that is at most its threshold."""
        self._leaves, self._base = leaves, base
        self._powers = 2.0 ** torch.arange(inputs.shape[1])
        # First splits of all trees, second ones, and so on.
        self._numbers = inputs.T.flatten()
        self._thresholds = thresholds.T.reshape(-1, 1)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Log-odds (M,) from inputs (M, F)."""
        return self._base + self._find_leaves(inputs).sum(0)

    def stages(self, inputs: Tensor) -> Tensor:
        """Log-odds (T, M) from inputs (M, F) by the first tree, the first two, and so on."""
        return self._base + self._find_leaves(inputs).cumsum(0)

    def _find_leaves(self, inputs: Tensor) -> Tensor:
        """(T, M) values of the trees' leaves."""
        columns = inputs.double().T.contiguous()
        leaves = []
        whole = torch.compiler.is_exporting()  # a graph takes any number of rows
        for block in (columns,) if whole else torch.split(columns, _ROWS, 1):
            at_most = torch.le(block[self._numbers], self._thresholds).float()
            at_most = at_most.view(len(self._powers), len(self._leaves), block.shape[1])
            # Numbers of leaves, which float32 has exactly.
            numbers = torch.tensordot(self._powers, at_most, 1).long()
            leaves.append(self._leaves.gather(1, numbers))
        return torch.cat(leaves, 1)


def fit_trees(
    inputs: Array,
    target: Array,
    seed: int,
    **settings: Any,
) -> dict[str, Tensor]:
    """Tensors of `BoostedTrees` of a bool target (M,), from inputs (M, F), of scikit-learn, with
    its `settings`; by default, a tenth of the rows, drawn by `seed`, decides when to stop."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    model = HistGradientBoostingClassifier(random_state=seed, **_SETTINGS | settings)
    model.fit(inputs, target)
    tables = [_tabulate(trees[0].nodes) for trees in model._predictors]
    splits, thresholds, leaves = (
        torch.from_numpy(np.stack(entry)) for entry in zip(*tables, strict=True)
    )
    base = torch.tensor(float(model._baseline_prediction.item())).double()
    return {"inputs": splits, "thresholds": thresholds, "leaves": leaves, "base": base}


def _tabulate(nodes: Array) -> tuple[Array, Array, Array]:
    """Inputs (S,), thresholds (S,) and leaves (2^S,) of the nodes of one of scikit-learn's trees;
    splits that it lacks look at input 0, and select nothing."""
    inner = np.flatnonzero(nodes["is_leaf"] == 0)
    inputs, thresholds = np.zeros(_SPLITS, dtype=np.int64), np.zeros(_SPLITS)
    inputs[: len(inner)] = nodes["feature_idx"][inner]
    thresholds[: len(inner)] = nodes["num_threshold"][inner]
    split = np.zeros(len(nodes), dtype=np.int64)
    split[inner] = np.arange(len(inner))
    outcomes = np.arange(2**_SPLITS)
    node = np.zeros(2**_SPLITS, dtype=np.int64)
    for _ in inner:
        left = (outcomes >> split[node]) & 1 == 1
        below = np.where(left, nodes["left"][node], nodes["right"][node])
        node = np.where(nodes["is_leaf"][node] == 1, node, below).astype(np.int64)
    return inputs, thresholds, nodes["value"][node]
