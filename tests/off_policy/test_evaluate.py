"""Options of an estimate, and logs that no estimate can be of."""

from pathlib import Path

import pandas as pd
import pytest

from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.off_policy.evaluate import EstimateOptions


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
    assert len([line for line in said if "of one user; at least two users are needed" in line]) == 1
    assert f"{tmp_path / 'one.parquet'}: the logs have " in said[-1]
