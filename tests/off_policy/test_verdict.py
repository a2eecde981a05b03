"""Misleading logs end in the right number or the right refusal, and good logs in a verdict."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from tests.support.logged_steps import random_steps
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.off_policy import LoggedSteps, conclude, estimate
from ucfrec.off_policy.logged_steps import ItemGroups
from ucfrec.off_policy.verdict import check_catalogue_size, describe_rounding, diagnose, pareto_tail

ITEMS = 10
PAYS = np.linspace(0.1, 0.5, ITEMS)
"""Probability of a reward, by item."""
TARGET = np.arange(1.0, ITEMS + 1) / np.arange(1.0, ITEMS + 1).sum()


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


def value(length: int = 1) -> float:
    return length * float(TARGET @ PAYS)


def test_propensities_of_few_decimals_are_noticed() -> None:
    text = describe_rounding(np.append(np.arange(1, 13) / 100, np.nan))
    assert "have 2 decimals: if they were rounded, weights are wrong by up to 50%;" in text
    for exact in (np.arange(1, 40) / 780, np.array([0.91, 0.01, 0.01]), 1 / np.arange(1, 40)):
        assert describe_rounding(exact) == ""


def test_good_logs_stand_and_say_what_the_policy_gains() -> None:
    steps, _ = logs(5000)
    verdict = conclude(steps, seed=0)
    lift = value() - PAYS.mean()
    assert verdict.lift.is_reliable, verdict.reasons
    assert verdict.estimator == "SNPDIS"
    assert 0 < verdict.lift.low < lift < verdict.lift.high
    assert (verdict.answer, verdict.test.days) == ("launch", None)
    assert str(verdict).startswith("launch: +0.0")
    rounded = steps.propensity.astype(np.float32)
    same = conclude(replace(steps, propensity=rounded, target=steps.propensity), seed=0)
    assert same.headline.startswith("do not launch: +0 [+0, +0] per session")
    # One missing propensity leaves the verdict standing.
    steps, _ = logs(20_000)
    few = replace(steps, propensity=np.where(np.arange(20_000) == 17, np.nan, steps.propensity))
    assert conclude(few, seed=0).lift.is_reliable
    assert diagnose(few).left_out == 1


def test_unknown_items_weigh_nothing() -> None:
    """The policy lacks half the logged items. Without these rows, the mean is twice too much."""
    steps, items = logs(5000)
    known = np.arange(ITEMS) < 5
    target = np.where(known, 0.2, 0.0)
    truth = float(target @ PAYS)
    evaluated = replace(steps, target=target[items])
    one = estimate(evaluated, seed=0)["IPS"]
    assert one.low < truth < one.high
    dropped = estimate(evaluated.select(known[items]), seed=0)["IPS"]
    assert dropped.low > 1.5 * truth
    assert conclude(evaluated, seed=0).lift.is_reliable


STEPS, SHOWN = logs(5000)
WRONG = {
    "halved": {"propensity": STEPS.propensity / 2},
    "one": {"propensity": np.ones(5000)},
    "some lacking": {"propensity": np.where(np.arange(5000) % 10, STEPS.propensity, np.nan)},
    "all lacking": {"propensity": np.full(5000, np.nan)},
    "one buyer": {"reward": STEPS.reward + 500.0 * (np.arange(5000) == 7)},
    # The policy repeats one item that never had a reward: not "0 [0, 0]".
    "nothing rewarded": {"reward": STEPS.reward * (SHOWN != 3), "target": 1.0 * (SHOWN == 3)},
}


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("halved", "mean weight (2|1.99|2.01) ± .*: propensities are too small"),
        ("one", "mean weight 0.(1|09).* ± .*: the logs lack .*, or propensities are too large"),
        ("some lacking", "10% of the sessions"),
        (
            "all lacking",
            "cannot say: no session has all its propensities, so nothing can be weighed",
        ),
        ("one buyer", "one user has [2-5].% of all weighted reward: cap"),
        ("nothing rewarded", "no session has both weight and reward"),
    ],
)
def test_misleading_logs_are_refused(name: str, says: str) -> None:
    steps = replace(STEPS, **WRONG[name])
    verdict = conclude(steps, seed=0)
    assert verdict.answer == "the log cannot say"
    assert re.search(says, str(verdict))
    assert (verdict.lift.value is None) is (name == "all lacking")
    if name == "nothing rewarded":
        found = estimate(steps, seed=0)
        for each in ("IPS", "SNIPS", "PDIS", "SNPDIS"):
            assert (found[each].value, found[each].low, found[each].high) == (0, None, None)


def test_unsupported_choices_over_ten_steps_are_refused() -> None:
    """The behavior never shows the last item, 15% of the policy's choices at every step."""
    behavior = np.append(np.full(ITEMS - 1, 1 / (ITEMS - 1)), 0.0)
    steps, items = logs(5000, length=10, behavior=behavior)
    target = np.append(np.full(ITEMS - 1, 0.85 / (ITEMS - 1)), 0.15)
    steps = replace(steps, target=target[items])
    truth = 10 * float(target @ PAYS)
    assert estimate(steps, seed=0)["PDIS"].value < 0.6 * truth
    diagnosis = diagnose(steps)
    failed = {test.name for test in diagnosis.tests if not test.passed}
    assert failed >= {"step 1", "step 10", "session products"}
    verdict = conclude(steps, seed=0, diagnosis=diagnosis)
    assert not verdict.lift.is_reliable
    assert "the logs lack choices that the policy makes" in str(verdict)
    assert "(log excludes_seen and candidates)" in str(verdict)


def test_skewed_weights_pass_with_true_propensities_and_fail_with_wrong_ones() -> None:
    """Tests that take a mean of 3,000 products of up to 60 ratios for normal fail in 14 logs."""
    failures = {1.0: 0, 0.95: 0, 1.05: 0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        lengths = np.minimum(rng.geometric(0.1, 3000), 60)
        logits = rng.normal(size=50)
        behavior, target = softmax([logits, logits + 0.6 * rng.normal(size=50)], axis=1)
        items = rng.choice(50, p=behavior, size=lengths.sum())
        session, segment = np.repeat(np.arange(3000), lengths), rng.integers(4, size=3000)
        for factor in failures:
            steps = LoggedSteps(session, 1.0 * items, behavior[items] * factor, target[items])
            failures[factor] += not all(test.passed for test in diagnose(steps, segment).tests)
    assert failures[1.0] <= 6
    assert min(failures[0.95], failures[1.05]) >= 38


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
    assert not conclude(twisted, seed=0, diagnosis=diagnose(twisted, segment=half)).lift.is_reliable


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
    assert (tail > 0.5) is heavy
    assert any("heavy a tail" in line for line in conclude(steps, seed=0).reasons) is heavy


def test_the_tail_of_a_pareto_sample_has_its_shape() -> None:
    rng = np.random.default_rng(1)
    for shape in (0.2, 0.5, 0.9):
        found = [pareto_tail(rng.pareto(1 / shape, 20_000) + 1) for _ in range(20)]
        assert np.mean([one for one in found if one is not None]) == pytest.approx(shape, abs=0.05)
    assert pareto_tail(np.tile([0.0, 1.0, 3.0], 1000) + 1e-6 * rng.random(3000)) is None
    assert pareto_tail(np.ones(5)) is None


@pytest.mark.parametrize(("factor", "items"), [(1.0, 20), (0.5, 40), (2.0, 10)])
def test_propensities_imply_how_many_items_there_are(factor: float, items: float) -> None:
    """Whatever the shares of the 20 items are; fewer may be candidates, more cannot."""
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.full(20, 5.0))
    item = rng.choice(20, p=shares, size=20_000)
    steps = replace(random_steps([1] * 20_000), propensity=np.minimum(shares[item] * factor, 1))
    found = check_catalogue_size(steps, np.ones(20_000, dtype=bool), 20)
    assert found.mean * 20 == pytest.approx(items, rel=0.05)
    assert found.passed is (factor >= 1)
    half = check_catalogue_size(steps, item < 10, 10)
    assert half.mean == pytest.approx(items / 20, rel=0.05)
    # Few users, and no propensities, imply nothing.
    listed = np.ones(20_000, dtype=bool)
    for change in ({"user": np.arange(20_000) % 20}, {"propensity": np.full(20_000, np.nan)}):
        assert check_catalogue_size(replace(steps, **change), listed, 5) is None


def grouped(behavior: np.ndarray, target: np.ndarray, sessions: int = 8000) -> LoggedSteps:
    """Steps of four items in two groups."""
    items = np.random.default_rng(0).choice(4, p=behavior, size=sessions)
    group_of = np.array([0, 0, 1, 1])
    shares = np.array([target[:2].sum(), target[2:].sum()], dtype=np.float32)
    return LoggedSteps(
        np.arange(sessions),
        (np.random.default_rng(1).random(sessions) < 0.3).astype(np.float64),
        behavior[items],
        target[items],
        groups=ItemGroups(group_of[items], np.tile(shares, (sessions, 1))),
    )


def test_wrong_propensities_of_one_group_are_found() -> None:
    """Too large for one, too small for the other: right on average."""
    target = np.array([0.2, 0.3, 0.3, 0.2])
    steps = grouped(np.full(4, 0.25), target)
    tests = {test.name: test for test in diagnose(steps).tests}
    assert tests["item group 0"].passed
    assert tests["item group 1"].passed
    factor = np.where(steps.groups.number == 0, 1.25, 1 / 1.2)
    wrong = replace(steps, propensity=steps.propensity * factor)
    failed = {test.name: test.mean for test in diagnose(wrong).tests if not test.passed}
    assert set(failed) == {"item group 0", "item group 1"}
    assert failed["item group 0"] == pytest.approx(0.8, abs=0.05)
    assert failed["item group 1"] == pytest.approx(1.2, abs=0.05)
    assert "item group" in str(conclude(wrong, seed=0))
    # A group that the logs lack is named.
    behavior, target = np.array([0.5, 0.49, 0.01, 0.0]), np.array([0.4, 0.4, 0.01, 0.19])
    tests = diagnose(grouped(behavior, target)).tests
    assert {"item group 1", "step 1"} <= {test.name for test in tests if not test.passed}
