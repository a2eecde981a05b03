"""Fitted Q evaluation of a policy from logged trajectories, and why not to rely on it.

Q(s, a) = w·φ(s, a) with random features is regressed on r + γ Q(s', π(h')), again and again (Le,
Voloshin & Yue, ICML 2019). The policy chooses after the logged history h', so its memory counts.
Sums over groups of trajectories give both the estimate and its jackknife interval.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from scipy.stats import t as student

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.processes import progress
from ucfrec_control.training.evaluate import Trained
from ucfrec_control.training.rl_baselines import RLPolicy

_FEATURES: Final = 256
_STEPS_PER_FEATURE: Final = 20
_GROUPS: Final = 20
_DOUBLINGS: Final = 16
"""Of the number of regressions, from one."""
_RIDGE: Final = 1e-3
_BATCH: Final = 1024
_FAR: Final = 0.5
"""Share of the variance of logged actions that the policy's may be off by."""
_BIASED: Final = 0.1
"""Standard deviations of logged returns that the behaviour's own estimate may be off by."""


@dataclass(frozen=True)
class Estimate:
    """The discounted return of an episode, from its first step; an estimate has no time limit."""

    value: float | None
    """None if the regressions did not settle, as then the interval is."""
    interval: tuple[float, float] | None
    """95%, over trajectories; None of fewer trajectories than groups."""
    behaviour_value: float | None
    """Of the logged behaviour by the same method; None if the regressions did not settle."""
    behaviour: float
    """Mean of the logged trajectories, each as long as it was logged."""
    best_quarter: float
    """Mean of the quarter of them with the highest returns."""
    cut: int
    """Number of trajectories that a time limit ended."""
    reasons: tuple[str, ...]
    """Not to rely on the value; empty for none."""


def choose_actions(trained: Trained, rule: DecisionRule | None, store: EpisodeStore) -> Array:
    """What the policy would do at every logged step (N, A), after the logged history."""
    if isinstance(trained, RLPolicy):
        return trained.act(store.column(schema.OBSERVATION), np.ones(store.n_steps, dtype=bool))[0]
    scorer, parts = trained.scorer(rule), []
    with progress(store.n_steps, "actions of the policy", "steps") as bar:
        for first in range(0, store.n_steps, _BATCH):
            episodes, steps = store.locate(np.arange(first, min(first + _BATCH, store.n_steps)))
            logged = store.windows(episodes, steps, trained.policy.config.context)
            sessions = Sessions(
                logged.actions[:, :-1],
                logged.rewards[:, :-1],
                torch.from_numpy(steps),
                torch.from_numpy(store.rewards_before(episodes, steps)),
                torch.full((len(steps),), -1),
                torch.zeros(len(steps), dtype=torch.int64),
                states=logged.states,
            )
            parts.append(scorer.act(sessions).numpy())
            bar.update(len(steps))
    return np.concatenate(parts)


def estimate(
    trained: Trained, rule: DecisionRule | None, store: EpisodeStore, discount: float = 0.99
) -> Estimate:
    """Estimate the discounted return of a policy from trajectories of the same robot.

    Of trajectories that a time limit ended, the last step is not regressed, because the state after
    it is unknown. InputError if `discount` is not in (0, 1), the store is of other sizes, or no
    trajectory has two steps.
    """
    if not 0 < discount < 1:
        raise InputError(f"--discount is {discount:g}; give a number between 0 and 1")
    sizes = trained.record.sizes
    dropped = trained.record.dropped_observations
    expected = (sizes["state"] + len(dropped), sizes["action"])
    actions = () if store.has_items else store.record.columns[schema.ACTION]
    stored = (store.observation_size, *actions)
    if stored != expected:
        raise InputError(
            f"{store.path}: observations and actions have sizes {stored}, the policy was trained "
            f"on {expected}; name a store of the same robot"
        )
    store = store.without_observation_dimensions(dropped)
    if store.lengths.max() < 2:
        raise InputError(f"{store.path}: no trajectory has two steps; log longer ones")
    logged, chosen = store.column(schema.ACTION), choose_actions(trained, rule, store)
    model, moving = _Model(store, discount), np.ptp(logged, axis=0) > 0
    apart = (np.square(chosen - logged) / model.action_scale**2).mean(axis=0)[moving]
    distance = float(apart.mean()) if len(apart) else 0.0
    of_behaviour, of_policy = model.fit(logged, to_limit=True), model.fit(chosen)
    converged = of_policy.converged and of_behaviour.converged
    has_few = len(store.lengths) < _GROUPS
    returns, half, value = model.returns, 0.0, of_policy.value
    later = model.estimate_later(of_behaviour.weights)
    reasons = []
    if not converged:
        reasons.append("the regressions did not settle")
    if has_few:
        reasons.append(f"of fewer than {_GROUPS} trajectories there is no interval")
    else:
        half = of_policy.half_width
    if distance > _FAR:
        reasons.append(
            f"the policy's actions are far from the logged ones ({distance:.2g} of their variance, "
            f"at most {_FAR:g}), so the value rests on the regressions' model of actions"
        )
    # Compared is what was logged: after a time limit, the estimate would be compared with itself.
    mean, said = float(returns.mean()), of_behaviour.value
    allowed = _BIASED * float(returns.std()) + (0.0 if has_few else of_behaviour.half_width)
    if of_behaviour.converged and abs(said - mean) > allowed:
        reasons.append(
            f"the same method says {said:.4g} of the logged steps, which returned {mean:.4g}"
        )
    low, high = (returns + later).min(), (returns + later).max()
    if converged and not low <= value <= high:
        goes_on = ", continued by the estimate after a time limit" if model.cut.any() else ""
        reasons.append(
            f"the value is outside of the logged returns{goes_on} ({low:.4g} to {high:.4g})"
        )
    return Estimate(
        value=value if converged else None,
        interval=(value - half, value + half) if converged and not has_few else None,
        behaviour_value=said + float(later.mean()) if of_behaviour.converged else None,
        behaviour=mean,
        best_quarter=float(np.sort(returns)[-max(1, len(returns) // 4) :].mean()),
        cut=int(model.cut.sum()),
        reasons=tuple(reasons),
    )


@dataclass(frozen=True)
class _Fit:
    weights: Float64Array
    value: float
    half_width: float
    """Of the 95% interval; infinite of fewer trajectories than groups."""
    converged: bool


class _Model:
    """Features of a store's steps, and the regressions on them."""

    def __init__(self, store: EpisodeStore, discount: float) -> None:
        self._lengths, self._discount = store.lengths, discount
        self._starts = np.cumsum(self._lengths) - self._lengths
        mean, std = (values.numpy() for values in store.state_statistics)
        self._states = (store.column(schema.OBSERVATION) - mean) / np.where(std > 0, std, 1.0)
        self._rewards = store.column(schema.REWARD).astype(np.float64)
        self._logged = store.column(schema.ACTION)
        # In float32, sums of a million actions near 1000 are off by more than their spread.
        spread = self._logged.std(axis=0, dtype=np.float64)
        self._action_mean = self._logged.mean(axis=0, dtype=np.float64)
        self.action_scale = np.where(np.ptp(self._logged, axis=0) > 0, spread, 1.0)
        size, rng = self._states.shape[1] + self._logged.shape[1], np.random.default_rng(0)
        waves = min(_FEATURES, store.n_steps // _STEPS_PER_FEATURE)
        self._slopes = rng.normal(0, size**-0.5, (size, waves))
        self._phases = rng.uniform(0, 2 * np.pi, waves)
        self._ends, self.cut = self._starts + self._lengths - 1, ~store.terminated.astype(bool)
        steps = np.arange(store.n_steps) - np.repeat(self._starts, self._lengths)
        self._discounts = discount**steps
        self.returns = np.add.reduceat(self._discounts * self._rewards, self._starts)
        """Discounted returns (E,) of the logged trajectories."""
        self._groups = min(_GROUPS, len(self._lengths))

    def _features(self, rows: IntArray, actions: Array) -> Float64Array:
        """φ (M, F) of steps `rows` (M,) with the actions (N, A) of all steps."""
        acted = (actions[rows] - self._action_mean) / self.action_scale
        inputs = np.hstack([self._states[rows].astype(np.float64), acted])
        waves = np.cos(inputs @ self._slopes + self._phases)
        return np.hstack([waves, inputs, np.ones((len(rows), 1))])

    def fit(self, chosen: Array, to_limit: bool = False) -> _Fit:
        """Q of a policy with the actions `chosen` (N, A) at all steps; its value ends where a time
        limit cut the trajectory if `to_limit`."""
        sums = [self._sum(group, chosen, to_limit) for group in range(self._groups)]
        total = [np.sum(parts, axis=0) for parts in zip(*sums, strict=True)]
        weights, value, converged = self._solve(total)
        if self._groups < _GROUPS:
            return _Fit(weights, value, np.inf, converged)
        without = [
            self._solve([whole - part for whole, part in zip(total, parts, strict=True)])
            for parts in sums
        ]
        values = np.array([value for _, value, _ in without])
        spread = np.sqrt((_GROUPS - 1) * values.var())
        converged = converged and all(ended for *_, ended in without)
        return _Fit(weights, value, float(student.ppf(0.975, _GROUPS - 1) * spread), converged)

    def _sum(self, group: int, chosen: Array, to_limit: bool) -> tuple[Array, ...]:
        """Σ φφᵀ, Σ φφ'ᵀ, Σ φr, Σ φ of first steps, Σ of rewards that are no features of theirs, and
        number, of a group of trajectories."""
        mine = np.arange(len(self._lengths)) % self._groups == group
        is_row = np.repeat(mine, self._lengths)
        is_row[self._ends[self.cut]] = False
        ends, rows = np.zeros(len(is_row), dtype=bool), np.flatnonzero(is_row)
        ends[self._ends] = True
        first, at_limit = self._features(self._starts[mine], chosen).sum(0), self._ends[:0]
        if to_limit:  # of the last step, the reward counts in place of Q
            at_limit = self._ends[mine & self.cut]
            first -= self._discounts[at_limit] @ self._features(at_limit, chosen)
        known = self._discounts[at_limit] @ self._rewards[at_limit]
        squares, products = np.zeros((2, len(first), len(first)))
        rewards = np.zeros(len(first))
        for part in np.array_split(rows, -(-len(rows) // _BATCH) or 1):
            now = self._features(part, self._logged)
            later = self._features(np.minimum(part + 1, len(is_row) - 1), chosen)
            later[ends[part]] = 0.0
            squares += now.T @ now
            products += now.T @ later
            rewards += now.T @ self._rewards[part]
        return squares, products, rewards, first, np.array([known, mine.sum()])

    def _solve(self, sums: list[Array]) -> tuple[Float64Array, float, bool]:
        """Weights, mean value of the first steps, and whether the regressions converged."""
        squares, products, rewards, first, (known, count) = sums
        ridge = _RIDGE * np.trace(squares) / len(squares) * np.eye(len(squares))
        solved = np.linalg.solve(squares + ridge, np.column_stack([rewards, products]))
        weights, matrix = solved[:, 0], self._discount * solved[:, 1:]
        size, converged = np.abs(weights).max(), False
        for _ in range(_DOUBLINGS):  # w + M w + … + Mⁿ w of n = 1, 3, 7, … regressions
            change = matrix @ weights
            weights, matrix = weights + change, matrix @ matrix
            converged = bool(np.abs(change).max() <= 1e-6 * np.abs(weights).max())
            if converged or np.abs(change).max() > 1e9 * size:
                break
        return weights, float((first @ weights + known) / count), converged

    def estimate_later(self, weights: Float64Array) -> Float64Array:
        """What Q adds to the logged returns (E,) after a time limit."""
        later = self._features(self._ends, self._logged) @ weights - self._rewards[self._ends]
        return np.where(self.cut, self._discounts[self._ends] * later, 0.0)
