"""Spark sorts a log as DuckDB does: the stores are the same to the last bit."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import faulty_log
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare, validate

NAMES = {"user_id": "user", "item_id": "item", "timestamp": "seconds"}


def make_log(rows: int, text: bool, seed: int) -> pd.DataFrame:
    log = faulty_log(rows, text, seed)
    return log.assign(timestamp=log.timestamp // 1000).rename(columns=NAMES)


MAPPING = LogMapping({"user_id": "user", "item_id": "item", "timestamp": "seconds * 1000"})


def assert_equal_stores(logs: list[Path], folder: Path, mapping: LogMapping, **given: Any) -> None:
    for engine in ("duckdb", "spark"):
        options = PrepareOptions(**given, embedding_size=4, engine=engine)
        prepare(logs, mapping, folder / engine, options)
    files = {p.relative_to(folder / "duckdb") for p in (folder / "duckdb").rglob("*")}
    assert files == {p.relative_to(folder / "spark") for p in (folder / "spark").rglob("*")}
    for file in files:
        one, other = folder / "duckdb" / file, folder / "spark" / file
        assert one.is_dir() or one.read_bytes() == other.read_bytes(), file
    assert {p.name for p in folder.iterdir() if p.is_dir()} == {"duckdb", "spark"}


@pytest.mark.parametrize(
    ("text", "session_by"),
    [pytest.param(False, "gap", marks=pytest.mark.slow), (True, "session_id")],
)
def test_stores_are_the_same(tmp_path: Path, spark: Any, text: bool, session_by: str) -> None:
    log = make_log(900, text, seed=len(session_by))
    log.iloc[:200].to_parquet(tmp_path / "a.parquet")
    log.iloc[200:500].to_csv(tmp_path / "b.csv", index=False)
    log.iloc[500:].to_parquet(tmp_path / "c.parquet", row_group_size=70)
    assert_equal_stores(
        [tmp_path / name for name in ("c.parquet", "a.parquet", "b.csv")],
        tmp_path,
        MAPPING,
        # 1 / 0 is undefined, and an undefined part makes `least` undefined, to DuckDB only.
        reward="least(reward / length, 1)",
        session_by=session_by,
        duplicates="last" if text else "highest",
    )


def test_stores_of_vectors_are_the_same_in_a_folder_of_any_name(tmp_path: Path, spark: Any) -> None:
    tmp_path = tmp_path / "a %2F[1]{b}?"
    tmp_path.mkdir()
    log = make_log(300, text=False, seed=1)
    generator = np.random.default_rng(0)
    log["action"] = list(generator.integers(2, size=(300, 2)).astype("f4"))
    log.loc[3, "action"] = None
    log["observation"] = list(generator.normal(size=(300, 3)))
    log = log.drop(columns="item")
    log[:100].to_parquet(tmp_path / "a.parquet")
    log[100:].to_parquet(tmp_path / "b.parquet")
    mapping = LogMapping({k: v for k, v in MAPPING.columns.items() if k != "item_id"})
    assert_equal_stores([tmp_path], tmp_path, mapping, reward="length", session_by="gap")


def test_faults_are_one_clear_error(tmp_path: Path, spark: Any) -> None:
    log = make_log(300, text=False, seed=1)
    log["observation"] = list(np.ones((300, 3)))
    log.at[5, "observation"] = np.array([1.0, np.nan, 1.0])
    log.to_parquet(tmp_path / "a.parquet")
    with pytest.raises(InputError, match="in 1 of 300 rows"):
        validate([tmp_path], MAPPING, PrepareOptions(reward="length", engine="spark"))
    columns = {**MAPPING.columns, "observation": "", "user_id": "user::VARCHAR::DATE::VARCHAR"}
    with pytest.raises(InputError, match=r"a\.parquet: Conversion Error") as caught:
        validate([tmp_path], LogMapping(columns), PrepareOptions(reward="length", engine="spark"))
    assert "\n" not in str(caught.value)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    make_log(30, text=False, seed=1).to_parquet(tmp_path / "a.parquet")
    columns = [f"--column={name}={sql}" for name, sql in MAPPING.columns.items()]
    command = [sys.executable, "-m", "ucfrec", "prepare", str(tmp_path / "a.parquet"), *columns]
    command += ["--reward", "length", "--engine", "spark", "--out", str(tmp_path / "store")]
    # Neither with nor without pyspark is there a Java.
    nowhere = {**os.environ, "PATH": str(tmp_path), "JAVA_HOME": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, env=nowhere, check=False)
    assert done.returncode == 2
    assert "ucfrec[spark]" in done.stderr or "needs Java 17" in done.stderr
    assert "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]
