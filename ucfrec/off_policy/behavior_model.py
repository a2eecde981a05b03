"""A model of how the logs' items were chosen: estimated propensities of items and their groups.

Groups by a multinomial logistic regression on the state before the choice, items within a group by
their share of its logged steps. Every user is predicted by a model of other users (cross-fitting),
and those predictions are calibrated by one temperature and by mixing in the group's share of the
logs, as much as predicts best: all of it where the state predicts nothing.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ucfrec.arrays import Float32Array, Float64Array, IntArray
from ucfrec.off_policy.features import array_on_disk
from ucfrec.processes import require_blas_memory
from ucfrec.progress import progress

States = Callable[[], Iterator[Float32Array]]
"""Reads the states (N, S) from the first step on, some thousand at once."""

FOLDS = 3
_MOST_ROWS = 20_000
"""Steps that a model is fitted on, drawn at random: it has some thousand weights."""
_SHARES = (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
"""How much of the group's share in the logs may be mixed in; never nothing, so that no probability
is 0."""
_TEMPERATURES = (0.7, 1.0, 1.4, 2.0, 3.0)
_MOST_ITEM_GROUPS = 32


def group_items(embeddings: Float32Array, groups: int, seed: int) -> IntArray:
    """(n_items,) group of every item, from 0, by k-means of embeddings (n_items, D).

    Items of equal embeddings are in one group, so there may be fewer than `groups`.

    Args:
        groups: how many; 0 for the root of the number of items, from 2 to 32.
    """
    groups = groups or int(np.clip(round(len(embeddings) ** 0.5), 2, _MOST_ITEM_GROUPS))
    if groups == 1:
        return np.zeros(len(embeddings), dtype=np.int64)
    # Importing scikit-learn takes a second, which no other estimate must cost.
    from sklearn.cluster import KMeans

    distinct = len(np.unique(embeddings, axis=0))
    means = KMeans(min(groups, distinct), n_init=4, random_state=seed).fit(embeddings)
    return np.asarray(np.unique(means.labels_, return_inverse=True)[1], dtype=np.int64)


@dataclass(frozen=True)
class BehaviorModel:
    """Estimated probabilities of what was logged, and how good they are."""

    group: Float64Array
    """(N,) of the logged item's group."""
    item: Float64Array
    """(N,) of the logged item."""
    log_loss: float
    """Held-out mean −ln p of the logged group."""
    share_log_loss: float
    """The same of the groups' shares in the logs, which ignore the state."""
    calibration_error: float
    """Mean absolute difference between what is predicted and what occurs, over groups and tenths
    of the predicted probability, weighted by their steps."""
    temperature: float
    """Scores are divided by it."""
    share: float
    """How much of the group's share in the logs is mixed in."""

    def __str__(self) -> str:
        return (
            f"held-out loss {self.log_loss:.3g} nats, {self.share_log_loss:.3g} with the mere "
            f"shares of item groups; calibration error {self.calibration_error:.2g}"
        )


def fit_behavior(
    states: States,
    item: IntArray,
    group: IntArray,
    session: IntArray,
    seed: int,
    user: IntArray | None = None,
) -> BehaviorModel:
    """Estimate the probabilities with which the logged items and their groups were chosen.

    Args:
        states: reads what was known before each step.
        item: (N,) logged items; −1, unknown, gets probability 1 and is fitted on nowhere.
        group: (N,) their groups, from 0.
        session: (N,) number of each step's session, from 0.
        user: (S,) of each session; None where each is of another user.
    """
    rng = np.random.default_rng(seed)
    owner = session if user is None else np.unique(user, return_inverse=True)[1][session]
    folds = rng.permutation(int(owner.max()) + 1)[owner] % FOLDS
    listed, count = item >= 0, int(group.max()) + 1
    samples = []
    for fold in range(FOLDS):
        rows = np.flatnonzero(listed & (folds != fold))
        if len(rows) > _MOST_ROWS:
            rows = np.sort(rng.choice(rows, _MOST_ROWS, replace=False))
        samples.append(rows)
    sample = np.unique(np.concatenate(samples))
    look_up = _look_up_states(states, sample)
    models = []
    with progress(FOLDS, "propensities", "folds") as bar:
        for fold, rows in enumerate(samples):
            shares = np.bincount(group[listed & (folds != fold)], minlength=count) + 1.0
            models.append(_GroupModel(look_up(rows), group[rows], shares / shares.sum()))
            bar.update()
    calibration = _calibrate(models, look_up, group, folds, sample)
    of_group, begin = np.ones(len(item)), 0
    # By group and tenth of the probability: what is expected, and what occurs.
    table = np.zeros((2, count, 10))
    for batch in states():
        part = slice(begin, begin + len(batch))
        probabilities = np.empty((len(batch), count))
        for fold, model in enumerate(models):
            rows = folds[part] == fold
            probabilities[rows] = model.predict(batch[rows], *calibration)
        of_group[part] = np.take_along_axis(probabilities, group[part][:, None], axis=1)[:, 0]
        rows = np.flatnonzero(listed[part])
        tenth = np.minimum((probabilities[rows] * 10).astype(np.int64), 9)
        logged = group[part][rows]
        np.add.at(table[0], (np.arange(count)[None, :], tenth), probabilities[rows])
        np.add.at(table[1], (logged, tenth[np.arange(len(rows)), logged]), 1.0)
        begin = part.stop
    mean_shares = np.stack([model.shares for model in models])[folds[listed], group[listed]]
    return BehaviorModel(
        group=np.where(listed, of_group, 1.0),
        item=np.where(listed, of_group * _item_shares(item, group, folds), 1.0),
        log_loss=float(-np.log(of_group[listed]).mean()),
        share_log_loss=float(-np.log(mean_shares).mean()),
        calibration_error=float(np.abs(table[0] - table[1]).sum() / max(table[1].sum(), 1.0)),
        temperature=calibration[0],
        share=calibration[1],
    )


class _GroupModel:
    """Probabilities of groups given a state."""

    def __init__(self, states: Float32Array, group: IntArray, shares: Float64Array) -> None:
        # Importing scikit-learn takes a second, which no other estimate must cost.
        from sklearn.linear_model import LogisticRegression

        self.shares, self._present, self._model = shares, np.unique(group), None
        # There may be no row at all, where all other users were shown unknown items.
        if len(self._present) > 1:
            self._mean, self._spread = states.mean(axis=0), states.std(axis=0)
            self._spread[self._spread == 0] = 1.0
            require_blas_memory()
            model = LogisticRegression(C=0.1, max_iter=100, tol=1e-3)
            self._model = model.fit(self._scale(states), group)

    def predict(self, states: Float32Array, temperature: float, share: float) -> Float64Array:
        """(B, K), with so much of the shares of groups mixed in."""
        if self._model is None or not len(states):
            return np.tile(self.shares, (len(states), 1))
        scores = self._model.decision_function(self._scale(states)) / temperature
        if scores.ndim == 1:
            scores = np.stack([-scores / 2, scores / 2], axis=1)
        exponents = np.exp(scores - scores.max(axis=1, keepdims=True))
        probabilities = np.zeros((len(states), len(self.shares)))
        probabilities[:, self._present] = exponents / exponents.sum(axis=1, keepdims=True)
        return np.asarray((1 - share) * probabilities + share * self.shares)

    def _scale(self, states: Float32Array) -> Float32Array:
        scaled = np.asarray(states - self._mean, dtype=np.float32)
        scaled /= self._spread
        return scaled


def _look_up_states(states: States, rows: IntArray) -> Callable[[IntArray], Float32Array]:
    """Looks up the states of numbered steps, all among `rows` (sorted)."""
    table, begin = array_on_disk((0, 0)), 0
    for batch in states():
        if not begin:
            table = array_on_disk((len(rows), batch.shape[1]))
        low, high = np.searchsorted(rows, [begin, begin + len(batch)])
        table[low:high] = batch[rows[low:high] - begin]
        begin += len(batch)
    return lambda some: np.asarray(table[np.searchsorted(rows, some)])


def _calibrate(
    models: list[_GroupModel],
    look_up: Callable[[IntArray], Float32Array],
    group: IntArray,
    folds: IntArray,
    sample: IntArray,
) -> tuple[float, float]:
    """The temperature and the mixed-in share of least held-out loss."""
    mixed_in = np.array(_SHARES)[:, None]
    losses = np.zeros((len(_TEMPERATURES), len(_SHARES)))
    for fold, model in enumerate(models):
        mine = sample[folds[sample] == fold][:_MOST_ROWS]
        states, rows = look_up(mine), np.arange(len(mine))
        shares = model.shares[group[mine]]
        for loss, temperature in zip(losses, _TEMPERATURES, strict=True):
            likely = model.predict(states, temperature, 0.0)[rows, group[mine]]
            loss -= np.log((1 - mixed_in) * likely + mixed_in * shares).sum(axis=1)
    best, share = np.unravel_index(losses.argmin(), losses.shape)
    return _TEMPERATURES[best], _SHARES[share]


def _item_shares(item: IntArray, group: IntArray, folds: IntArray) -> Float64Array:
    """(N,) share of the item among its group's steps in the other folds, one step added to each
    item."""
    listed, items, shares = item >= 0, int(item.max()) + 1, np.ones(len(item))
    group_of = np.zeros(items, dtype=np.int64)
    group_of[item[listed]] = group[listed]
    for fold in range(FOLDS):
        rows = listed & (folds == fold)
        counts = np.bincount(item[listed & (folds != fold)], minlength=items) + 1.0
        totals = np.bincount(group_of, counts, int(group.max()) + 1)
        shares[rows] = counts[item[rows]] / totals[group[rows]]
    return shares
