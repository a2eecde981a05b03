"""Logged steps as flat arrays, and the importance weights that follow from them.

Notation of the whole package: session i of S, step t (from 0) of its T_i steps; ρ_it =
target / propensity of the logged action; w_it = Π_{k ≤ t} ρ_ik, with w_i,−1 = 1; γ the discount.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.array_inputs import array_of, ids, numbers, whole_numbers

_LARGEST = 1e100
"""Weights stop here: beyond, an estimate means nothing, and their squares stay finite."""
_ROUNDING = 1e-6
"""By how much a probability may be above 1; it counts as 1."""
_MAY_LACK = ("propensity", "cluster_propensity")
_PROBABILITIES = (*_MAY_LACK, "target", "cluster_target")
_NUMBERS = ("reward", *_PROBABILITIES, "per_decision", "by_step")
"""What there is one number of a step."""


@dataclass(frozen=True)
class Modelled:
    """What models fitted on other sessions say of N logged steps, under the evaluated policy."""

    reward: Float64Array
    """(N,) mean reward of the step over the evaluated policy's actions."""
    q: Float64Array
    """(N,) discounted return from the logged action on."""
    v: Float64Array
    """(N,) Σ_a π(a | s) q(s, a): the mean of `q` over the evaluated policy's actions."""
    logged_reward: Float64Array
    """(N,) mean reward of the logged action."""

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            object.__setattr__(self, name, numbers(f"modelled {name}", values))


@dataclass(frozen=True)
class ItemGroups:
    """Groups of items alike, of N logged steps: each is tested alone (`diagnose`)."""

    number: IntArray
    """(N,) group of the logged item, from 0; −1 for an item of none."""
    target: Float32Array
    """(N, K) the evaluated policy's probability of every group."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "number", whole_numbers("number of the group", self.number))
        object.__setattr__(self, "target", array_of("target of groups", self.target, dimensions=2))


@dataclass(frozen=True)
class LoggedSteps:
    """N logged steps of S sessions, a session's steps together and in order.

    Lists and pandas Series are taken as well, by place and not by index; numbers are kept as
    float64, and users that are not integers are numbered. Masked and missing propensities are
    unknown ones.

    Raises:
        InputError: lengths differ, sessions are not numbered in order, a number is missing, masked
            or not finite, a user is missing, a probability or the discount is out of its range.
    """

    session: IntArray
    """(N,) number of each step's session: 0 to S − 1, never falling, without gaps."""
    reward: Float64Array
    """(N,) in any unit; estimates are in the same unit."""
    propensity: Float64Array
    """(N,) the behavior policy's probability of the logged action, in (0, 1]; NaN where unknown."""
    target: Float64Array
    """(N,) the evaluated policy's probability of it, in [0, 1]; 0 where it cannot choose it."""
    model: Modelled | None = None
    user: IntArray | None = None
    """(S,) whose session it is: sessions of one user are resampled together. None where every
    session is of another user."""
    discount: float = 1.0
    """γ in (0, 1]: a reward at step t (from 0) counts γ^t."""
    cluster_propensity: Float64Array | None = None
    """(N,) the behavior policy's probability of the logged action's cluster, for MIPS
    (Saito & Joachims, ICML 2022), e.g. k-means of item embeddings."""
    cluster_target: Float64Array | None = None
    """(N,) the evaluated policy's probability of it."""
    groups: ItemGroups | None = None
    densities: bool = False
    """Whether `propensity` and `target` are probability densities of vector actions, which may
    exceed 1."""
    per_decision: Float64Array | None = None
    """(N,) terms of PDIS, where steps are sums of whole sessions (`ucfrec.off_policy.scored`)."""
    by_step: Float64Array | None = None
    """(N,) those of SNPDIS."""
    pages: bool = False
    """Whether a session is one page and its steps the page's positions, chosen at once; see
    `ucfrec.off_policy.pages`."""

    def __post_init__(self) -> None:
        self._convert()
        n = len(self.session)
        rises = np.diff(self.session, prepend=-1)
        if n == 0 or rises[0] != 1 or not np.isin(rises, (0, 1)).all():
            raise InputError("sessions are numbered from 0 in order, and there is at least one")
        finite = {"reward": self.reward}
        if self.model is not None:
            finite |= {f"modelled {name}": values for name, values in vars(self.model).items()}
        finite |= {name: getattr(self, name) for name in ("per_decision", "by_step")}
        for name, values in finite.items():
            if values is not None:
                _require_finite(name, values, n)
        most = np.inf if self.densities else 1.0
        _require_probabilities(self.propensity, self.target, n, most)
        if (self.cluster_propensity is None) is not (self.cluster_target is None):
            raise InputError("give both cluster_propensity and cluster_target, or neither")
        if self.cluster_propensity is not None and self.cluster_target is not None:
            _require_probabilities(self.cluster_propensity, self.cluster_target, n)
        if self.groups is not None:
            of, target = self.groups.number.shape, self.groups.target.shape
            if of != (n,) or len(target) != 2 or target[0] != n:
                raise InputError(f"groups have shapes {of} and {target}; {n} steps are one each")
        if self.user is not None and self.user.shape != (len(self.first),):
            raise InputError(
                f"user has shape {self.user.shape}; {len(self.first)} sessions are "
                f"({len(self.first)},): one user a session"
            )
        if not 0 < self.discount <= 1:
            raise InputError(f"discount is {self.discount}; it is above 0 and at most 1")

    def _convert(self) -> None:
        """Replace what was given by the arrays to compute with."""
        keep = partial(object.__setattr__, self)
        keep("session", whole_numbers("session", self.session))
        for name in _NUMBERS:
            if (values := getattr(self, name)) is None:
                continue
            found = numbers(name, values, masked_is_missing=name in _MAY_LACK)
            if name in _PROBABILITIES and not self.densities:
                found = _without_rounding(found)
            keep(name, found)
        if self.user is not None:
            keep("user", ids("user", self.user))

    @cached_property
    def first(self) -> IntArray:
        """(S,) step that begins each session."""
        return np.flatnonzero(np.diff(self.session, prepend=-1))

    @cached_property
    def users(self) -> IntArray:
        """(S,) users numbered from 0; each session is one where users are unknown."""
        if self.user is None:
            return np.arange(len(self.first))
        return np.asarray(np.unique(self.user, return_inverse=True)[1])

    @cached_property
    def lacking(self) -> BoolArray:
        """(S,) whether the session has a step of unknown propensity."""
        return self.per_session(np.isnan(self.propensity).astype(np.float64)) > 0

    @cached_property
    def lengths(self) -> IntArray:
        """(S,) steps of each session."""
        return np.diff(np.append(self.first, len(self.session)))

    @cached_property
    def last(self) -> IntArray:
        """(S,) step that ends each session."""
        return self.first + self.lengths - 1

    @cached_property
    def step(self) -> IntArray:
        """(N,) place of each step in its session, from 0."""
        return np.arange(len(self.session)) - self.first[self.session]

    @cached_property
    def discounts(self) -> Float64Array:
        """(N,) γ^t."""
        return np.asarray(self.discount**self.step, dtype=np.float64)

    @cached_property
    def returns(self) -> Float64Array:
        """(S,) discounted return of each session as logged."""
        return self.per_session(self.discounts * self.reward)

    @cached_property
    def weights(self) -> Float64Array:
        """(N,) w_it; NaN from a step without propensity on."""
        return self._products(self.target / self.propensity)

    @cached_property
    def session_weights(self) -> Float64Array:
        """(S,) w of each session's last step: the product of all its ratios."""
        return self.weights[self.last]

    @cached_property
    def cluster_weights(self) -> Float64Array | None:
        """(N,) products of ratios of the logged actions' clusters; None without them."""
        if self.cluster_propensity is None or self.cluster_target is None:
            return None
        return self._products(self.cluster_target / self.cluster_propensity)

    @property
    def unknown_propensities(self) -> int:
        """How many steps have none."""
        return int(np.isnan(self.propensity).sum())

    def per_session(self, values: Float64Array) -> Float64Array:
        """(S,) sums of values (N,)."""
        return np.asarray(np.add.reduceat(values, self.first))

    def before(self, upto: Float64Array) -> Float64Array:
        """(N,) w_i,t−1 of products (N,): 1 at the first step."""
        earlier = np.roll(upto, 1)
        earlier[self.first] = 1.0
        return earlier

    def known(self) -> "LoggedSteps":
        """The sessions of whose every step the propensity is known, renumbered.

        Raises:
            InputError: there is none.
        """
        if not self.unknown_propensities:
            return self
        return self.only(~self.lacking)

    def only(self, keep: BoolArray) -> "LoggedSteps":
        """The sessions that `keep` (S,) marks, renumbered.

        Raises:
            InputError: it marks none.
        """
        rows = keep[self.session]
        return replace(
            self,
            session=(np.cumsum(keep) - 1)[self.session[rows]],
            user=None if self.user is None else self.user[keep],
            **self._columns(rows),
        )

    def regrouped(self, order: IntArray, session: IntArray, user: IntArray | None) -> "LoggedSteps":
        """The same steps in another order and other sessions.

        Args:
            order: (N,) steps in their new order.
            session: (N,) session of each, in the new order.
            user: (S,) of the new sessions; None where each is of another user.
        """
        return replace(self, session=session, user=user, **self._columns(order))

    def _columns(self, rows: IntArray | BoolArray) -> dict[str, Any]:
        """What there is one of a step, at the given steps; without the sessions."""
        parts: dict[str, Any] = {
            name: values[rows] for name in _NUMBERS if (values := getattr(self, name)) is not None
        }
        if self.model is not None:
            parts["model"] = Modelled(*(values[rows] for values in vars(self.model).values()))
        if self.groups is not None:
            parts["groups"] = ItemGroups(self.groups.number[rows], self.groups.target[rows])
        return parts

    def _products(self, upto: Float64Array) -> Float64Array:
        """(N,) products of ratios (N,) from the session's first step to each."""
        # One pass a place in the session: sums of logarithms would lose digits over many sessions.
        longest_first = np.argsort(-self.lengths, kind="stable")
        starts, lengths = self.first[longest_first], self.lengths[longest_first]
        for place in range(1, int(lengths[0])):
            at = starts[: np.searchsorted(-lengths, -place, side="left")] + place
            upto[at] = np.minimum(upto[at] * upto[at - 1], _LARGEST)
        return np.asarray(np.minimum(upto, _LARGEST))


def _without_rounding(probabilities: Float64Array) -> Float64Array:
    """The probabilities without rounding errors above 1; the same array where there are none."""
    above = (probabilities > 1) & (probabilities <= 1 + _ROUNDING)
    return np.where(above, 1.0, probabilities) if above.any() else probabilities


def _require_shape(name: str, values: Float64Array, n: int) -> None:
    if values.shape != (n,):
        raise InputError(f"{name} has shape {values.shape}, {n} steps are ({n},)")


def _require_finite(name: str, values: Float64Array, n: int) -> None:
    _require_shape(name, values, n)
    if (others := ~np.isfinite(values)).any():
        raise InputError(f"{name} is not finite at {others.sum():,} of {n:,} steps; correct it")


def _require_probabilities(
    propensity: Float64Array, target: Float64Array, n: int, most: float = 1.0
) -> None:
    """Args:
    most: what they may not exceed; infinity for densities.
    """
    _require_shape("propensity", propensity, n)
    _require_finite("target probability", target, n)
    if (others := (target < 0) | (target > most)).any():
        where = "are 0 or more" if most > 1 else "lie between 0 and 1"
        raise InputError(
            f"probabilities of the evaluated policy {where}; {_others(target, others)}"
        )
    if (others := (propensity <= 0) | (propensity > most) | np.isinf(propensity)).any():
        raise InputError(
            "propensities must be above 0 and at most 1, the probability of the item shown and not "
            f"a density; {_others(propensity, others)}; correct that column (arrays of vector "
            "actions: LoggedSteps(densities=True))"
        )


def _others(values: Float64Array, others: BoolArray) -> str:
    """How many values `others` marks, and the first of them."""
    return f"{others.sum():,} of {len(values):,} are outside, the first is {values[others][0]:.10g}"
