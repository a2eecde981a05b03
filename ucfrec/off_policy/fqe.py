"""Models of what a policy would earn, each fitted on other sessions than it predicts.

Fitted Q evaluation is Algorithm 3 of Le, Voloshin & Yue, *Batch Policy Learning under Constraints*
(ICML 2019), with ridge regression, on sessions that end.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

from ucfrec.errors import InputError
from ucfrec.off_policy.logged_steps import Modelled
from ucfrec.progress import progress

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

FOLDS = 5
_ROWS_AT_ONCE = 2**16
_CLOSE = 1e-6


def cross_fitted(
    features: Float32Array,
    at_policy: Float32Array,
    reward: FloatArray,
    session: IntArray,
    seed: int,
    user: IntArray | None = None,
    discount: float = 1.0,
) -> Modelled:
    """Linear models of reward and Q, cross-fitted over users: no session is predicted by a model
    that saw it, nor by one that saw another session of its user.

    Args:
        features: (N, P) of the logged state and action; the first is 1.
        at_policy: (N, P) their mean over the evaluated policy's actions in the same states: what is
            linear in them has its exact mean over these actions.
        reward: (N,).
        session: (N,) number of each step's session, from 0, never falling; steps in order.
        seed: draws the folds.
        user: (S,) whose session each is; None where each is somebody else's.
        discount: γ of Q.

    Raises:
        InputError: there are fewer than two users.
    """
    sessions = np.arange(int(session[-1]) + 1)
    group = sessions if user is None else np.unique(user, return_inverse=True)[1]
    users = int(group.max()) + 1
    if users < 2:
        raise InputError("a model needs sessions of users other than the one it judges")
    folds = (np.random.default_rng(seed).permutation(users) % min(FOLDS, users))[group]
    last = np.diff(session, append=len(sessions)) > 0
    gram = _gram(features)
    penalty = _penalty(gram, len(reward))
    modelled = Modelled(*np.zeros((3, len(reward))))
    with progress(folds.max() + 1, "models", "folds") as bar:
        for fold in range(folds.max() + 1):
            here = folds[session] == fold
            ridge = _Ridge(features, gram - _gram(features[here]) + np.diag(penalty), ~here)
            modelled.reward[here] = at_policy[here] @ ridge.fit(reward)
            weights = fitted_q(ridge, at_policy, reward, last, discount)
            modelled.q[here] = features[here] @ weights
            modelled.v[here] = at_policy[here] @ weights
            bar.update()
    return modelled


class _Ridge:
    """Ridge regression on the rows of `features` (N, P) that are kept, factorised once.

    Args:
        gram: (P, P) of these rows, the penalty on its diagonal.
    """

    def __init__(self, features: Float32Array, gram: FloatArray, keep: BoolArray) -> None:
        self._features, self.keep = features, keep
        self._factor: Any = cho_factor(gram)

    def fit(self, target: FloatArray) -> Float32Array:
        """(P,) weights for the target (N,); its values in rows not kept are ignored."""
        kept = np.where(self.keep, target, 0.0).astype(np.float32)
        weights = cho_solve(self._factor, (kept @ self._features).astype(np.float64))
        return np.asarray(weights, dtype=np.float32)


def fitted_q(
    ridge: _Ridge,
    at_policy: Float32Array,
    reward: FloatArray,
    last: BoolArray,
    discount: float = 1.0,
) -> Float32Array:
    """(P,) weights of Q: as many steps ahead as the longest session has, or until they settle.

    Targets are held within what so many rewards could be, so that no iteration runs away.

    Args:
        last: (N,) where a session ends and nothing follows.
        discount: γ.
    """
    ends = np.flatnonzero(last)
    horizon = int(np.diff(ends, prepend=-1).max())
    seen = reward[ridge.keep]
    low, high = horizon * min(seen.min(), 0.0), horizon * max(seen.max(), 0.0)
    weights, next_values = ridge.fit(reward), np.zeros(len(reward))
    for _ in range(horizon - 1):
        before = next_values
        next_values = np.where(last, 0.0, np.roll(at_policy @ weights, -1)).clip(low, high)
        if np.abs(next_values - before).max() <= _CLOSE * (high - low):
            break
        weights = ridge.fit(reward + discount * next_values)
    return weights


def _penalty(gram: FloatArray, rows: int) -> FloatArray:
    """(P,) penalty: features count by their root mean square, and the prior gives all P of them
    together the variance of the noise; the constant goes free."""
    mean_square = np.diag(gram) / rows
    # A feature that is always 0 has no weight to find.
    penalty: FloatArray = len(gram) * np.where(mean_square > 0, mean_square, 1.0)
    penalty[0] = 0.0
    return penalty


def _gram(features: Float32Array) -> FloatArray:
    """(P, P) sums of products over rows, in double precision between chunks."""
    total = np.zeros((features.shape[1],) * 2)
    for begin in range(0, len(features), _ROWS_AT_ONCE):
        chunk = features[begin : begin + _ROWS_AT_ONCE]
        total += chunk.T @ chunk
    return total
