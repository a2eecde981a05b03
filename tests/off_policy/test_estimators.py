"""Off-policy estimates against slow loops, enumerated environments and what is known of them."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.logged_steps import fitted, random_steps, reference
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.off_policy.estimators import (
    LOGGED,
    MOST_CLUSTERS,
    NO_SPREAD,
    cluster_intervals,
    cluster_mean,
    estimate,
    session_terms,
    simultaneous_intervals,
)
from ucfrec.off_policy.logged_steps import LoggedSteps, Modelled


def rows_of(steps: LoggedSteps) -> list[list[int]]:
    return [np.flatnonzero(steps.session == s).tolist() for s in range(steps.session[-1] + 1)]


def by_hand(steps: LoggedSteps) -> dict[str, float]:
    """The estimators one session and one step at a time, from their definitions."""
    sums = dict.fromkeys(("logged", "DM", "FQE", "IPS", "PDIS", "DR"), 0.0)
    weights = []
    for rows in rows_of(steps):
        weight, earned = 1.0, 0.0
        sums["FQE"] += steps.model.v[rows[0]]
        for t, i in enumerate(rows):
            worth = steps.discount**t
            before, weight = weight, weight * steps.target[i] / steps.propensity[i]
            earned += worth * steps.reward[i]
            sums["DM"] += worth * steps.model.reward[i]
            sums["PDIS"] += worth * weight * steps.reward[i]
            sums["DR"] += worth * before * steps.model.v[i]
            sums["DR"] += worth * weight * (steps.reward[i] - steps.model.q[i])
        sums["logged"] += earned
        sums["IPS"] += weight * earned
        weights.append(weight)
    found = {name: total / len(weights) for name, total in sums.items()}
    if not any(weights):
        return {name: found[name] for name in ("logged", "DM", "FQE")}
    found["SNIPS"] = sums["IPS"] / sum(weights)
    found |= normalised_by_hand(steps)
    found["ess"] = sum(weights) ** 2 / sum(w * w for w in weights)
    return found


def normalised_by_hand(steps: LoggedSteps) -> dict[str, float]:
    """Weighted PDIS and weighted DR, every session going on without reward once it has ended."""
    sessions = rows_of(steps)
    weights = [1.0] * len(sessions)
    found = {"SNPDIS": 0.0, "SNDR": 0.0}
    for t in range(max(map(len, sessions))):
        before, worth = list(weights), steps.discount**t
        live = [(s, rows[t]) for s, rows in enumerate(sessions) if t < len(rows)]
        for s, i in live:
            weights[s] *= steps.target[i] / steps.propensity[i]
        for s, i in live:
            share = worth * weights[s] / sum(weights)
            found["SNPDIS"] += share * steps.reward[i]
            found["SNDR"] += share * (steps.reward[i] - steps.model.q[i])
            found["SNDR"] += worth * before[s] / sum(before) * steps.model.v[i]
    return found


@given(
    st.lists(st.integers(1, 6), min_size=2, max_size=30),
    st.integers(0, 1000),
    st.sampled_from([1.0, 0.8]),
)
def test_estimators_are_a_slow_loops(lengths: list[int], seed: int, discount: float) -> None:
    steps = random_steps(lengths, seed, discount=discount)
    expected, found = by_hand(steps), estimate(steps, 0)
    assert found.keys() - {"REG"} == expected.keys() - {"ess"}
    for name in found.keys() - {"REG"}:
        assert found[name].value == pytest.approx(expected[name], rel=1e-9, abs=1e-9), name
    for name, one in found.items():
        if one.low is not None and one.high is not None:
            assert one.low < one.high
            # Models' errors are not those of the sessions that they are averaged over.
            assert name not in ("DM", "FQE")
        assert 1 - 1e-9 <= one.effective_sessions <= len(lengths) * (1 + 1e-9)
        assert 1 / len(lengths) <= one.largest_weight * (1 + 1e-9) <= 1 + 2e-9
    # Only the ratio of densities counts, so a change of the actions' unit changes nothing.
    unit = {"propensity": steps.propensity * 1e6, "target": steps.target * 1e6}
    dense = estimate(replace(steps, **unit, densities=True), 0)
    for name, one in found.items():
        assert dense[name].value == pytest.approx(one.value, rel=1e-6, abs=1e-9), name
    if "IPS" in found:
        assert found["IPS"].effective_sessions == pytest.approx(expected["ess"], rel=1e-9)


@pytest.mark.parametrize("name", ["bandit", "sequence"])
def test_estimates_agree_with_open_bandit_pipeline_and_scope_rl(name: str) -> None:
    steps, expected = reference(name)
    found = estimate(steps, 0)
    both = found.keys() & expected.keys()
    shared = {"SNIPS", "IPS", "DR", "SNDR"}
    assert both == shared | ({"DM"} if name == "bandit" else {"FQE", "PDIS", "SNPDIS"})
    for one in both:
        assert found[one].value == pytest.approx(float(expected[one]), rel=1e-6, abs=1e-7), one


@given(st.lists(st.integers(1, 4), min_size=4, max_size=30), st.integers(0, 1000))
def test_no_coefficient_varies_less_between_users(lengths: list[int], seed: int) -> None:
    steps = replace(random_steps(lengths, seed), user=np.arange(len(lengths)) // 2)
    if terms := session_terms(steps):
        plain, full, fitted_ = (terms[name].above for name in ("SNPDIS", "SNDR", "REG"))
        choices = [plain + part * (full - plain) for part in np.linspace(0, 1, 201)]
        errors = [cluster_mean(x - steps.returns, steps.user)[1] for x in (fitted_, *choices)]
        assert errors[0] <= min(errors) * (1 + 1e-9)
        assert np.abs(np.array(choices) - fitted_).max(1).min() < np.ptp(choices) / 100


@given(st.lists(st.integers(1, 6), min_size=4, max_size=12), st.integers(0, 1000))
def test_influences_are_derivatives_of_the_estimate(lengths: list[int], seed: int) -> None:
    """A session counted twice moves the estimate by its influence, to first order."""
    steps = random_steps(lengths, seed, discount=0.9)
    lengths = lengths * 500
    many = LoggedSteps(
        session=np.repeat(np.arange(len(lengths)), lengths),
        reward=np.tile(steps.reward, 500),
        propensity=np.tile(steps.propensity, 500),
        target=np.tile(steps.target, 500),
        model=Modelled(*(np.tile(values, 500) for values in vars(steps.model).values())),
        discount=0.9,
    )
    for name in ("SNPDIS", "SNDR"):
        terms = session_terms(many).get(name)
        if terms is None:
            continue
        value, once = terms.above.mean(), np.arange(len(many.first)) > 0
        without = session_terms(many.select(once))[name].above.mean()
        moved = (value - without) * once.sum()
        assert moved == pytest.approx(terms.above[0] - value, rel=0.01, abs=1e-3), name


@dataclass(frozen=True)
class Environment:
    """Two states, two actions; a session ends after an action, or goes on in the other state."""

    behavior: Float64Array
    """(state, action)."""
    target: Float64Array
    pays: Float64Array
    ends: Float64Array
    """(state, action) probability that the session ends."""

    def sessions(self, longest: int) -> Iterator[tuple[float, list[tuple[int, int]]]]:
        """Every session from state 0 of at most `longest` steps, and its probability."""
        for length in range(1, longest + 1):
            for actions in itertools.product((0, 1), repeat=length):
                path = [(t % 2, action) for t, action in enumerate(actions)]
                likely = float(np.prod([self.behavior[at] for at in path]))
                likely *= float(np.prod([1 - self.ends[at] for at in path[:-1]]))
                yield likely * (1.0 if length == longest else float(self.ends[path[-1]])), path

    def q(self, longest: int) -> list[Float64Array]:
        """By steps left (0 to `longest`), (state, action) returns under the target."""
        table = [np.zeros((2, 2))]
        for _ in range(longest):
            v = (self.target * table[-1]).sum(1)
            table.append(self.pays + (1 - self.ends) * v[::-1, None])
        return table

    def logged(self, sessions: int, seed: int) -> tuple[LoggedSteps, IntArray]:
        """Logged sessions without limit, and the (state, action) of each step as 2 s + a."""
        rng, rows = np.random.default_rng(seed), []
        live, state = np.arange(sessions), 0
        while len(live):
            action = (rng.random(len(live)) < self.behavior[state, 1]).astype(int)
            rows.append(np.stack([live, np.full(len(live), len(rows)), 2 * state + action]))
            live = live[rng.random(len(live)) >= self.ends[state, action]]
            state = 1 - state
        session, _, at = (flat := np.concatenate(rows, axis=1))[:, np.lexsort(flat[1::-1])]
        return LoggedSteps(
            session=session,
            reward=self.pays.ravel()[at],
            propensity=self.behavior.ravel()[at],
            target=self.target.ravel()[at],
        ), at


ENVIRONMENT = Environment(
    behavior=np.array([[0.7, 0.3], [0.4, 0.6]]),
    target=np.array([[0.2, 0.8], [0.5, 0.5]]),
    pays=np.array([[1.0, 0.0], [0.5, 2.0]]),
    ends=np.array([[0.3, 0.2], [0.6, 0.25]]),
)


@pytest.mark.parametrize("right", [True, False])
def test_weighted_estimates_are_unbiased_whatever_the_model(right: bool) -> None:
    """Exactly, over every session that the behavior policy can log."""
    longest = 3
    table = ENVIRONMENT.q(longest)
    wrong = [np.random.default_rng(i).normal(size=(2, 2)) for i in range(longest + 1)]
    totals = dict.fromkeys(("IPS", "PDIS", "DR", "FQE"), 0.0)
    for likely, path in ENVIRONMENT.sessions(longest):
        qs = [(table if right else wrong)[longest - t] for t in range(len(path))]
        vs = [(ENVIRONMENT.target[s] * q[s]).sum() for q, (s, _) in zip(qs, path, strict=True)]
        none = np.zeros(len(path))
        steps = LoggedSteps(
            session=none.astype(np.int64),
            reward=np.array([ENVIRONMENT.pays[at] for at in path]),
            propensity=np.array([ENVIRONMENT.behavior[at] for at in path]),
            target=np.array([ENVIRONMENT.target[at] for at in path]),
            model=Modelled(
                none, [q[at] for q, at in zip(qs, path, strict=True)], np.array(vs), none
            ),
        )
        found = estimate(steps, 0)
        for name in totals:
            totals[name] += likely * found[name].value
    truth = float((ENVIRONMENT.target[0] * table[longest][0]).sum())
    for name in ("IPS", "PDIS", "DR"):
        assert totals[name] == pytest.approx(truth, rel=1e-12), name
    assert (abs(totals["FQE"] - truth) < 1e-12) is right


def test_fitted_q_evaluation_finds_the_value_of_a_environment_of_tables() -> None:
    steps, at = ENVIRONMENT.logged(10_000, seed=0)
    truth = float((ENVIRONMENT.target[0] * ENVIRONMENT.q(100)[100][0]).sum())
    state = at // 2
    features = np.column_stack([np.ones(len(at)), np.eye(4)[at]]).astype(np.float32)
    spread = np.zeros((len(at), 4))
    for action in (0, 1):
        spread[np.arange(len(at)), 2 * state + action] = ENVIRONMENT.target[state, action]
    at_policy = np.column_stack([np.ones(len(at)), spread]).astype(np.float32)
    model = fitted(features, at_policy, steps.reward, steps.session, seed=0)
    found = estimate(replace(steps, model=model), 0)
    on_policy = ENVIRONMENT.behavior[0] @ ENVIRONMENT.q(100)[100][0]
    assert abs(on_policy - truth) > 0.1
    assert found["FQE"].value == pytest.approx(truth, abs=0.03)
    assert found["DR"].low < truth < found["DR"].high
    # A model that is nearly right leaves the weights little to correct.
    assert found["DR"].high - found["DR"].low < found["PDIS"].high - found["PDIS"].low
    again = fitted(features, at_policy, steps.reward, steps.session, seed=0)
    for name, values in vars(model).items():
        np.testing.assert_array_equal(vars(again)[name], values)


def test_the_behavior_itself_is_its_own_mean() -> None:
    steps = random_steps([3, 1, 4] * 50)
    found = estimate(replace(steps, target=steps.propensity), seed=5)
    returns = np.array([steps.reward[steps.session == s].sum() for s in range(150)])
    mean, error = returns.mean(), returns.std() / 149**0.5
    for one in (found[name] for name in (LOGGED, "IPS", "SNIPS", "PDIS")):
        assert (one.value, one.effective_sessions) == pytest.approx((mean, 150))
        assert one.error == pytest.approx(error)
        ends = mean - 1.98 * error, mean + 1.98 * error
        assert (one.low, one.high) == pytest.approx(ends, abs=0.3 * error)


def test_a_few_missing_propensities_leave_their_sessions_out() -> None:
    """One in 4,000 does not switch the rest off."""
    steps = random_steps([2] * 2000, modelled=False)
    holed = steps.propensity.copy()
    holed[7] = np.nan
    found = estimate(replace(steps, propensity=holed), 0)
    expected = estimate(steps.select(np.arange(2000) != 3), 0)
    for name in expected.keys() - {LOGGED}:
        assert found[name] == expected[name], name
    assert found[LOGGED] == estimate(steps, 0)[LOGGED]
    nothing = replace(steps, propensity=np.full(4000, np.nan))
    assert set(estimate(nothing, 0)) == {LOGGED}


def test_long_sessions_overflow_nothing() -> None:
    steps = random_steps([3000, 2])
    steps = replace(steps, propensity=np.full(3002, 1e-3), target=np.ones(3002))
    for one in estimate(steps, 0).values():
        numbers = one.value, one.effective_sessions, one.low or 0, one.high or 0
        assert np.isfinite(numbers).all()


def column(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=np.float64)[:, None]


def covers(interval: object, truth: float) -> bool:
    return interval is not None and interval.low <= truth <= interval.high  # type: ignore[attr-defined]


def test_sessions_of_one_user_are_resampled_together() -> None:
    """Users of 20 sessions each, taste far more different between than within them."""
    together = apart = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        taste = np.repeat(rng.normal(size=40), 20)
        values, ones = column(taste + 0.5 * rng.normal(size=800)), np.ones((800, 1))
        users = np.repeat(rng.permutation(40), 20)
        together += covers(cluster_intervals(values, ones, users, seed)[0], 0.0)
        apart += covers(cluster_intervals(values, ones, None, seed)[0], 0.0)
    assert together >= 26
    assert apart <= 15


def test_heavy_weights_are_covered_as_the_percentile_interval_does_not() -> None:
    studentised = percentile = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        weights = rng.lognormal(sigma=1.2, size=200) / np.exp(0.72)
        (interval,) = cluster_intervals(column(weights), np.ones((200, 1)), None, seed)
        studentised += covers(interval, 1.0)
        means = rng.choice(weights, (1000, 200)).mean(axis=1)
        low, high = np.quantile(means, [0.025, 0.975])
        percentile += bool(low <= 1 <= high)
    assert studentised >= 90
    assert studentised > percentile


def test_where_nothing_spreads_there_is_no_interval() -> None:
    ones = np.ones((50, 1))
    for values in (np.zeros(50), np.ones(50), np.eye(1, 50)[0]):
        assert cluster_intervals(column(values), ones, None, 0) == [None]
        assert simultaneous_intervals(column(values), ones, None, 0) == [NO_SPREAD]
    one_user = np.zeros(50, dtype=np.int64)
    assert cluster_intervals(column(np.arange(50)), ones, one_user, 0) == [None]


def test_more_clusters_than_are_drawn_from_change_no_error() -> None:
    values = column(np.random.default_rng(0).exponential(size=3 * MOST_CLUSTERS))
    (interval,) = cluster_intervals(values, np.ones_like(values), None, seed=0)
    expected = values.std() / len(values) ** 0.5
    assert interval.error == pytest.approx(expected, rel=0.03)
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * expected, rel=0.08)


def test_means_have_clustered_errors() -> None:
    values, cluster = np.repeat([0.0, 1.0, 5.0], 4), np.repeat([7, 3, 9], 4)
    expected = 2.0, np.std([0, 1, 5], ddof=1) / 3**0.5
    assert cluster_mean(values, cluster) == pytest.approx(expected)
    weights = np.repeat([1.0, 1.0, 0.0], 4)
    assert cluster_mean(values, cluster, weights)[0] == pytest.approx(0.5)
