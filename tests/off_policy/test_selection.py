"""Choosing where the truth is known: bands, probabilities, luck, rank correlation and regret."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import spearmanr

from tests.off_policy import test_verdict
from tests.off_policy.test_verdict import logs
from ucfrec.arrays import Float64Array
from ucfrec.errors import InputError
from ucfrec.off_policy import LoggedSteps, conclude
from ucfrec.off_policy.estimators import session_terms
from ucfrec.off_policy.evaluate import OffPolicyReport
from ucfrec.off_policy.models import ModelReport
from ucfrec.off_policy.selection import Selection, choose, names_of, select

ITEMS = 8
PAYS = np.linspace(0.1, 0.5, ITEMS)
LIKING = {"worst": -0.3, "plain": 0.0, "better": 0.15, "best": 0.45}
"""How strongly each of four policies prefers items that pay more."""


def policy(liking: float) -> Float64Array:
    weights = np.exp(liking * np.arange(ITEMS))
    return np.asarray(weights / weights.sum())


def evaluated(seed: int, sessions: int = 2000) -> Selection:
    """The four policies by logs of a uniform one."""
    rng = np.random.default_rng(seed)
    items = rng.integers(ITEMS, size=sessions)
    reward = (rng.random(sessions) < PAYS[items]).astype(np.float64)
    columns = []
    for liking in LIKING.values():
        steps = LoggedSteps(
            np.arange(sessions), reward, np.full(sessions, 1 / ITEMS), policy(liking)[items]
        )
        columns.append(session_terms(steps)["SNPDIS"].influences)
    return select(list(LIKING), np.stack(columns, axis=1), seed, np.arange(sessions) // 2)


def test_the_best_of_four_policies_is_chosen() -> None:
    """In 20 replications: how often, the rank correlation with the truth, and the regret."""
    truth = {name: float(policy(liking) @ PAYS) for name, liking in LIKING.items()}
    chosen, correlations, regrets, held, within = 0, [], [], 0, 0
    for seed in range(20):
        found = evaluated(seed)
        chosen += found.standings[0].name == "best"
        named = {one.name: one for one in found.standings}
        ranks = [named[name].rank for name in truth]
        correlations.append(spearmanr(ranks, [-value for value in truth.values()]).statistic)
        regrets.append(truth["best"] - truth[found.standings[0].name])
        held += all(named[name].low <= truth[name] <= named[name].high for name in truth)
        within += regrets[-1] <= found.regret + 1e-12
        assert sum(one.probability_best for one in found.standings) == pytest.approx(1)
    assert chosen >= 17
    assert np.mean(correlations) > 0.9
    assert np.mean(regrets) < 0.015
    # Of 20, 19 are expected.
    assert held >= 16
    assert within >= 17


def equal(seed: int, candidates: int, sessions: int = 400) -> Float64Array:
    return np.asarray(np.random.default_rng(seed).exponential(size=(sessions, candidates)))


def test_the_luck_of_the_chosen_is_taken_off() -> None:
    """Twenty candidates worth 1 each: the first looks like 1.09."""
    naive, corrected, held = [], [], 0
    for seed in range(30):
        found = select([str(k) for k in range(20)], equal(seed, 20), seed)
        naive.append(found.standings[0].value)
        corrected.append(found.corrected)
        held += all(one.low <= 1 <= one.high for one in found.standings)
        assert found.regret > 0
    assert np.mean(naive) > 1.08
    assert abs(np.mean(corrected) - 1) < 0.5 * (np.mean(naive) - 1)
    assert held >= 25  # of 30, 28 are expected; one interval at a time holds all in 11


def test_one_clear_winner_loses_nothing() -> None:
    terms = equal(0, 4)
    terms[:, 2] += 2
    found = select(list("abcd"), terms, 0)
    assert found.standings[0].name == "c"
    assert found.standings[0].probability_best == 1
    assert found.regret == 0
    assert found.corrected == pytest.approx(found.standings[0].value, abs=0.01)
    assert found.headline.startswith("No other candidate has a higher value than c: ")
    assert [one.rank for one in found.standings] == [1, 2, 3, 4]


def test_the_band_of_one_is_an_interval_and_of_many_is_wider() -> None:
    terms = np.random.default_rng(0).normal(size=(2000, 30))
    one, many = select(["0"], terms[:, :1], 0), select([str(k) for k in range(30)], terms, 0)
    width = (one.standings[0].high - one.standings[0].low) / one.standings[0].error / 2
    assert width == pytest.approx(1.96, abs=0.1)
    assert one.regret == 0
    assert one.headline == "0 is the only candidate"
    wide = (many.standings[0].high - many.standings[0].low) / many.standings[0].error / 2
    assert wide == pytest.approx(3.13, abs=0.15)  # the 95% quantile of 30 normal deviations


def report(steps: LoggedSteps) -> OffPolicyReport:
    verdict = conclude(steps, seed=0)
    terms = session_terms(steps)["SNPDIS"].influences
    models = ModelReport(reward_r2=0, td_loss=0, td_bias=0, iterations=1, converged=True)
    return OffPolicyReport([], [], verdict, models, steps.returns, None, terms)


def test_only_candidates_whose_verdicts_stand_are_ranked() -> None:
    steps, items = logs(6000)
    uniform = 1 + np.arange(test_verdict.ITEMS) % 2 * 0.2
    reports = {
        "later": report(replace(steps, target=test_verdict.TARGET[items])),
        "uniform": report(replace(steps, target=(uniform / uniform.sum())[items])),
        "propensities wrong": report(replace(steps, propensity=steps.propensity / 2)),
    }
    choice = choose(reports, seed=0)
    assert [one.name for one in choice.standings] == ["later", "uniform"]
    assert choice.headline.startswith("No other candidate that these logs can evaluate has")
    assert "propensities are too small" in choice.excluded["propensities wrong"]
    later = choice.columns("later")
    assert later["band_low"] < test_verdict.value() < later["band_high"]
    assert later["corrected"] <= choice.standings[0].value
    assert "regret" not in choice.columns("uniform")
    assert set(choice.columns("propensities wrong")) == {"selection"}
    few = report(logs(100)[0])
    choice = choose({"a": few, "b": few}, seed=0)
    assert choice.standings == ()
    assert choice.headline == "The logs allow no conclusion on any of the candidates"
    assert set(choice.excluded) == {"a", "b"}


def test_candidates_that_cannot_be_compared_are_refused() -> None:
    steps, _ = logs(400)
    other = replace(steps, reward=1 - steps.reward)
    with pytest.raises(InputError, match="a and b read these logs as different"):
        choose({"a": report(steps), "b": report(other)}, seed=0)
    bad = {r"\(5, 2\)": np.ones((5, 2)), "not finite at 5": np.full((5, 1), np.nan)}
    for says, terms in bad.items():
        with pytest.raises(InputError, match=says):
            select(["a"], terms, 0)
    with pytest.raises(InputError, match="give a column to each of 0"):
        select([], np.ones((5, 0)), 0)


def test_names_say_what_differs() -> None:
    candidates = [{"run": "x", "target return": t, "rule": r} for t in (1.0, 2.5) for r in "ab"]
    assert names_of(candidates)[3] == "target return 2.5, b"
    assert names_of(candidates[:1]) == ["x"]
    assert names_of([{"run": "x", "rule": "a"}, {"run": "y", "rule": "a"}]) == ["x", "y"]
