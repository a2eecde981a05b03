"""Options of an estimate, and logs that no estimate can be of."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.off_policy.conftest import Read
from ucfrec.acting.decision import DecisionRule
from ucfrec.commands.cli import main
from ucfrec.off_policy.answer import conclude, cut_to_steps
from ucfrec.off_policy.estimators import estimate
from ucfrec.off_policy.evaluate import evaluate_off_policy
from ucfrec.off_policy.logged_steps import LoggedSteps, Modelled
from ucfrec.runs.trained_policy import TrainedPolicy

RULE = DecisionRule(7.5, temperature=1.0)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_logs_of_one_user_are_refused_before_anything_is_fitted(
    folder: Path, log: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log[log.user_id == log.user_id.iloc[0]].to_parquet(tmp_path / "one.parquet")
    assert main(["ope", str(folder / "run"), str(tmp_path / "one.parquet")]) == 2
    said = capsys.readouterr().err
    assert said.count("one.parquet: the logs are of one user; each user is predicted") == 1


@pytest.mark.parametrize(("share", "forbids"), [(0.0, False), (0.02, False), (0.2, True)])
def test_rows_without_reward_are_said_and_many_forbid_a_verdict(
    log: pd.DataFrame, trained: TrainedPolicy, read: Read, share: float, forbids: bool
) -> None:
    lacking = int(share * len(log))
    log.loc[log.index[:lacking], "reward"] = np.nan
    with read(log, keep=True) as logged:
        report = evaluate_off_policy(trained, logged, rule=RULE, seed=0)
    text = f"{lacking:,} of {len(log):,} rows have no finite reward"
    assert any(text in warning for warning in report.warnings) == (lacking > 0)
    assert any(text in reason for reason in report.verdict.reasons) == forbids


def test_steps_with_a_propensity_are_estimated_where_sessions_cannot_be(
    folder: Path, log: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(0).random(len(log)) < 0.3
    log.assign(propensity=np.where(random, 1 / 30, np.nan)).to_parquet(tmp_path / "log.parquet")
    files = [str(tmp_path / "log.parquet"), "--json", str(tmp_path / "ope.json")]
    assert main(["ope", str(folder / "run"), *files, "--temperature", "1", "--details"]) == 0
    printed = capsys.readouterr().out
    assert "R_step: mean reward of a step" in printed
    assert printed.startswith("the log cannot say: ")
    rows = json.loads((tmp_path / "ope.json").read_text())
    by_step = [row for row in rows if row["table"] == "per step"]
    assert {"logged", "IPS", "SNIPS", "DR"} < {row["method"] for row in by_step}
    assert all(row["metric"] == "R_step" for row in by_step)


def test_options_are_checked_before_logs_are_opened(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.parquet").write_bytes(b"no Parquet")
    given = ["ope", str(folder / "run"), str(tmp_path / "broken.parquet"), "--discount", "2"]
    assert main(given) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("ucfrec ope: discount is 2.0; it must be")


ITEMS = 6
PAYS = np.linspace(0, 1, ITEMS)
TARGET = np.array([0.05, 0.05, 0.1, 0.2, 0.2, 0.4])
TRUTH = float(TARGET @ PAYS)


def random_logs(
    seed: int, share: float = 0.2, sessions: int = 300, wrong: float = 1.0
) -> LoggedSteps:
    """Sessions of six steps of three users each; a fifth of the steps shows a random item, with its
    propensity, and the others favour bad items, with none."""
    rng, n = np.random.default_rng(seed), 6 * sessions
    user = np.arange(sessions) // 3
    random = rng.random(n) < 0.2
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


def test_intervals_cover_the_value_of_the_policy_per_step() -> None:
    covered = dict.fromkeys(("IPS", "SNIPS", "DR"), 0)
    values = []
    for seed in range(25):
        found = estimate(cut_to_steps(random_logs(seed)), 0)
        values.append([found[name].value for name in covered])
        for name in covered:
            covered[name] += found[name].low <= TRUTH <= found[name].high
    assert min(covered.values()) >= 21
    np.testing.assert_allclose(np.mean(values, axis=0), TRUTH, atol=0.03)


def test_the_lift_is_over_the_same_steps_as_logged() -> None:
    steps = random_logs(1)
    known = ~np.isnan(steps.propensity)
    found = conclude(cut_to_steps(steps), 0)
    assert found.estimator == "REG"
    assert found.logged == pytest.approx(steps.reward[known].mean())
    wrong = conclude(cut_to_steps(random_logs(2, wrong=0.5)), 0)
    assert any("where 1 is expected" in reason for reason in wrong.reasons)
