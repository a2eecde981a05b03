"""Logged steps as flat arrays, the importance weights that follow from them, and lists.

Notation of the whole package: session i of S, step t (from 0) of its T_i steps; ρ_it =
target / propensity of the logged action; w_it = Π_{k ≤ t} ρ_ik, with w_i,−1 = 1; γ the discount.

Where decisions are lists, the steps are their positions, and ρ_it is given the items before it in
the list. What the positions of a decision weigh follows from how they are assumed to influence each
other (McInerney, Brost, Chandar, Mehrotra & Carterette, KDD 2020), after w of all earlier
decisions:

| `positions` | the reward at a position depends on the items at | weight |
|---|---|---|
| independent | this position | ρ_it (Li et al., KDD 2018) |
| cascade | this position and those before it | Π_{k ≤ t} ρ_ik of the list |
| whole list | all positions | Π_k ρ_ik of the list |

Each model contains the one above it: a weaker assumption, and heavier weights. `merge_lists` turns
lists into single steps, for the last one.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, TypeAlias

import numpy as np

from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError

_LARGEST = 1e100
"""Weights stop here: beyond, an estimate means nothing, and their squares stay finite."""
_SMALLEST = 1e-300
"""Probability of a list from which on it is above 0 in float64."""
_ROUNDING = 1e-6
"""By how much a probability may be above 1; it counts as 1."""
Positions: TypeAlias = Literal["whole list", "cascade", "independent"]
_PROBABILITIES = ("propensity", "target")
_COLUMNS = ("reward", *_PROBABILITIES)
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
            object.__setattr__(self, name, _require_finite(f"modelled {name}", values))


@dataclass(frozen=True)
class ItemGroups:
    """Groups of items alike, of N logged steps: each is tested alone (`diagnose`)."""

    number: IntArray
    """(N,) group of the logged item, from 0; −1 for an item of none."""
    target: Float32Array
    """(N, K) the evaluated policy's probability of every group."""


@dataclass(frozen=True)
class LoggedSteps:
    """N logged steps of S sessions, a session's steps together and in order.

    Lists and pandas Series are taken as well, by place and not by index; numbers are kept as
    float64, and users that are not integers are numbered. InputError if something is missing, has
    another length, or is out of its range.
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
    """(S,) whose session it is, resampled together; None where each is of another user."""
    discount: float = 1.0
    """γ in (0, 1]: a reward at step t (from 0) counts γ^t."""
    groups: ItemGroups | None = None
    densities: bool = False
    """Whether `propensity` and `target` are densities of vector actions, which may exceed 1."""
    place: IntArray | None = None
    """(N,) position of each step in its decision's list, from 0; None where each is a decision."""
    positions: Positions = "cascade"
    """How the positions of a list influence each other."""

    def __post_init__(self) -> None:
        replace_field = partial(object.__setattr__, self)
        session: Array = np.asarray(self.session)
        if session.dtype.kind not in "iu":
            session = _convert_to_floats("session", session)
        rises = np.diff(session, prepend=-1)
        if not len(session) or rises[0] != 1 or not np.isin(rises, (0, 1)).all():
            raise InputError("sessions are numbered from 0 in order, and there is at least one")
        replace_field("session", session.astype(np.int64, copy=False))
        n = len(session)
        replace_field("reward", _require_finite("reward", self.reward))
        for name in _PROBABILITIES:
            values = getattr(self, name)
            replace_field(name, _check_probabilities(name, values, self.densities))
        if self.user is not None:
            replace_field("user", _number_users(self.user))
        columns = [(name, getattr(self, name)) for name in (*_COLUMNS, "place")]
        for part in (self.model, self.groups):
            columns += vars(part).items() if part else ()
        for name, values in columns:
            if values is not None and len(values) != n:
                raise InputError(f"{name} has {len(values):,} values for {n:,} steps")
        if self.user is not None and len(self.user) != len(self.first):
            raise InputError(f"user has {len(self.user):,} values for {len(self.first):,} sessions")
        if not 0 < self.discount <= 1:
            raise InputError(f"discount is {self.discount}; it is above 0 and at most 1")

    @cached_property
    def first(self) -> IntArray:
        """(S,) step that begins each session."""
        return np.flatnonzero(np.diff(self.session, prepend=-1))

    @cached_property
    def users(self) -> IntArray:
        """(S,) users numbered from 0; each session is one where users are unknown."""
        return number_clusters(self.user, len(self.first))

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
    def rows_by_place(self) -> list[IntArray]:
        """The steps at every place in a session, sessions in order."""
        order = np.argsort(self.step, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.step))[:-1])

    @cached_property
    def decision(self) -> IntArray:
        """(N,) number of each step's decision, from 0."""
        if self.place is None:
            return np.arange(len(self.session))
        begins = self.place == 0
        begins[self.first] = True
        return np.cumsum(begins) - 1

    @cached_property
    def discounts(self) -> Float64Array:
        """(N,) γ^t, with t the number of the decision in its session."""
        number = self.decision - self.decision[self.first][self.session]
        return np.asarray(self.discount**number, dtype=np.float64)

    @cached_property
    def returns(self) -> Float64Array:
        """(S,) discounted return of each session as logged."""
        return self.per_session(self.discounts * self.reward)

    @cached_property
    def weights(self) -> Float64Array:
        """(N,) w_it; NaN from a step without propensity on."""
        ratios = self.target / self.propensity
        if self.place is None or self.positions == "cascade":
            return self._multiply(ratios)
        return self._weights_before_lists * ratios

    @cached_property
    def _weights_before_lists(self) -> Float64Array:
        """(N,) the weight of all decisions before a step's own."""
        products = self.shift(self._multiply(self.target / self.propensity))
        starts = np.flatnonzero(np.diff(self.decision, prepend=-1))
        return products[starts][self.decision]

    @cached_property
    def session_weights(self) -> Float64Array:
        """(S,) w of each session's last step, of all its ratios; with lists, the steps' mean."""
        if self.place is None:
            return self.weights[self.last]
        return self.per_session(self.weights) / self.lengths

    def per_session(self, values: Float64Array) -> Float64Array:
        """(S,) sums of values (N,)."""
        return np.add.reduceat(values, self.first)

    @cached_property
    def weights_before(self) -> Float64Array:
        """(N,) what weighs the values v_it: w_i,t−1, or that of earlier decisions."""
        if self.place is None or self.positions == "cascade":
            return self.shift(self.weights)
        return self._weights_before_lists

    def shift(self, products: Float64Array) -> Float64Array:
        """(N,) w_i,t−1 of products w_it (N,): 1 at the first step."""
        earlier = np.roll(products, 1)
        earlier[self.first] = 1.0
        return earlier

    @cached_property
    def weighable(self) -> "LoggedSteps":
        """The sessions of whose every step the propensity is known, renumbered; there is one."""
        return self.select(~self.lacking) if self.lacking.any() else self

    def select(self, sessions: BoolArray) -> "LoggedSteps":
        """The sessions that a mask (S,) marks, renumbered."""
        rows = np.flatnonzero(sessions[self.session])
        taken: dict[str, Any] = {"session": (np.cumsum(sessions) - 1)[self.session[rows]]}
        if self.user is not None:
            taken["user"] = self.user[sessions]
        for name, value in vars(self).items():
            if name in (*_COLUMNS, "place") and value is not None:
                taken[name] = value[rows]
            elif isinstance(value, (Modelled, ItemGroups)):
                columns = {key: column[rows] for key, column in vars(value).items()}
                taken[name] = replace(value, **columns)
        return replace(self, **taken)

    def _multiply(self, ratios: Float64Array) -> Float64Array:
        """(N,) products of ratios (N,) from the session's first step to each, in place."""
        # One pass a place in the session: sums of logarithms would lose digits over many sessions.
        for rows in self.rows_by_place[1:]:
            ratios[rows] = np.minimum(ratios[rows] * ratios[rows - 1], _LARGEST)
        return np.minimum(ratios, _LARGEST)


def number_clusters(cluster: IntArray | None, sessions: int) -> IntArray:
    """(S,) clusters numbered from 0; each session is one where they are unknown."""
    return np.arange(sessions) if cluster is None else np.unique(cluster, return_inverse=True)[1]


def _convert_to_floats(name: str, values: Any) -> Float64Array:
    """(N,) values as float64, not copied where they are that; NaN where one is missing."""
    try:
        column = np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is no array of numbers ({error})") from None
    if column.ndim != 1:
        raise InputError(f"{name} has shape {column.shape}; give one number a step")
    return column


def _number_users(values: Any) -> Array:
    """(S,) integer users as they are; others (text, objects) numbered from 0."""
    users = np.asarray(values)
    if users.dtype.kind in "iu":
        return users
    try:
        if not np.sum(users != users):
            return np.unique(users, return_inverse=True)[1]
    except TypeError:
        pass
    raise InputError("users are missing, or of several types: give all as text, or none")


def _require_finite(name: str, values: Any) -> Float64Array:
    column = _convert_to_floats(name, values)
    if count := int((~np.isfinite(column)).sum()):
        raise InputError(f"{name} is not finite at {count:,} of {len(column):,} steps; correct it")
    return column


def _check_probabilities(name: str, values: Any, densities: bool) -> Float64Array:
    """The probabilities without rounding errors above 1; the same array where there are none."""
    values = np.asarray(_convert_to_floats(name, values))
    above = (values > 1) & (values <= 1 + _ROUNDING)
    if above.any() and not densities:
        values = np.where(above, 1.0, values)
    inside = np.isfinite(values) if densities else values <= 1
    outside = ~((values > 0) & inside | np.isnan(values))
    rule = "propensities must be above 0 and at most 1, probabilities of the item shown, no density"
    remedy = "; correct that column (arrays of vector actions: LoggedSteps(densities=True))"
    if name == "target":
        outside = ~((values >= 0) & inside)
        rule, remedy = "probabilities of the evaluated policy lie between 0 and 1", ""
    if outside.any():
        raise InputError(
            f"{rule}; {outside.sum():,} of {len(values):,} are outside, the first is "
            f"{values[outside][0]:.10g}{remedy}"
        )
    return np.asarray(values)


def merge_lists(steps: LoggedSteps) -> LoggedSteps:
    """Every decision as one step: its rewards, observed and modelled, summed, its probabilities
    multiplied. Models of the return are those of the first position."""
    starts = np.flatnonzero(np.diff(steps.decision, prepend=-1))
    add, multiply = (partial(of.reduceat, indices=starts) for of in (np.add, np.multiply))
    model = steps.model and Modelled(
        reward=add(steps.model.reward),
        q=steps.model.q[starts],
        v=steps.model.v[starts],
        logged_reward=add(steps.model.logged_reward),
    )
    return LoggedSteps(
        session=steps.session[starts],
        reward=add(steps.reward),
        propensity=np.maximum(multiply(steps.propensity), _SMALLEST),
        target=multiply(steps.target),
        model=model,
        user=steps.user,
        discount=steps.discount,
        positions="whole list",
    )
