"""Misleading logs end in the right number or the right refusal, and good logs in a verdict."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.support.logged_steps import fitted
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.off_policy import LoggedSteps, conclude, diagnose, estimate
from ucfrec.off_policy.verdict import list_cautions

ITEMS = 10
PAYS = np.linspace(0.1, 0.5, ITEMS)
"""Probability of a reward, by item."""


def logs(
    sessions: int, seed: int = 0, length: int = 1, behavior: Float64Array | None = None
) -> tuple[LoggedSteps, IntArray]:
    """Sessions of a behavior policy (uniform unless given) evaluated for one that likes later
    items; its value is `value(length)`. Returns the items shown too."""
    rng = np.random.default_rng(seed)
    behavior = np.full(ITEMS, 1 / ITEMS) if behavior is None else behavior
    items = rng.choice(ITEMS, p=behavior, size=sessions * length)
    return LoggedSteps(
        session=np.repeat(np.arange(sessions), length),
        reward=(rng.random(sessions * length) < PAYS[items]).astype(float),
        propensity=behavior[items],
        target=TARGET[items],
    ), items


TARGET = np.arange(1.0, ITEMS + 1) / np.arange(1.0, ITEMS + 1).sum()


def value(length: int = 1) -> float:
    return length * float(TARGET @ PAYS)


def test_good_logs_stand_and_say_what_the_policy_gains() -> None:
    steps, _ = logs(5000)
    verdict = conclude(steps, seed=0)
    lift = value() - PAYS.mean()
    assert verdict.reliable, verdict.reasons
    assert verdict.estimator == "SNPDIS"
    assert verdict.lift_low is not None
    assert verdict.lift_high is not None
    assert 0 < verdict.lift_low < lift < verdict.lift_high
    assert verdict.probability_better == 1
    assert str(verdict).startswith("The policy has a higher return than the logged one: +0.0")
    same = conclude(replace(steps, target=steps.propensity), seed=0)
    assert same.lift == pytest.approx(0)
    assert same.reasons == ("the sessions do not differ enough for an interval",)


def test_sessions_needed_are_enough_four_times_in_five() -> None:
    steps, _ = logs(5000)
    wanted = value() - PAYS.mean()
    needed = conclude(steps, seed=0, wanted_lift=wanted).sessions_needed
    assert needed is not None
    found = 0
    for seed in range(100):
        low = conclude(logs(needed, seed)[0], seed).lift_low
        found += low is not None and low > 0
    assert 65 <= found <= 95


def test_unknown_items_weigh_nothing() -> None:
    """Half the logged items are none of the policy's. Dropping these rows would take the mean over
    the rest, twice too much."""
    behavior = np.full(ITEMS, 1 / ITEMS)
    steps, items = logs(5000, behavior=behavior)
    known = np.arange(ITEMS) < 5
    target = np.where(known, 0.2, 0.0)
    truth = float(target @ PAYS)
    evaluated = replace(steps, target=target[items])
    one = estimate(evaluated, seed=0)["IPS"]
    assert one.low is not None
    assert one.high is not None
    assert one.low < truth < one.high
    dropped = estimate(evaluated.select(known[items]), seed=0)["IPS"]
    assert dropped.low is not None
    assert dropped.low > 1.5 * truth
    assert conclude(evaluated, seed=0).reliable


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("halved", "mean weight (2|1.99|2.01) ± .*: propensities are too small"),
        (
            "one",
            "mean weight 0.(1|09).* ± .*: the logs lack choices .*, or propensities are too large",
        ),
    ],
)
def test_wrong_propensities_are_refused(name: str, says: str) -> None:
    steps, _ = logs(5000)
    wrong = steps.propensity / 2 if name == "halved" else np.ones(5000)
    verdict = conclude(replace(steps, propensity=wrong), seed=0)
    assert not verdict.reliable
    assert re.search(says, str(verdict))


def test_unsupported_choices_over_ten_steps_are_refused_with_bounds() -> None:
    """The behavior never shows the last item, 15% of the policy's choices at every step."""
    behavior = np.append(np.full(ITEMS - 1, 1 / (ITEMS - 1)), 0.0)
    steps, items = logs(5000, length=10, behavior=behavior)
    target = np.append(np.full(ITEMS - 1, 0.85 / (ITEMS - 1)), 0.15)
    steps = replace(steps, target=target[items])
    truth = 10 * float(target @ PAYS)
    assert estimate(steps, seed=0)["PDIS"].value < 0.6 * truth
    diagnosis = diagnose(steps, reward_range=(0, 1))
    failed = {test.name for test in diagnosis.tests if not test.passed}
    assert failed >= {"step 1", "step 10", "session products"}
    assert diagnosis.bounds is not None
    assert diagnosis.bounds[0] < truth < diagnosis.bounds[1]
    verdict = conclude(steps, seed=0, diagnosis=diagnosis)
    assert not verdict.reliable
    assert "the logs lack choices that the policy makes" in str(verdict)
    assert f"the value lies between {diagnosis.bounds[0]:.4g}" in str(verdict)
    assert "evaluate with --filter-seen" in str(verdict)
    filtered = str(conclude(steps, seed=0, diagnosis=diagnosis, filter_seen=True))
    assert "evaluate with --filter-seen" not in filtered
    assert "items that requests excluded by candidates" in filtered


def test_a_mean_weight_that_is_off_by_chance_is_not_blamed_on_the_logs_alone() -> None:
    """Over many steps nearly all weight is in sessions too rare to be drawn."""
    for seed in range(20):
        steps, _ = logs(1500, seed, length=12)
        steps = replace(steps, target=(steps.target * ITEMS) ** 2 / (TARGET**2).sum() / ITEMS**2)
        failed = [test for test in diagnose(steps).tests if not test.passed]
        if [test.name for test in failed] == ["session products"] and failed[0].mean < 1:
            said = str(conclude(steps, seed=0))
            assert "too rare in these logs: give more logs" in said
            assert "filter-seen" not in said
            return
    pytest.fail("no sample has sessions of the policy too rare")


def test_weights_are_tested_by_segment() -> None:
    """Too large in one half, too small in the other: right on average, wrong in each."""
    steps, _ = logs(8000)
    half = np.arange(8000) % 2
    wrong = np.clip(steps.propensity * np.where(half == 0, 1.25, 1 / 1.2), 0, 1)
    twisted = replace(steps, propensity=wrong)
    assert all(test.passed for test in diagnose(twisted).tests)
    failed = [test for test in diagnose(twisted, segment=half).tests if not test.passed]
    assert [test.name for test in failed] == ["segment 0", "segment 1"]
    assert failed[0].mean < 1 < failed[1].mean
    assert not conclude(twisted, seed=0, diagnosis=diagnose(twisted, segment=half)).reliable


def test_no_rewarded_weight_is_refused() -> None:
    """The policy repeats one item that never had a reward: not "0 [0, 0]"."""
    steps, items = logs(5000)
    steps = replace(
        steps, reward=steps.reward * (items != 3), target=(items == 3).astype(np.float64)
    )
    verdict = conclude(steps, seed=0)
    assert not verdict.reliable
    assert "no session has both weight and reward" in str(verdict)
    assert estimate(steps, seed=0)["IPS"].low is None


def test_one_missing_propensity_leaves_the_verdict_standing_and_many_do_not() -> None:
    steps, _ = logs(20_000)
    one, many = steps.propensity.copy(), steps.propensity.copy()
    one[17], many[::10] = np.nan, np.nan
    few = replace(steps, propensity=one)
    verdict, diagnosis = conclude(few, seed=0), diagnose(few)
    assert verdict.reliable
    assert "1 of 20,000 sessions have a step without propensity" in list_cautions(diagnosis, {})[0]
    assert "10% of the sessions" in conclude(replace(steps, propensity=many), seed=0).reasons[0]
    nothing = conclude(replace(steps, propensity=np.full(20_000, np.nan)), seed=0)
    assert nothing.reasons == ("no session has all its propensities, so nothing can be weighed",)
    assert nothing.lift is None


def test_sessions_of_one_user_count_together() -> None:
    """Two hundred users of 20 sessions, each repeating what it did in the first."""
    steps, _ = logs(200)
    again = np.repeat(np.arange(200), 20)
    repeated = LoggedSteps(
        session=np.arange(4000),
        reward=steps.reward[again],
        propensity=steps.propensity[again],
        target=steps.target[again],
        user=again,
    )
    once, repeated_once = estimate(steps, 0)["IPS"], estimate(repeated, 0)
    assert repeated_once["IPS"].error == pytest.approx(once.error)
    apart = estimate(replace(repeated, user=None), 0)["IPS"].error
    assert apart == pytest.approx(repeated_once["IPS"].error / 20**0.5, rel=0.01)
    assert diagnose(repeated).effective_users == pytest.approx(diagnose(steps).effective_users)


def test_users_are_never_judged_by_models_that_saw_them() -> None:
    rng = np.random.default_rng(0)
    user, session = np.repeat(np.arange(20), 5), np.arange(100)
    features = np.column_stack([np.ones(100), rng.normal(size=(100, 3))]).astype(np.float32)
    reward = rng.normal(size=100)
    before = fitted(features, features, reward, session, 3, user)
    mine = user == 7
    after = fitted(features, features, np.where(mine, 50.0, reward), session, 3, user)
    np.testing.assert_array_equal(after.q[mine], before.q[mine])
    assert not np.allclose(after.q[~mine], before.q[~mine])


def test_the_step_at_which_the_logs_stop_telling() -> None:
    steps, _ = logs(2000, length=20)
    diagnosis = diagnose(steps)
    stops = diagnosis.unsupported_from_step
    assert stops is not None
    assert 4 < stops < 20
    assert all(n >= 200 for n in diagnosis.effective_by_step[: stops - 1])
    assert diagnosis.effective_by_step[stops - 1] < 200
    for place in (0, 5, 19):
        weights = steps.weights[steps.step == place]
        expected = weights.sum() ** 2 / (weights**2).sum()
        assert diagnosis.effective_by_step[place] == pytest.approx(expected)
    assert any("from step" in line for line in list_cautions(diagnosis, {}))


@pytest.mark.parametrize(("sigma", "heavy"), [(0.5, False), (3.0, True)])
def test_heavy_tails_are_noticed(sigma: float, heavy: bool) -> None:
    rng = np.random.default_rng(0)
    weights = rng.lognormal(-(sigma**2) / 2, sigma, 5000)
    steps = LoggedSteps(
        session=np.arange(5000),
        reward=rng.random(5000),
        propensity=np.minimum(1, 1e-6 / weights),
        target=np.full(5000, 1e-6),
    )
    tail = diagnose(steps).tail
    assert tail is not None
    assert (tail > 0.5) is heavy
    assert any("heavy a tail" in line for line in conclude(steps, seed=0).reasons) is heavy
