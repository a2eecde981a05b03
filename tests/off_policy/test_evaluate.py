"""Options of an estimate, and logs that no estimate can be of."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec.acting.decision import DecisionRule
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.logs import LogMapping
from ucfrec.off_policy.evaluate import EstimateOptions, evaluate_off_policy
from ucfrec.off_policy.score import logged_sessions
from ucfrec.runs.trained_policy import TrainedPolicy

RULE = DecisionRule(7.5, temperature=1.0)


def test_values_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match=r"discount is 1\.1; it must be a number above 0"):
        EstimateOptions(discount=1.1)
    with pytest.raises(InputError, match="name the least one first"):
        EstimateOptions(reward_range=(2.0, 1.0))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_logs_of_one_user_are_refused_before_anything_is_fitted(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = pd.read_parquet(folder / "rest.parquet")
    log[log.user_id == log.user_id.iloc[0]].to_parquet(tmp_path / "one.parquet")
    assert main(["ope", str(folder / "run"), str(tmp_path / "one.parquet")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len([line for line in said if "of one user; each user is predicted" in line]) == 1
    assert f"{tmp_path / 'one.parquet'}: the logs have " in said[-1]


@pytest.mark.parametrize(("share", "forbids"), [(0.0, False), (0.02, False), (0.2, True)])
def test_rows_without_reward_are_said_and_many_forbid_a_verdict(
    folder: Path, trained: TrainedPolicy, tmp_path: Path, share: float, forbids: bool
) -> None:
    log = pd.read_parquet(folder / "rest.parquet")
    lacking = int(share * len(log))
    log.loc[log.index[:lacking], "reward"] = np.nan
    log.to_parquet(tmp_path / "log.parquet")
    with logged_sessions(trained, [tmp_path / "log.parquet"], LogMapping(), True) as logged:
        report = evaluate_off_policy(trained, logged, rule=RULE, seed=0)
    text = f"{lacking:,} of {len(log):,} rows have no finite reward"
    assert any(text in warning for warning in report.warnings) == (lacking > 0)
    assert any(text in reason for reason in report.verdict.reasons) == forbids


def test_an_item_twice_on_a_page_is_said(
    folder: Path, trained: TrainedPolicy, tmp_path: Path
) -> None:
    log = pd.read_parquet(folder / "rest.parquet").drop_duplicates("user_id")
    pd.concat([log, log.iloc[:3]]).to_parquet(tmp_path / "log.parquet")
    pages = EstimateOptions(pages=True)
    with logged_sessions(trained, [tmp_path / "log.parquet"], LogMapping(), True) as logged:
        report = evaluate_off_policy(trained, logged, rule=RULE, seed=0, options=pages)
    assert any("3 rows repeat the user, item and time" in each for each in report.warnings)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--reward-range", "0.2", "0.1"], "the reward range is 0.2 to 0.1; name the least one"),
        (["--discount", "2"], "discount is 2.0; it must be"),
        (["--lift", "0"], "wanted_lift is 0.0; it must be"),
    ],
)
def test_options_are_checked_before_logs_are_opened(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str], says: str
) -> None:
    (tmp_path / "broken.parquet").write_bytes(b"no Parquet")
    assert main(["ope", str(folder / "run"), str(tmp_path / "broken.parquet"), *option]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"ucfrec ope: {says}")
