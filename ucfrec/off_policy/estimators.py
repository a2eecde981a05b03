"""The return per session of a policy, from logs of another: arrays in, estimates out.

Notation as in `ucfrec.off_policy.logged_steps`: G_i the logged return, w_it the weight of step t,
w_i that of the whole session, E_n the mean over sessions.

| name | equation | source |
|---|---|---|
| logged | E_n[G_i] | |
| DM | E_n[Σ_t γ^t r̂_it], states and lengths as logged | Dudík, Langford & Li, ICML 2011 |
| FQE | E_n[v_i0] | Le, Voloshin & Yue, ICML 2019 |
| IPS | E_n[w_i G_i] | Precup, Sutton & Singh, ICML 2000 |
| SNIPS | E_n[w_i G_i] / E_n[w_i] | Swaminathan & Joachims, NeurIPS 2015 |
| PDIS | E_n[Σ_t γ^t w_it r_it] | Precup, Sutton & Singh 2000 |
| SNPDIS | Σ_t γ^t E_n[w_it r_it] / E_n[w_it] | weighted PDIS: Precup 2000; Thomas 2015 |
| DR | E_n[Σ_t γ^t (w_it (r_it − q_it) + w_i,t−1 v_it)] | Dudík 2011; Jiang & Li, ICML 2016 |
| SNDR | DR with w_it / E_n[w_it] for w_it | weighted DR: Thomas & Brunskill, ICML 2016, eq. 8 |
| REG | SNPDIS + λ (SNDR − SNPDIS), λ fitted | after Kallus & Uehara, NeurIPS 2019 |

In the means over sessions at step t, a session that has ended counts with the weight of its last
step, as if it went on without reward (Thomas & Brunskill 2016).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.off_policy.logged_steps import LoggedSteps, number_clusters
from ucfrec.results.evidence import Evidence
from ucfrec.results.statistics import effective_number

SUITE = "off-policy"
"""Suite of the result rows."""
LOGGED = "logged"
_OF_MODEL = "only as good as its model, whose error no resampling shows"


@dataclass(frozen=True, kw_only=True)
class Estimate(Evidence):
    """Mean discounted return of a session. Its interval is that of `cluster_intervals`; DM and
    FQE have none, and where too few sessions have weight and reward."""

    value: float
    error: float | None
    """Standard error, over users."""
    effective_sessions: float
    """(Σw)² / Σw² of the sessions' weights (Kish 1965); S where nothing is weighted."""
    largest_weight: float
    """Share of the heaviest session in all weight."""


@dataclass(frozen=True)
class Terms:
    """An estimate as the ratio Σ above / Σ below of sums over sessions."""

    above: Float64Array
    """(S,)."""
    below: Float64Array
    weights: Float64Array
    """(S,) what each session counts."""
    doubt: str = ""
    """An error that no resampling shows: of a model."""

    @property
    def influences(self) -> Float64Array:
        """(S,) whose mean is the estimate, and whose spread is its error to first order."""
        value = self.above.sum() / self.below.sum()
        return np.asarray(value + (self.above - value * self.below) / self.below.mean())


def estimate(steps: LoggedSteps, seed: int, reasons: tuple[str, ...] = ()) -> dict[str, Estimate]:
    """Mean return per session as logged, and under the evaluated policy; `seed` draws resamples.

    Those with models need `steps.model`. Those that weigh leave out sessions with a step of unknown
    propensity, need any weight, and get the `reasons` against them.
    """
    ones = np.ones(len(steps.first))
    terms = {LOGGED: Terms(steps.returns, ones, ones)}
    if steps.model is not None:
        modelled = steps.per_session(steps.discounts * steps.model.reward)
        terms["DM"] = Terms(modelled, ones, ones, doubt=_OF_MODEL)
        terms["FQE"] = Terms(steps.model.v[steps.first], ones, ones, doubt=_OF_MODEL)
    estimates = _summarise(terms, steps.user, seed, ())
    if not steps.lacking.all() and (terms := session_terms(steps.weighable)):
        estimates |= _summarise(terms, steps.weighable.user, seed, reasons)
    return estimates


def _summarise(
    terms: Mapping[str, Terms],
    user: IntArray | None,
    seed: int,
    reasons: tuple[str, ...],
) -> dict[str, Estimate]:
    """Estimates with intervals by estimator, of sessions (S,) of `user` (S,)."""
    above, below = np.stack([(term.above, term.below) for term in terms.values()], axis=2)
    estimates, intervals = {}, cluster_intervals(above, below, user, seed)
    for (name, term), interval in zip(terms.items(), intervals, strict=True):
        low, high, error = NO_INTERVAL if term.doubt or interval is None else interval
        estimates[name] = Estimate(
            value=float(term.above.sum() / term.below.sum()),
            low=low,
            high=high,
            reasons=(term.doubt,) if term.doubt else reasons,
            error=error,
            effective_sessions=effective_number(term.weights),
            largest_weight=largest_share(term.weights),
        )
    return estimates


def largest_share(weights: Float64Array) -> float:
    """Share of the largest of weights (n,) in their sum; 1 where there is none."""
    return float(weights.max() / weights.sum()) if weights.any() else 1.0


def session_terms(steps: LoggedSteps) -> dict[str, Terms]:
    """The terms of every estimate that weighs, of steps with all propensities and any weight."""
    weights, last = steps.weights, steps.session_weights
    if not last.any():
        return {}
    ones = np.ones(len(last))
    terms = {
        "PDIS": Terms(steps.per_session(steps.discounts * weights * steps.reward), ones, last),
        "SNPDIS": Terms(normalise_by_step(steps, steps.reward), ones, last),
    }
    if steps.model is not None:
        q, v = steps.model.q, steps.model.v
        if steps.positions == "independent":
            # What follows at other positions is no business of this one.
            q, v = steps.model.logged_reward, steps.model.reward
        left = steps.reward - q
        corrected = weights * left + steps.weights_before * v
        terms["DR"] = Terms(steps.per_session(steps.discounts * corrected), ones, last)
        terms["SNDR"] = Terms(normalise_by_step(steps, left, v), ones, last)
        plain, control = terms["SNPDIS"].above, terms["SNDR"].above - terms["SNPDIS"].above
        coefficient = _fit_coefficient(plain - steps.returns, control, steps.users)
        terms["REG"] = Terms(plain + coefficient * control, ones, last)
    if steps.place is not None:
        return terms
    terms["IPS"] = Terms(last * steps.returns, ones, last)
    terms["SNIPS"] = Terms(last * steps.returns, last, last)
    return terms


def _fit_coefficient(lift: Float64Array, control: Float64Array, user: IntArray) -> float:
    """λ in [0, 1] for which the mean of lift + λ control, (S,) each, has the least variance over
    users (S,): 0 for the behavior policy itself, where the control is mere noise of a model."""
    lifts, controls = (np.bincount(user, values - values.mean()) for values in (lift, control))
    variance = float(controls @ controls)
    return float(np.clip(-float(lifts @ controls) / variance, 0.0, 1.0)) if variance else 0.0


def normalise_by_step(
    steps: LoggedSteps, left: Float64Array, v: Float64Array | None = None
) -> Float64Array:
    """(S,) estimate plus influence (the derivative by a session's share) of each session.

    The estimate is Σ_t γ^t [Σ_i w_it left_it / W_t + Σ_i w_i,t−1 v_it / W_t−1] with W_t = Σ_i w_it
    over sessions. In the bootstrap its influences stand for it: one number a session. `left` (N,)
    is the reward, or what a model leaves of it, whose values `v` (N,) then are.
    """
    weights, step = steps.weights, steps.step
    sessions, totals = len(steps.first), np.bincount(step, weights)
    # W_t by step of the longest session; sessions that ended have their last weight.
    totals += np.cumsum(np.bincount(steps.lengths, steps.session_weights, len(totals) + 1))[:-1]
    by_step = steps.discount ** np.arange(len(totals))
    rewarded = by_step * np.bincount(step, weights * left) / totals
    mine = steps.discounts * weights * left / totals[step]
    # What W_t in the denominators takes off, for each unit of weight at step t.
    slopes = rewarded / totals
    value, start = float(rewarded.sum()), 0.0
    if v is not None:
        totals_before = np.append(float(sessions), totals[:-1])
        earlier = steps.weights_before
        valued = by_step * np.bincount(step, earlier * v) / totals_before
        mine = mine + steps.discounts * earlier * v / totals_before[step]
        slopes[:-1] += (valued / totals_before)[1:]
        value, start = value + float(valued.sum()), float(valued[0]) / sessions
    # After its last step a session's weight stays and goes on to count in the denominators.
    tail = np.append(np.cumsum(slopes[::-1])[::-1], 0.0)
    taken = steps.per_session(weights * slopes[step])
    taken += steps.session_weights * tail[steps.lengths]
    return value + sessions * (steps.per_session(mine) - taken - start)


RESAMPLES = 2000
MOST_CLUSTERS = 10_000
"""Of more, random groups are drawn: the error stays, and time and memory are bounded."""
FEWEST_USERS = 10
"""Users below which their spread says too little for a conclusion."""
_CLUSTERS_AT_ONCE = 2**10
_USABLE = 0.9
"""Share of resamples that must have a spread of their own."""


class Interval(NamedTuple):
    """What resampling says of a number."""

    low: float
    high: float
    error: float
    """Standard error, over clusters."""


NO_INTERVAL = (None, None, None)
NO_SPREAD = Evidence(None, None, None, ("the sessions do not differ enough for an interval",))


def cluster_intervals(
    above: Float64Array,
    below: Float64Array,
    cluster: IntArray | None,
    seed: int,
) -> list[Interval | None]:
    """Studentised 95% bootstrap intervals of the ratios Σ above / Σ below, of values (S, K) with a
    column each; None where more than a tenth of the resamples have no spread.

    Clusters are drawn with replacement, each with all its sessions (Cameron, Gelbach & Miller,
    Review of Economics and Statistics 2008), and every resample's deviation is divided by its own
    standard error (Efron & Tibshirani 1993, section 12.5): where a few heavy weights carry the sum,
    value and error rise and fall together, which percentiles of the value alone miss. `cluster`
    (S,) has any integers; None where each session is its own.
    """
    resamples = resample(above, below, cluster, seed)
    intervals: list[Interval | None] = []
    for value, error, deviations in zip(
        resamples.value, resamples.error, resamples.studentised.T, strict=True
    ):
        usable = deviations[np.isfinite(deviations)]
        if len(usable) < _USABLE * RESAMPLES:
            intervals.append(None)
            continue
        low_t, high_t = np.quantile(usable, [0.025, 0.975])
        low, high = float(value - high_t * error), float(value - low_t * error)
        intervals.append(Interval(low, high, float(error)))
    return intervals


def simultaneous_intervals(
    above: Float64Array, below: Float64Array, cluster: IntArray | None, seed: int
) -> list[Evidence]:
    """Ratios as of `cluster_intervals`, with intervals that hold all of them at once with 95%
    probability (max-t: Romano & Wolf, Econometrica 2005)."""
    resamples = resample(above, below, cluster, seed)
    half = find_critical(np.abs(resamples.studentised)) * resamples.error
    usable = np.isfinite(resamples.studentised).mean(axis=0) >= _USABLE
    ends = np.stack([resamples.value, resamples.value - half, resamples.value + half], axis=1)
    return [
        Evidence(value, low, high) if enough else NO_SPREAD
        for (value, low, high), enough in zip(ends.tolist(), usable, strict=True)
    ]


def find_critical(deviations: Float64Array) -> float:
    """The 95% quantile of the largest deviation (B, K) of a resample; one without a spread is 0."""
    return float(np.quantile(np.nan_to_num(deviations).max(axis=1), 0.95))


@dataclass(frozen=True)
class Resamples:
    """K ratios, and B resamples of them; the same clusters are drawn for all K."""

    value: Float64Array
    """(K,)."""
    error: Float64Array
    """(K,) standard errors over clusters."""
    shift: Float64Array
    """(B, K) of each resample: its ratio less `value`."""
    studentised: Float64Array
    """(B, K) `shift` in standard errors of the resample; NaN where clusters do not differ."""


def resample(
    above: Float64Array,
    below: Float64Array,
    cluster: IntArray | None,
    seed: int,
) -> Resamples:
    """Draw clusters with replacement, each with all its sessions: `cluster_intervals`."""
    names = number_clusters(cluster, len(above))
    clusters = int(names.max()) + 1
    if clusters > MOST_CLUSTERS:
        shuffled = np.random.default_rng(seed).permutation(clusters)
        names, clusters = shuffled[names] % MOST_CLUSTERS, MOST_CLUSTERS
    above, below = (
        np.stack([np.bincount(names, column, clusters) for column in values.T], 1, dtype=float)
        for values in (above, below)
    )
    with np.errstate(divide="ignore", invalid="ignore"):  # where nothing has weight
        value = above.sum(axis=0) / below.sum(axis=0)
        # In units that keep squares of large weights finite.
        size = np.abs(below).max(axis=0)
        e, b = (above - value * below) / size, below / size
        correction = np.sqrt(clusters / max(clusters - 1, 1))
        error = correction * np.sqrt((e**2).sum(axis=0)) / b.sum(axis=0)
    moments = np.concatenate([e, b, e * e, e * b, b * b], axis=1)
    # How often each cluster is drawn stands for the resampled rows; as floats, some at a time.
    counts = np.array_split(_draw_counts(clusters, seed), max(1, clusters // _CLUSTERS_AT_ONCE))
    sums = np.concatenate([times.astype(np.float64) @ moments for times in counts])
    e, b, ee, eb, bb = sums.reshape(-1, 5, len(value)).swapaxes(0, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.where(b > 0, e / b, np.nan)
        spread = np.maximum(ee - 2 * shift * eb + shift**2 * bb, 0.0)
        errors = correction * np.sqrt(spread) / b
    usable = (clusters > 1) & np.isfinite(shift) & (errors > 1e-9 * error)
    studentised = np.full(shift.shape, np.nan)
    studentised[usable] = shift[usable] / errors[usable]
    return Resamples(value, error, shift, studentised)


def cluster_mean(
    values: Float64Array, cluster: IntArray | None, weights: Float64Array | None = None
) -> tuple[float, float]:
    """Mean of values (S,), of weights (S,) if given, and its standard error over clusters (S,)."""
    names = number_clusters(cluster, len(values))
    above = np.bincount(names, values if weights is None else values * weights)
    below, clusters = np.bincount(names, weights), len(above)
    mean = above.sum() / below.sum()
    spread = np.square(above - mean * below).sum()
    return float(mean), float(np.sqrt(clusters / max(clusters - 1, 1) * spread) / below.sum())


@lru_cache(maxsize=1)
def _draw_counts(clusters: int, seed: int) -> npt.NDArray[np.uint16]:
    """(B, C) how often each resample has each cluster, at most 40 MB; kept for the next call."""
    generator = np.random.default_rng(seed)
    counts = np.empty((RESAMPLES, clusters), dtype=np.uint16)
    for times in counts:
        times[:] = np.bincount(generator.integers(clusters, size=clusters), minlength=clusters)
    counts.setflags(write=False)
    return counts
