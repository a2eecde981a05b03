"""The value per step from a randomised slice of the steps, against its known truth."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.served import trained_run
from tests.support.tagged import tagged_log
from ucfrec.commands.cli import main
from ucfrec.off_policy.logged_steps import LoggedSteps, Modelled
from ucfrec.off_policy.per_step import StepValue, step_value

ITEMS = 6
PAYS = np.linspace(0, 1, ITEMS)
TARGET = np.array([0.05, 0.05, 0.1, 0.2, 0.2, 0.4])
TRUTH = float(TARGET @ PAYS)


def logs(seed: int, share: float = 0.2, sessions: int = 300, wrong: float = 1.0) -> LoggedSteps:
    """Sessions of six steps of three users each; a share of the steps shows a random item, with its
    propensity, and the others favour bad items, with none."""
    rng, n = np.random.default_rng(seed), 6 * sessions
    user = np.arange(sessions) // 3
    random = rng.random(n) < share
    usual = rng.choice(ITEMS, n, p=TARGET[::-1])
    item = np.where(random, rng.integers(ITEMS, size=n), usual)
    # Steps of a user are alike.
    liking = rng.normal(0, 0.3, user.max() + 1)[user][np.repeat(np.arange(sessions), 6)]
    return LoggedSteps(
        session=np.repeat(np.arange(sessions), 6),
        reward=PAYS[item] + liking + rng.normal(0, 0.3, n),
        propensity=np.where(random, wrong / ITEMS, np.nan),
        target=TARGET[item],
        # A model that is wrong by a constant.
        model=Modelled(np.full(n, TRUTH + 0.2), np.zeros(n), np.zeros(n), PAYS[item] + 0.2),
        user=user,
    )


def value_of(steps: LoggedSteps) -> StepValue:
    found = step_value(steps, 0)
    assert found is not None
    return found


def test_intervals_cover_the_value_of_the_policy_per_step() -> None:
    covered = dict.fromkeys(("IPS", "SNIPS", "DR"), 0)
    values = []
    for seed in range(40):
        found = value_of(logs(seed)).estimates
        values.append([found[name].value for name in covered])
        for name in covered:
            low, high = found[name].low, found[name].high
            assert low is not None
            assert high is not None
            covered[name] += low <= TRUTH <= high
    assert min(covered.values()) >= 34
    np.testing.assert_allclose(np.mean(values, axis=0), TRUTH, atol=0.03)


def test_the_lift_is_over_the_same_steps_as_logged() -> None:
    steps = logs(1)
    found = value_of(steps)
    known = ~np.isnan(steps.propensity)
    assert (found.steps, found.of) == (known.sum(), len(known))
    logged = found.estimates["logged"].value
    assert logged == pytest.approx(steps.reward[known].mean())
    assert found.lift.value == pytest.approx(found.estimates["DR"].value - logged)
    assert found.lift.low is not None
    assert found.lift.low > 0
    assert "no estimate of a session's return" in str(found)
    assert found.doubt is None


def test_wrong_propensities_are_doubted() -> None:
    doubt = value_of(logs(2, wrong=0.5)).doubt
    assert doubt is not None
    assert "where 1 is expected" in doubt


def test_there_is_none_where_all_steps_or_none_have_propensities() -> None:
    assert step_value(logs(3, share=1.0), 0) is None
    assert step_value(logs(3, share=0.0), 0) is None
    assert step_value(replace(logs(3), model=None), 0) is None
    never = logs(3)
    assert step_value(replace(never, target=np.zeros_like(never.target)), 0) is None


def test_ope_estimates_per_step_from_a_randomised_slice_and_refuses_sessions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = trained_run(tmp_path, "dt")
    log, rng = tagged_log(), np.random.default_rng(0)
    log["propensity"] = np.where(rng.random(len(log)) < 0.3, 1 / 24, np.nan)
    log.to_parquet(tmp_path / "log.parquet")
    files = [str(tmp_path / "log.parquet"), "--json", str(tmp_path / "ope.json")]
    assert main(["ope", str(trained.folder), *files, "--temperature", "1"]) == 0
    printed = capsys.readouterr().out
    assert "R_step" in printed
    assert "steps with a propensity" in printed
    assert "verdict: Do not rely on this estimate" in printed
    rows = json.loads((tmp_path / "ope.json").read_text())
    by_step = [row for row in rows if row["table"] == "per step"]
    assert [row["method"] for row in by_step] == ["logged", "IPS", "SNIPS", "DR"]
    assert all(row["metric"] == "R_step" and row["interval"] for row in by_step)
