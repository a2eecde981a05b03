"""Measures and groups are those of the rows that are evaluated."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.off_policy.score import read_logged_sessions
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture
def file(log: pd.DataFrame, tmp_path: Path) -> Path:
    log = log.assign(
        dwell=np.arange(len(log)) + 0.5,
        country=np.where(log.user_id % 3 == 0, "NL", "DE"),
        kind=np.where(log.item_id < 10, "film", "series"),
        device=np.where(np.arange(len(log)) % 2, "phone", None),
    )
    log.sample(frac=1, random_state=0).to_parquet(tmp_path / "log.parquet")
    return tmp_path / "log.parquet"


@pytest.mark.parametrize(("suffix", "by"), [("parquet", "country"), ("csv", "kind")])
def test_columns_are_of_the_rows(
    trained: TrainedPolicy, file: Path, log: pd.DataFrame, suffix: str, by: str
) -> None:
    frame = pd.read_parquet(file)
    if suffix == "csv":
        frame.to_csv(file := file.with_suffix(".csv"), index=False)
    files, mapping = [file], LogMapping()
    read = read_logged_sessions(trained, files, mapping, True, measures=["2 * dwell"], by=by)
    with read as logged:
        users = logged.users[logged.store.all_steps()[0]]
        times = logged.store.column("timestamp")
        groups = logged.groups
    rows = frame.set_index(["user_id", "timestamp"]).loc[list(zip(users, times, strict=True))]
    np.testing.assert_array_equal(logged.measures["2 * dwell"], 2 * rows.dwell)
    np.testing.assert_array_equal(np.array(groups.names)[groups.number], rows[by])
    assert groups.of_items == (by == "kind")


def test_groups_are_read_from_feature_tables(trained: TrainedPolicy, file: Path) -> None:
    table = pd.DataFrame({"sku": range(30), "brand": ["a", "b", "c"] * 10})
    table.to_csv(brands := file.with_name("brands.csv"), index=False)
    mapping = LogMapping(item_features=(FeatureTable((brands,), "sku"),))
    with read_logged_sessions(trained, [file], mapping, by="brand") as logged:
        items = trained.items.ids[logged.store.column("item")]
    names = np.array(logged.groups.names)[logged.groups.number]
    np.testing.assert_array_equal(names, np.array(["a", "b", "c"])[items % 3])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"by": "reward"}, "have several values"),
        ({"by": "item_id"}, "values in these"),
        ({"by": "price"}, "no column 'pri"),
        ({"measures": ["nullif(dwell, 0.5)"]}, "not the same"),
    ],
)
def test_columns_that_do_not_fit_are_refused(
    trained: TrainedPolicy, file: Path, given: dict[str, Any], says: str
) -> None:
    frame = pd.read_parquet(file)
    frame.assign(reward=frame.reward.where(frame.dwell != 1.5)).to_parquet(file)
    with (
        pytest.raises(InputError, match=says),
        read_logged_sessions(trained, [file], LogMapping(), **given),
    ):
        pass


def test_the_command_says_what_it_needs(
    folder: Path, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(folder / "run")
    options = ["--guardrail", "dwell >= -2%", "--by", "country", "--temperature", "1"]
    options += ["--guardrail", "dwell <= 9%"]
    assert main(["ope", run, str(file), *options]) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) <= 15
    for bound in ("at least -2.0%", "at most +9.0%"):
        assert any(line.startswith(f"guardrail dwell: –, {bound}: open (") for line in said)
    assert any(line.startswith("DE (") and "users): – (" in line for line in said)
    for more, says in (
        (["--guardrail", "dwell"], "write e.g."),
        (["--guardrail", "device = 'phone' >= 1%"], "coalesce("),
        ([], "name the logs"),
    ):
        logs = [str(file)] if more else []
        assert main(["ope", run, *logs, *(more or options)]) == 2
        assert says in capsys.readouterr().err
