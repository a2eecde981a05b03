"""What models of future reward see of a logged step, kept on disk in bounded memory."""

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from scipy.special import softmax
from torch import Tensor

from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.off_policy.logged_steps import LoggedSteps, Modelled
from ucfrec.off_policy.score import ScoredSteps
from ucfrec.processes import progress, require_blas_memory
from ucfrec.runs.trained_policy import TrainedPolicy

_PRODUCTS = 256
_LOWEST_SCORE = -20.0
ROWS_AT_ONCE = 8192
_NUMBERS_AT_ONCE = 2**22
"""Of the rows that are in memory at a time; long rows are read fewer at once."""


@dataclass(frozen=True)
class StepInputs:
    """B logged steps as the models see them."""

    states: Tensor
    """(B, S)."""
    window: Tensor
    """(B, 1 + F): the return left of the target, and last-layer features of the window, if any."""
    chosen: Tensor
    """(B, D) embedding of the logged item; zeros for an item that the run does not know."""
    expected: Tensor
    """(B, D) mean embedding over the items that the evaluated policy shows."""
    scores: Tensor
    """(B, 2) log-probability of the logged item, and its mean over the items that the evaluated
    policy shows; an unknown item has the mean."""

    def features(self) -> tuple[Float32Array, Float32Array]:
        """Features (B, P) of state and logged item, and their mean over the evaluated policy's."""
        score = self.scores[:, :1]
        mean_score = self.scores[:, 1:]
        return self._cross(self.chosen, score), self._cross(self.expected, mean_score)

    def _cross(self, items: Tensor, score: Tensor) -> Float32Array:
        """Features (B, P), linear in item embeddings (B, D) and score (B, 1)."""
        # The three embeddings at the start of a state (`ItemStates`) and the return left are
        # multiplied with the item's own, dimension by dimension; the rest of the state (user,
        # observation) with as many of the item's first dimensions as `_PRODUCTS` allows.
        dim, left = items.shape[1], self.window[:, [0]]
        embeddings, remainder = self.states[:, : 3 * dim], self.states[:, 3 * dim :]
        leading = items[:, : _PRODUCTS // max(remainder.shape[1], 1)]
        products = (remainder.unsqueeze(2) * leading.unsqueeze(1)).flatten(1)
        ones, matches = torch.ones(len(items), 1), embeddings * items.repeat(1, 3)
        parts = [ones, self.states, self.window, items, score, matches, left * items, products]
        return np.asarray(torch.cat(parts, dim=1))


def make_inputs(trained: TrainedPolicy, batch: ScoredSteps) -> tuple[Array, Tensor, StepInputs]:
    """The evaluated policy's probability (B,) of the logged item, 0 of an unknown one, and
    (B, n_items) of all items; and what the models see of the steps."""
    assert trained.item_states is not None
    embeddings = trained.item_states.embeddings
    in_catalogue, column = batch.items >= 0, batch.items[:, None].clamp(min=0)
    probabilities = batch.log_probabilities.exp()
    target = probabilities.gather(1, column)[:, 0].double() * in_catalogue
    # What the policy thinks of an item counts for the models also where the rule takes the best.
    scores = batch.scores.log_softmax(-1).nan_to_num(_LOWEST_SCORE).clamp(min=_LOWEST_SCORE)
    mean_score = (probabilities * scores).sum(1)
    score = torch.where(in_catalogue, scores.gather(1, column)[:, 0], mean_score)
    window = batch.returns_left[:, None].float()
    if batch.features is not None:
        window = torch.cat([window, batch.features.float()], dim=1)
    inputs = StepInputs(
        states=batch.states.float(),
        window=window,
        chosen=embeddings[batch.items] * in_catalogue[:, None],
        expected=probabilities @ embeddings,
        scores=torch.stack([score, mean_score], dim=1),
    )
    return target.clamp(0, 1).numpy(), probabilities, inputs


class InputsFile:
    """Inputs of N steps in a file without a name: some hundred numbers a step, none in memory."""

    def __init__(self, steps: int) -> None:
        self._steps, self._end = steps, 0

    def append(self, inputs: StepInputs) -> None:
        """Write the next steps."""
        parts: list[Tensor] = [*vars(inputs).values()]
        if not self._end:
            self._sizes = [part.shape[1] for part in parts]
            self._rows = array_on_disk((self._steps, sum(self._sizes)))
        begin, self._end = self._end, self._end + len(parts[0])
        self._rows[begin : self._end] = torch.cat(parts, dim=1).numpy()

    def chunks(self) -> Iterator[tuple[Float32Array, Float32Array]]:
        """All steps in order, some thousand at once, as `StepInputs.features`."""
        for part in _split_rows(self._rows):
            rows = torch.from_numpy(np.array(self._rows[part]))
            yield StepInputs(*torch.split(rows, self._sizes, dim=1)).features()

    @property
    def states(self) -> Float32Array:
        """(N, S), still on disk."""
        return np.asarray(self._rows[:, : self._sizes[0]])


def _split_rows(rows: Float32Array) -> Iterator[slice]:
    """Slices of rows that may be in memory together."""
    at_once = max(1, min(ROWS_AT_ONCE, _NUMBERS_AT_ONCE // rows.shape[1]))
    return (slice(begin, begin + at_once) for begin in range(0, len(rows), at_once))


def array_on_disk(shape: tuple[int, int]) -> Float32Array:
    """Zeros whose memory the system can take back, writing them to a file without a name; OSError
    if the disk of the system's temporary folder is full."""
    with tempfile.TemporaryFile(prefix="ucfrec-") as file:
        if hasattr(os, "posix_fallocate"):  # not on macOS
            # A full disk is an error now; later it would be the end of the process.
            os.posix_fallocate(file.fileno(), 0, 4 * shape[0] * shape[1])
        return np.memmap(file, np.float32, "r+", shape=shape)


_BEHAVIOR_FOLDS = 3
_MOST_ROWS = 20_000
"""Steps that a model is fitted on, drawn at random: it has some thousand weights."""
_SHARES = (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
"""How much of the group's share in the logs may be mixed in, so that no probability is 0."""
_TEMPERATURES = (0.7, 1.0, 1.4, 2.0, 3.0)
_MOST_ITEM_GROUPS = 32


def group_items(embeddings: Float32Array, seed: int) -> IntArray:
    """(n_items,) group of every item, from 0, by k-means of embeddings (n_items, D): the root of
    the number of items, from 2 to 32, but at most so many as there are different ones."""
    groups = int(np.clip(round(len(embeddings) ** 0.5), 2, _MOST_ITEM_GROUPS))
    # Importing scikit-learn takes a second, which no other estimate must cost.
    from sklearn.cluster import KMeans

    distinct = len(np.unique(embeddings, axis=0))
    means = KMeans(min(groups, distinct), n_init=4, random_state=seed).fit(embeddings)
    return np.asarray(np.unique(means.labels_, return_inverse=True)[1], dtype=np.int64)


@dataclass(frozen=True)
class BehaviorModel:
    """Estimated probabilities of what was logged, and how good they are."""

    item: Float64Array
    """(N,) of the logged item."""
    log_loss: float
    """Held-out mean −ln p of the logged group."""
    share_log_loss: float
    """The same of the groups' shares in the logs, which ignore the state."""
    calibration_error: float
    """Mean absolute error of predicted shares, over groups and tenths of the probability."""

    def __str__(self) -> str:
        return (
            f"held-out loss {self.log_loss:.3g} nats, {self.share_log_loss:.3g} with the mere "
            f"shares of item groups; calibration error {self.calibration_error:.2g}"
        )


def fit_behavior(
    states: Float32Array,
    item: IntArray,
    group: IntArray,
    owner: IntArray,
    seed: int,
) -> BehaviorModel:
    """Estimate the probabilities with which the logged items (N,) and their groups (N,), from 0,
    were chosen in states (N, S), of which some thousand are read at once; `owner` (N,) is the user,
    from 0. Item −1, unknown, gets probability 1 and is fitted on nowhere.
    """
    rng = np.random.default_rng(seed)
    folds = rng.permutation(int(owner.max()) + 1)[owner] % _BEHAVIOR_FOLDS
    in_catalogue, count = item >= 0, int(group.max()) + 1
    models, samples = [], []
    with progress(_BEHAVIOR_FOLDS, "propensities", "folds") as bar:
        for fold in range(_BEHAVIOR_FOLDS):
            rows = np.flatnonzero(in_catalogue & (folds != fold))
            shares = np.bincount(group[rows], minlength=count) + 1.0
            if len(rows) > _MOST_ROWS:
                rows = np.sort(rng.choice(rows, _MOST_ROWS, replace=False))
            samples.append(rows)
            models.append(_GroupModel(states[rows], group[rows], shares / shares.sum()))
            bar.update()
    sample = np.unique(np.concatenate(samples))
    temperature, share = _calibrate(models, states, group, folds, sample)
    of_group = np.ones(len(item))
    # By group and tenth of the probability: what is expected, less what occurs.
    table = np.zeros((count, 10))
    for part in _split_rows(states):
        batch = states[part]
        probabilities = np.empty((len(batch), count))
        for fold, model in enumerate(models):
            rows = folds[part] == fold
            probabilities[rows] = model.predict(batch[rows], temperature, share)
        of_group[part] = np.take_along_axis(probabilities, group[part][:, None], axis=1)[:, 0]
        rows = np.flatnonzero(in_catalogue[part])
        beyond = probabilities[rows]
        tenth = np.minimum((beyond * 10).astype(np.int64), 9)
        beyond[np.arange(len(rows)), group[part][rows]] -= 1
        np.add.at(table, (np.arange(count), tenth), beyond)
    shares = np.stack([model.shares for model in models])[folds, group]
    return BehaviorModel(
        item=np.where(in_catalogue, of_group * _item_shares(item, group, folds), 1.0),
        log_loss=float(-np.log(of_group[in_catalogue]).mean()),
        share_log_loss=float(-np.log(shares[in_catalogue]).mean()),
        calibration_error=float(np.abs(table).sum() / max(in_catalogue.sum(), 1)),
    )


class _GroupModel:
    """Probabilities of groups given a state."""

    def __init__(
        self,
        states: Float32Array,
        group: IntArray,
        shares: Float64Array,
    ) -> None:
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        self.shares, self._present, self._model = shares, np.unique(group), None
        # There may be no row at all, where all other users were shown unknown items.
        if len(self._present) > 1:
            require_blas_memory()
            model = LogisticRegression(C=0.1, max_iter=100, tol=1e-3)
            self._model = make_pipeline(StandardScaler(), model).fit(states, group)

    def predict(
        self,
        states: Float32Array,
        temperature: float,
        share: float,
    ) -> Float64Array:
        """(B, K), with so much of the shares of groups mixed in."""
        if self._model is None or not len(states):
            return np.tile(self.shares, (len(states), 1))
        scores = self._model.predict_log_proba(states) / temperature
        probabilities = np.zeros((len(states), len(self.shares)))
        probabilities[:, self._present] = softmax(scores, axis=1)
        return (1 - share) * probabilities + share * self.shares


def _calibrate(
    models: list[_GroupModel],
    states: Float32Array,
    group: IntArray,
    folds: IntArray,
    sample: IntArray,
) -> tuple[float, float]:
    """The temperature and the mixed-in share of least held-out loss."""
    mixed_in = np.array(_SHARES)[:, None]
    losses = np.zeros((len(_TEMPERATURES), len(_SHARES)))
    for fold, model in enumerate(models):
        mine = sample[folds[sample] == fold][:_MOST_ROWS]
        rows = np.arange(len(mine))
        shares = model.shares[group[mine]]
        for loss, temperature in zip(losses, _TEMPERATURES, strict=True):
            likely = model.predict(states[mine], temperature, 0.0)[rows, group[mine]]
            loss -= np.log((1 - mixed_in) * likely + mixed_in * shares).sum(axis=1)
    best, share = np.unravel_index(losses.argmin(), losses.shape)
    return _TEMPERATURES[best], _SHARES[share]


def _item_shares(item: IntArray, group: IntArray, folds: IntArray) -> Float64Array:
    """(N,) share of the item in its group in the other folds, one step added to each item."""
    in_catalogue, items, shares = item >= 0, int(item.max()) + 1, np.ones(len(item))
    group_of = np.zeros(items, dtype=np.int64)
    group_of[item[in_catalogue]] = group[in_catalogue]
    for fold in range(_BEHAVIOR_FOLDS):
        rows = in_catalogue & (folds == fold)
        counts = np.bincount(item[in_catalogue & (folds != fold)], minlength=items) + 1.0
        totals = np.bincount(group_of, counts, int(group.max()) + 1)
        shares[rows] = counts[item[rows]] / totals[group[rows]]
    return shares


Chunks = Callable[[], Iterator[tuple[Float32Array, Float32Array]]]
"""Reads the N steps in order, some at once: features (B, P) of state and logged action, the first
of them 1, and (B, P) their mean over the evaluated policy's actions in the same states."""

_RETURN_FOLDS = 5
_CLOSE = 1e-6
_ROUNDS = 10
"""Regressions of FQE for each step of the longest session, unless they settle before."""


@dataclass(frozen=True)
class ModelReport:
    """How good the models are on users that they were not fitted on."""

    reward_r2: float
    """Share of the variance of the logged rewards that the reward model predicts."""
    td_loss: float
    """Mean squared TD error r + γ v(s') − q(s, a) of the logged steps: the loss of FQE."""
    td_bias: float
    """Mean TD error, 0 for a right model; in units of the reward."""
    iterations: int
    """Regressions of FQE, the most of any fold."""
    converged: bool
    """Whether Q stayed below the largest possible return, in every fold."""

    def __str__(self) -> str:
        ended = "converged" if self.converged else "stopped"
        return (
            f"on other users, R² of the reward {self.reward_r2:.3g}; FQE {ended} after "
            f"{self.iterations} iterations, TD error {self.td_bias:+.2g} in the mean, "
            f"{self.td_loss:.3g} squared"
        )


def fit_models(chunks: Chunks, steps: LoggedSteps, seed: int) -> tuple[Modelled, ModelReport]:
    """Fit linear models of reward and Q, cross-fitted over at least two users: no model predicts
    sessions of users that it saw. Their predictions of the N steps, and how good they are."""
    reward, users = steps.reward, int(steps.users.max()) + 1
    fold_of = np.random.default_rng(seed).permutation(users) % min(_RETURN_FOLDS, users)
    folds = fold_of[steps.users][steps.session]
    last, horizon = np.zeros(len(reward), dtype=bool), int(steps.lengths.max())
    last[steps.last] = True
    with progress(2 * len(reward), "models", "steps") as bar:
        sums = _add_up(chunks, reward, folds, last, bar.update)
        fits = [
            _fit_to_others(sums, fold, reward[folds != fold], horizon, steps.discount)
            for fold in range(len(sums.rows))
        ]
        weights = np.stack([models for models, _, _ in fits], axis=2)
        predictions, begin = [], 0
        for batch in chunks():
            rows = np.arange(len(batch[0]))
            fold = folds[begin + rows]
            predictions.append([(inputs @ weights)[:, rows, fold] for inputs in batch])
            begin += len(rows)
            bar.update(len(rows))
    (logged_reward, q), (mean_reward, v) = np.concatenate(predictions, axis=2)
    modelled = Modelled(mean_reward, q, v, logged_reward)
    errors = reward + steps.discount * np.where(last, 0.0, np.roll(v, -1)) - q
    variance = float(((reward - reward.mean()) ** 2).mean())
    left = float(((reward - logged_reward) ** 2).mean())
    return modelled, ModelReport(
        reward_r2=1 - left / variance if variance > 0 else 0.0,
        td_loss=float((errors**2).mean()),
        td_bias=float(errors.mean()),
        iterations=max(count for _, count, _ in fits),
        converged=all(below for _, _, below in fits),
    )


class _Sums(NamedTuple):
    """Sums over the steps of each of F folds."""

    gram: Float64Array
    """(F, P, P) Σ φ φᵀ."""
    follows: Float64Array
    """(F, P, P) Σ φ φ̄'ᵀ over steps that another follows, φ̄' the mean features of that one."""
    rewards: Float64Array
    """(F, P) Σ φ r."""
    rows: IntArray
    """(F,)."""


def _fit_to_others(
    sums: _Sums,
    fold: int,
    reward: Float64Array,
    horizon: int,
    discount: float,
) -> tuple[Float64Array, int, bool]:
    """Weights (2, P) of the reward model and of Q that know all folds but one, with the rewards of
    these others; how many regressions they took, and whether Q stayed in bounds."""
    # The ridge penalty counts features by their root mean square, and gives all P of them together
    # the variance of the noise; the constant goes free.
    gram, follows, rewards, rows = (total.sum(axis=0) - total[fold] for total in sums)
    mean_square = np.diag(sums.gram.sum(axis=0)) / int(sums.rows.sum())
    # A feature that is always 0 has no weight to find.
    penalty: Float64Array = len(gram) * np.where(mean_square > 0, mean_square, 1.0)
    penalty[0] = 0.0
    factor = cho_factor(gram + np.diag(penalty))
    weights = first = cho_solve(factor, rewards, check_finite=False)
    most = horizon * max(abs(reward.min()), abs(reward.max()))
    iterations, converged = 1, True
    while iterations < _ROUNDS * horizon:
        iterations += 1
        previous, target = weights, rewards + discount * (follows @ weights)
        weights = cho_solve(factor, target, check_finite=False)
        size = (weights @ gram @ weights / rows) ** 0.5
        if not size <= most:
            # Root mean square above the largest possible return: it diverges.
            weights, converged = previous, False
            break
        change = weights - previous
        if change @ gram @ change / rows <= (_CLOSE * most) ** 2:
            break
    return np.stack([first, weights]), iterations, converged


def _add_up(
    chunks: Chunks,
    reward: Float64Array,
    folds: IntArray,
    last: BoolArray,
    update: Callable[[int], object],
) -> _Sums:
    begin, sums, held = 0, None, np.empty((0, 0), dtype=np.float32)
    for features, at_policy in chunks():
        rows, width = features.shape
        if sums is None:
            count = int(folds.max()) + 1
            gram, follows = np.zeros((2, count, width, width))
            sums = _Sums(gram, follows, np.zeros((count, width)), np.bincount(folds))
            held = features[:0]
        end = begin + rows
        # The last step of the chunk before is followed by the first of this one.
        earlier, start = np.vstack([held, features[:-1]]), begin - len(held)
        later = at_policy[1 - len(held) :]
        for fold in range(len(sums.rows)):
            inside = folds[begin:end] == fold
            part = features[inside]
            sums.gram[fold] += part.T @ part
            sums.rewards[fold] += part.T @ reward[begin:end][inside].astype(np.float32)
            goes_on = (folds[start : end - 1] == fold) & ~last[start : end - 1]
            sums.follows[fold] += earlier[goes_on].T @ later[goes_on]
        held, begin = features[-1:], end
        update(rows)
    assert sums is not None
    return sums
