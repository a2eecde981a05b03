"""Candidates are ranked on the same sessions, and only where their verdicts stand."""

from dataclasses import replace

import numpy as np
import pytest

from tests.off_policy.test_verdict import ITEMS, PAYS, logs
from ucfrec.errors import InputError
from ucfrec.off_policy import LoggedSteps, judge
from ucfrec.off_policy.candidates import choose, names_of
from ucfrec.off_policy.estimators import session_terms
from ucfrec.off_policy.evaluate import OffPolicyReport
from ucfrec.off_policy.fqe import ModelReport
from ucfrec.off_policy.verdict import influences


def report(steps: LoggedSteps) -> OffPolicyReport:
    verdict = judge(steps, seed=0)
    terms = influences(session_terms(steps)["SNPDIS"])
    models = ModelReport(reward_r2=0, td_loss=0, td_bias=0, iterations=1, settled=True)
    return OffPolicyReport([], [], verdict, models, steps.returns, None, terms)


def judged(shares: np.ndarray, steps: LoggedSteps, items: np.ndarray) -> OffPolicyReport:
    return report(replace(steps, target=(shares / shares.sum())[items]))


def test_only_candidates_whose_verdicts_stand_are_ranked() -> None:
    steps, items = logs(6000)
    reports = {
        "later": judged(np.arange(1.0, ITEMS + 1), steps, items),
        "uniform": judged(1 + np.arange(ITEMS) % 2 * 0.2, steps, items),
        "propensities wrong": report(
            replace(steps, propensity=steps.propensity / 2, target=steps.target)
        ),
    }
    choice = choose(reports, seed=0)
    assert choice.selection is not None
    assert [one.name for one in choice.selection.standings] == ["later", "uniform"]
    assert "propensities are too small" in choice.excluded["propensities wrong"]
    truth = np.arange(1.0, ITEMS + 1) @ PAYS / np.arange(1.0, ITEMS + 1).sum()
    assert choice.columns("later")["band_low"] < truth < choice.columns("later")["band_high"]
    assert choice.columns("later")["corrected"] <= choice.selection.chosen.value
    assert "regret" not in choice.columns("uniform")
    assert set(choice.columns("propensities wrong")) == {"selection"}


def test_no_candidate_may_stand() -> None:
    steps, _ = logs(100)
    choice = choose({"a": report(steps), "b": report(steps)}, seed=0)
    assert choice.selection is None
    assert choice.headline == "The logs allow no conclusion on any of the candidates"
    assert set(choice.excluded) == {"a", "b"}


def test_runs_that_read_the_logs_in_different_ways_are_refused() -> None:
    steps, _ = logs(400)
    other = replace(steps, reward=1 - steps.reward)
    with pytest.raises(InputError, match="a and b read these logs as different"):
        choose({"a": report(steps), "b": report(other)}, seed=0)


def test_names_say_what_differs() -> None:
    candidates = [{"run": "x", "target return": t, "rule": r} for t in (1.0, 2.5) for r in "ab"]
    assert names_of(candidates)[3] == "target return 2.5, b"
    assert names_of(candidates[:1]) == ["x"]
    assert names_of([{"run": "x", "rule": "a"}, {"run": "y", "rule": "a"}]) == ["x", "y"]
    close = [{"run": "x", "target return": t} for t in (1000001.0, 1000002.0, None)]
    assert names_of(close) == [
        "target return 1000001",
        "target return 1000002",
        "largest target return expected",
    ]
    closest = [{"target return": t} for t in (0.1 + 0.2, 0.3)]
    assert len(set(names_of(closest))) == 2
