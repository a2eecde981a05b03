"""Off-policy estimates against slow loops, enumerated worlds and what is known of them."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.errors import InputError
from ucfrec.evaluation.metrics import bootstrap_interval
from ucfrec.off_policy.estimators import LOGGED, WEIGHTED, LoggedSteps, estimate, overlap, warnings
from ucfrec.off_policy.fqe import Modelled, cross_fitted

FloatArray = npt.NDArray[np.float64]


def random_steps(lengths: list[int], seed: int = 0, modelled: bool = True) -> LoggedSteps:
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    return LoggedSteps(
        session=np.repeat(np.arange(len(lengths)), lengths),
        reward=rng.normal(size=n),
        propensity=rng.uniform(0.05, 1, n),
        target=rng.uniform(0, 1, n) * (rng.random(n) < 0.9),
        model=Modelled(*rng.normal(size=(3, n))) if modelled else None,
    )


def values_of(model: Modelled) -> tuple[FloatArray, FloatArray, FloatArray]:
    return model.reward, model.q, model.v


def by_hand(steps: LoggedSteps) -> dict[str, float]:
    """The estimators one session and one step at a time, from their definitions."""
    assert steps.model is not None
    sums = dict.fromkeys(("logged", "DM", "FQE", "IPS", "PDIS", "DR"), 0.0)
    weights = []
    for session in range(steps.session[-1] + 1):
        rows = [i for i, s in enumerate(steps.session) if s == session]
        weight, earned = 1.0, 0.0
        sums["FQE"] += steps.model.v[rows[0]]
        for i in rows:
            before, weight = weight, weight * steps.target[i] / steps.propensity[i]
            earned += steps.reward[i]
            sums["DM"] += steps.model.reward[i]
            sums["PDIS"] += weight * steps.reward[i]
            sums["DR"] += before * steps.model.v[i]
            sums["DR"] += weight * (steps.reward[i] - steps.model.q[i])
        sums["logged"] += earned
        sums["IPS"] += weight * earned
        weights.append(weight)
    found = {name: total / len(weights) for name, total in sums.items()}
    if not any(weights):
        return {name: found[name] for name in ("logged", "DM", "FQE")}
    found["SNIPS"] = sums["IPS"] / sum(weights)
    found["ess"] = sum(weights) ** 2 / sum(w * w for w in weights)
    return found


@given(st.lists(st.integers(1, 6), min_size=2, max_size=30), st.integers(0, 1000))
def test_the_estimators_are_those_of_a_slow_loop(lengths: list[int], seed: int) -> None:
    steps = random_steps(lengths, seed)
    expected, found = by_hand(steps), estimate(steps, 0)
    assert expected.keys() - {"ess"} == found.keys()
    for name, one in found.items():
        assert one.value == pytest.approx(expected[name], rel=1e-9, abs=1e-9), name
        assert one.low <= one.high
    if "IPS" in found:
        assert found["IPS"].effective_sessions == pytest.approx(expected["ess"], rel=1e-9)


@given(st.integers(1, 5), st.integers(0, 1000), st.floats(0.05, 1.0))
def test_snips_ignores_the_scale_of_propensities(length: int, seed: int, scale: float) -> None:
    steps = random_steps([length] * 20, seed)
    found = estimate(steps, 0)
    scaled = estimate(replace(steps, propensity=steps.propensity * scale), 0)
    assert scaled.keys() == found.keys()
    if "SNIPS" in found:
        assert scaled["SNIPS"].value == pytest.approx(found["SNIPS"].value, rel=1e-9)
        assert scaled["IPS"].value == pytest.approx(found["IPS"].value / scale**length, rel=1e-9)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=30), st.integers(0, 1000))
def test_effective_sessions_are_between_one_and_all(lengths: list[int], seed: int) -> None:
    for one in estimate(random_steps(lengths, seed), 0).values():
        assert 1 - 1e-9 <= one.effective_sessions <= len(lengths) * (1 + 1e-9)
        assert 1 / len(lengths) <= one.largest_weight * (1 + 1e-9)
        assert one.largest_weight <= 1 + 1e-9


@dataclass(frozen=True)
class World:
    """Two states, two actions; a session ends after an action, or goes on in the other state."""

    behavior: FloatArray
    """(state, action)."""
    target: FloatArray
    pays: FloatArray
    ends: FloatArray
    """(state, action) probability that the session ends."""

    def sessions(self, longest: int) -> Iterator[tuple[float, list[tuple[int, int]]]]:
        """Every session from state 0 of at most `longest` steps, and its probability."""
        for length in range(1, longest + 1):
            for actions in itertools.product((0, 1), repeat=length):
                path = [(t % 2, action) for t, action in enumerate(actions)]
                likely = float(np.prod([self.behavior[at] for at in path]))
                likely *= float(np.prod([1 - self.ends[at] for at in path[:-1]]))
                yield likely * (1.0 if length == longest else float(self.ends[path[-1]])), path

    def q(self, longest: int) -> list[FloatArray]:
        """By steps left (0 to `longest`), (state, action) returns under the target."""
        table = [np.zeros((2, 2))]
        for _ in range(longest):
            v = (self.target * table[-1]).sum(1)
            table.append(self.pays + (1 - self.ends) * v[::-1, None])
        return table

    def logged(self, sessions: int, seed: int) -> tuple[LoggedSteps, npt.NDArray[np.int64]]:
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


WORLD = World(
    behavior=np.array([[0.7, 0.3], [0.4, 0.6]]),
    target=np.array([[0.2, 0.8], [0.5, 0.5]]),
    pays=np.array([[1.0, 0.0], [0.5, 2.0]]),
    ends=np.array([[0.3, 0.2], [0.6, 0.25]]),
)


@pytest.mark.parametrize("right", [True, False])
def test_weighted_estimates_are_unbiased_whatever_the_model(right: bool) -> None:
    """Exactly, over every session that the behavior policy can log."""
    longest = 3
    table = WORLD.q(longest)
    wrong = [np.random.default_rng(i).normal(size=(2, 2)) for i in range(longest + 1)]
    totals = dict.fromkeys(("IPS", "PDIS", "DR", "FQE"), 0.0)
    for likely, path in WORLD.sessions(longest):
        qs = [(table if right else wrong)[longest - t] for t in range(len(path))]
        states = [state for state, _ in path]
        steps = LoggedSteps(
            session=np.zeros(len(path), dtype=np.int64),
            reward=np.array([WORLD.pays[at] for at in path]),
            propensity=np.array([WORLD.behavior[at] for at in path]),
            target=np.array([WORLD.target[at] for at in path]),
            model=Modelled(
                reward=np.zeros(len(path)),
                q=np.array([q[at] for q, at in zip(qs, path, strict=True)]),
                v=np.array(
                    [(WORLD.target[s] * q[s]).sum() for q, s in zip(qs, states, strict=True)]
                ),
            ),
        )
        found = estimate(steps, 0)
        for name in totals:
            totals[name] += likely * found[name].value
    truth = float((WORLD.target[0] * table[longest][0]).sum())
    for name in ("IPS", "PDIS", "DR"):
        assert totals[name] == pytest.approx(truth, rel=1e-12), name
    assert (abs(totals["FQE"] - truth) < 1e-12) is right


def test_fitted_q_evaluation_finds_the_value_of_a_world_of_tables() -> None:
    steps, at = WORLD.logged(10_000, seed=0)
    truth = float((WORLD.target[0] * WORLD.q(100)[100][0]).sum())
    state = at // 2
    features = np.column_stack([np.ones(len(at)), np.eye(4)[at]]).astype(np.float32)
    spread = np.zeros((len(at), 4))
    for action in (0, 1):
        spread[np.arange(len(at)), 2 * state + action] = WORLD.target[state, action]
    at_policy = np.column_stack([np.ones(len(at)), spread]).astype(np.float32)
    model = cross_fitted(features, at_policy, steps.reward, steps.session, seed=0)
    found = estimate(replace(steps, model=model), 0)
    on_policy = WORLD.behavior[0] @ WORLD.q(100)[100][0]
    assert abs(on_policy - truth) > 0.1
    assert found["FQE"].value == pytest.approx(truth, abs=0.03)
    assert found["DR"].low < truth < found["DR"].high
    # A model that is nearly right leaves the weights little to correct.
    assert found["DR"].high - found["DR"].low < found["PDIS"].high - found["PDIS"].low
    again = cross_fitted(features, at_policy, steps.reward, steps.session, seed=0)
    for mine, yours in zip(values_of(model), values_of(again), strict=True):
        np.testing.assert_array_equal(mine, yours)


def test_no_session_is_judged_by_a_model_that_saw_it() -> None:
    rng = np.random.default_rng(0)
    session = np.repeat(np.arange(40), 3)
    features = np.column_stack([np.ones(120), rng.normal(size=(120, 3))]).astype(np.float32)
    reward = rng.normal(size=120)
    before = cross_fitted(features, features, reward, session, seed=3)
    mine = session == 7
    after = cross_fitted(features, features, np.where(mine, 50.0, reward), session, seed=3)
    for found, expected in zip(values_of(after), values_of(before), strict=True):
        np.testing.assert_array_equal(found[mine], expected[mine])
    assert not np.allclose(after.reward[~mine], before.reward[~mine])


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    """Of a policy near the behavior. `WORLD`'s own target has weights with so heavy a tail that 95%
    intervals cover 78 to 90% (200 repetitions of 400 sessions, 60 of 4,000)."""
    near = replace(WORLD, target=np.full((2, 2), 0.5))
    truth = float((near.target[0] * near.q(100)[100][0]).sum())
    covered = dict.fromkeys(("IPS", "SNIPS", "PDIS"), 0)
    for seed in range(60):
        found = estimate(near.logged(400, seed)[0], seed)
        for name in covered:
            covered[name] += found[name].low <= truth <= found[name].high
    # In 200 repetitions, 92, 94.5 and 94%; 56 of 60 are expected, 50 three deviations below.
    for name, times in covered.items():
        assert times >= 50, (name, times)


def test_the_behavior_itself_is_its_own_mean() -> None:
    steps = random_steps([3, 1, 4] * 50)
    found = estimate(replace(steps, target=steps.propensity), seed=5)
    returns = np.array([steps.reward[steps.session == s].sum() for s in range(150)])
    for name in (LOGGED, "IPS", "SNIPS", "PDIS"):
        assert found[name].value == pytest.approx(returns.mean())
        assert found[name].effective_sessions == pytest.approx(150)
        interval = (found[name].low, found[name].high)
        assert interval == pytest.approx(bootstrap_interval(returns, seed=5))
    assert overlap(replace(steps, target=steps.propensity)) == pytest.approx(1)


def test_long_sessions_overflow_nothing() -> None:
    steps = random_steps([3000, 2])
    steps = replace(steps, propensity=np.full(3002, 1e-3), target=np.ones(3002))
    for one in estimate(steps, 0).values():
        assert np.isfinite([one.value, one.low, one.high, one.effective_sessions]).all()


def test_what_should_not_be_believed_is_said() -> None:
    steps = random_steps([2] * 50)
    assert "effective sample" in " ".join(warnings(steps, estimate(steps, 0)))
    narrow = replace(steps, target=steps.propensity * 0.5)
    assert "overlap 0.50" in warnings(narrow, estimate(narrow, 0))[0]
    never = replace(steps, target=np.zeros(100))
    assert set(estimate(never, 0)) == {LOGGED, "DM", "FQE"}
    assert any("no session has any weight" in line for line in warnings(never, estimate(never, 0)))
    alone = replace(steps, target=np.where(steps.session == 3, 1.0, steps.target / 10))
    assert any("of all weight" in line for line in warnings(alone, estimate(alone, 0)))
    partly = replace(steps, propensity=np.where(np.arange(100) == 4, np.nan, steps.propensity))
    assert not set(estimate(partly, 0)) & set(WEIGHTED)
    (line,) = warnings(partly, estimate(partly, 0))
    assert line.startswith("1 of 100 steps have no propensity")
    many = replace(random_steps([1] * 2000), target=random_steps([1] * 2000).propensity)
    assert warnings(many, estimate(many, 0)) == []


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"propensity": np.zeros(10)}, "propensities must be above 0"),
        ({"propensity": np.full(10, 1.5)}, "not a density"),
        ({"target": np.full(10, 1.1)}, "between 0 and 1"),
        ({"target": np.full(10, np.nan)}, "target is not finite at 10 steps"),
        ({"reward": np.full(10, np.inf)}, "reward is not finite"),
        ({"reward": np.zeros(9)}, r"reward has shape \(9,\)"),
        ({"session": np.arange(10)[::-1]}, "numbered from 0 in order"),
        ({"session": np.arange(10) * 2}, "numbered from 0 in order"),
    ],
)
def test_wrong_arrays_are_input_errors(change: dict[str, FloatArray], says: str) -> None:
    with pytest.raises(InputError, match=says):
        replace(random_steps([2] * 5), **change)


def test_one_session_cannot_be_modelled() -> None:
    one = np.ones((3, 1), dtype=np.float32)
    with pytest.raises(InputError, match="sessions other than the one"):
        cross_fitted(one, one, np.ones(3), np.zeros(3, dtype=np.int64), seed=0)
