"""Models of a policy's return, each fitted on other users than it predicts.

Fitted Q evaluation is Algorithm 3 of Le, Voloshin & Yue, *Batch Policy Learning under Constraints*
(ICML 2019), with ridge regression, on sessions that end. With a linear model each of its
regressions needs only sums over the logged steps, so the steps are read twice, whatever their
number and however long the sessions are: once for the sums, once for the predictions.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.logged_steps import Modelled
from ucfrec.progress import progress

Chunks = Callable[[], Iterator[tuple[Float32Array, Float32Array]]]
"""Reads the N steps from the start, some at once, in order: features (B, P) of state and logged
action, the first of them 1, and (B, P) their mean over the evaluated policy's actions in the same
states (what is linear in features has its exact mean over these actions)."""

FOLDS = 5
_CLOSE = 1e-6
_ROUNDS = 10
"""Regressions of FQE for each step of the longest session, unless they settle before: a linear Q
is still on its way when as many steps as there are have been looked ahead."""


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

    def columns(self) -> dict[str, Any]:
        """The numbers by name, `model_…`."""
        return {f"model_{name}": value for name, value in asdict(self).items()}

    def __str__(self) -> str:
        ended = "converged" if self.converged else "stopped"
        return (
            f"on other users, R² of the reward {self.reward_r2:.3g}; FQE {ended} after "
            f"{self.iterations} iterations, TD error {self.td_bias:+.2g} in the mean, "
            f"{self.td_loss:.3g} squared"
        )


def fit_models(
    chunks: Chunks,
    reward: Float64Array,
    session: IntArray,
    seed: int,
    user: IntArray | None = None,
    discount: float = 1.0,
) -> tuple[Modelled, ModelReport]:
    """Linear models of reward and Q, cross-fitted over users: no session is predicted by a model
    that saw it, nor by one that saw another session of its user.

    Args:
        reward: (N,).
        session: (N,) number of each step's session, from 0, never falling; steps in order.
        user: (S,) whose session each is; None where each is of another user.
        discount: γ of Q.

    Returns:
        What the models say of the N steps, and how good they are.

    Raises:
        InputError: there are fewer than two users.
    """
    sessions = np.arange(int(session[-1]) + 1)
    group = sessions if user is None else np.unique(user, return_inverse=True)[1]
    users = int(group.max()) + 1
    if users < 2:
        raise InputError("a model needs sessions of users other than the one it predicts")
    folds = (np.random.default_rng(seed).permutation(users) % min(FOLDS, users))[group][session]
    last = np.diff(session, append=len(sessions)) > 0
    horizon = int(np.diff(np.flatnonzero(last), prepend=-1).max())
    with progress(2 * len(reward), "models", "steps") as bar:
        sums = _add_up(chunks, reward, folds, last, bar.update)
        fits = [
            sums.fit(fold, reward[folds != fold], horizon, discount)
            for fold in range(len(sums.rows))
        ]
        modelled = _predict(chunks, fits, folds, bar.update)
    errors = reward + discount * np.where(last, 0.0, np.roll(modelled.v, -1)) - modelled.q
    variance = float(((reward - reward.mean()) ** 2).mean())
    left = float(((reward - modelled.logged_reward) ** 2).mean())
    return modelled, ModelReport(
        reward_r2=1 - left / variance if variance > 0 else 0.0,
        td_loss=float((errors**2).mean()),
        td_bias=float(errors.mean()),
        iterations=max(fit.iterations for fit in fits),
        converged=all(fit.converged for fit in fits),
    )


@dataclass(frozen=True)
class _Fit:
    """Weights (P,) of the reward model and of Q."""

    reward: Float64Array
    q: Float64Array
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Sums:
    """Sums over the steps of each of F folds."""

    gram: Float64Array
    """(F, P, P) Σ φ φᵀ."""
    follows: Float64Array
    """(F, P, P) Σ φ φ̄'ᵀ over steps that another follows, φ̄' the mean features of that one."""
    rewards: Float64Array
    """(F, P) Σ φ r."""
    rows: IntArray
    """(F,)."""

    def fit(self, fold: int, reward: Float64Array, horizon: int, discount: float) -> _Fit:
        """The models that know all folds but one.

        The ridge penalty counts features by their root mean square, and gives all P of them
        together the variance of the noise; the constant goes free.

        Args:
            reward: rewards of the steps of the other folds.
        """
        gram, follows, rewards = (
            sums.sum(axis=0) - sums[fold] for sums in (self.gram, self.follows, self.rewards)
        )
        rows = int(self.rows.sum() - self.rows[fold])
        mean_square = np.diag(self.gram.sum(axis=0)) / int(self.rows.sum())
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
        return _Fit(first, weights, iterations, converged)


def _add_up(
    chunks: Chunks,
    reward: Float64Array,
    folds: IntArray,
    last: BoolArray,
    update: Callable[[int], object],
) -> _Sums:
    begin, sums = 0, None
    held: Float32Array | None = None
    for features, at_policy in chunks():
        rows, width = features.shape
        if sums is None:
            count = int(folds.max()) + 1
            gram, follows = np.zeros((2, count, width, width))
            sums = _Sums(gram, follows, np.zeros((count, width)), np.bincount(folds))
        end = begin + rows
        # The last step of the chunk before is followed by the first of this one.
        earlier = features[:-1] if held is None else np.vstack([held, features[:-1]])
        later = at_policy[1:] if held is None else at_policy
        start = begin if held is None else begin - 1
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


def _predict(
    chunks: Chunks, fits: list[_Fit], folds: IntArray, update: Callable[[int], object]
) -> Modelled:
    """What the models say of every step."""
    reward_weights = np.stack([fit.reward for fit in fits], axis=1)
    q_weights = np.stack([fit.q for fit in fits], axis=1)
    predictions, begin = np.empty((4, len(folds))), 0
    for features, at_policy in chunks():
        end = begin + len(features)
        fold = folds[begin:end, None]
        for row, inputs, weights in (
            (0, at_policy, reward_weights),
            (1, features, q_weights),
            (2, at_policy, q_weights),
            (3, features, reward_weights),
        ):
            values = np.take_along_axis(inputs @ weights, fold, axis=1)
            predictions[row, begin:end] = values[:, 0]
        begin = end
        update(len(features))
    reward, q, v, logged_reward = predictions
    return Modelled(reward, q, v, logged_reward)
