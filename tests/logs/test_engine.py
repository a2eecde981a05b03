"""The engine by itself: whatever SQL it is given, it reads its inputs and writes its scratch."""

import gzip
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pandas as pd
import pytest

from ucfrec.errors import InputError
from ucfrec.files.locks import SCRATCH
from ucfrec.logs import LogMapping, PrepareOptions, validate
from ucfrec.logs.engine import engine
from ucfrec.logs.tables import open_tables, text

SECRET = "the content of a file that was not named"

REFUSED = (
    "COPY (SELECT 1) TO '{out}'",
    "COPY (SELECT 1) TO '{out}' (FORMAT parquet, USE_TMP_FILE false)",
    "COPY (SELECT 1) TO '{work}/../escaped.csv'",
    "COPY (SELECT 1) TO '/dev/stdout'",
    "COPY (SELECT 1 AS a, 2 AS b) TO '{out}' (FORMAT csv, PARTITION_BY (a))",
    "CREATE TABLE t (x VARCHAR); COPY t FROM '{secret}'",
    "EXPORT DATABASE '{out}'",
    "IMPORT DATABASE '{folder}'",
    "ATTACH '{out}' AS x",
    "ATTACH '{secret}' AS x (READ_ONLY)",
    "ATTACH 'http://127.0.0.1:1/x.db' AS x",
    "FROM '{secret}'",
    "FROM read_text('{secret}')",
    "FROM read_text('{input}/../secret.csv')",
    "FROM read_text('{work}/../secret.csv')",
    "FROM read_blob('{secret}')",
    "FROM read_csv('{secret}')",
    "FROM read_csv(['{input}', '{secret}'])",
    "FROM read_json('{secret}')",
    "FROM read_ndjson('{secret}')",
    "FROM read_parquet('{folder}/*.parquet')",
    "FROM sniff_csv('{secret}')",
    "FROM glob('{folder}/*')",
    "FROM glob('/*')",
    "FROM parquet_metadata('{folder}/other.parquet')",
    "FROM parquet_schema('{folder}/other.parquet')",
    "FROM '{folder}/link.parquet'",
    "FROM 'http://127.0.0.1:1/x.parquet'",
    "FROM read_csv('https://127.0.0.1:1/x.csv')",
    "FROM 's3://bucket/x.parquet'",
    "FROM frame",
    "SELECT getenv('HOME')",
    "INSTALL httpfs",
    "FORCE INSTALL spatial FROM community",
    "INSTALL '{out}'",
    "LOAD httpfs",
    "LOAD '{out}'",
    "FROM sqlite_scan('{secret}', 't')",
    "FROM postgres_scan('', '', '')",
    "CALL start_ui()",
    "CREATE PERSISTENT SECRET s (TYPE http, BEARER_TOKEN 'x')",
    "SET enable_external_access = true",
    "RESET enable_external_access",
    "PRAGMA enable_external_access = true",
    "SET GLOBAL allowed_directories = ['/']",
    "SET allowed_paths = ['{secret}']",
    "SET lock_configuration = false",
    "SET allow_community_extensions = true",
    "SET autoload_known_extensions = true",
    "SET extension_directory = '{folder}'",
    "SET home_directory = '{folder}'",
    "SET secret_directory = '{folder}'",
    "SET temp_directory = '{folder}'",
    "SET memory_limit = '100GB'",
    "SET python_enable_replacements = true",
    "SET log_query_path = '{out}'",
    "SET profile_output = '{out}'",
    "PRAGMA profile_output = '{out}'",
    "PRAGMA enable_profiling = 'json'",
    "CALL enable_logging(storage = 'file', storage_path = '{out}')",
)
"""Statements that end in an error."""


@pytest.fixture
def inputs(tmp_path: Path) -> list[Path]:
    """Two inputs; beside them, files that are none."""
    pd.DataFrame({"x": [1, 2]}).to_parquet(tmp_path / "input.parquet")
    (tmp_path / "input.csv").write_text("x\n1\n2\n")
    pd.DataFrame({"x": [SECRET]}).to_parquet(tmp_path / "other.parquet")
    (tmp_path / "secret.csv").write_text(f"x\n{SECRET}\n")
    (tmp_path / "link.parquet").symlink_to(tmp_path / "other.parquet")
    return [tmp_path / "input.parquet", tmp_path / "input.csv"]


@pytest.fixture
def closed(inputs: list[Path], tmp_path: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    with engine(inputs, tmp_path) as connection:
        yield connection


def work_of(folder: Path) -> Path:
    (work,) = (path for path in folder.iterdir() if path.name.endswith(SCRATCH))
    return work


@pytest.mark.parametrize("statement", REFUSED)
def test_the_environment_is_shut(
    closed: duckdb.DuckDBPyConnection,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    statement: str,
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    frame = pd.DataFrame({"x": [SECRET]})
    assert len(frame) == 1
    work = work_of(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.glob("*.*") if path.is_file()}
    names = {
        "out": tmp_path / "out",
        "secret": tmp_path / "secret.csv",
        "input": tmp_path / "input.csv",
        "folder": tmp_path,
        "work": work,
    }
    with pytest.raises(duckdb.Error) as caught:
        closed.execute(statement.format(**names)).fetchall()
    assert SECRET not in str(caught.value)
    now = {path: path.read_bytes() for path in tmp_path.glob("*.*") if path.is_file()}
    assert now == before
    assert {path.name for path in tmp_path.iterdir()} == {
        *(path.name for path in before),
        work.name,
        "home",
    }
    assert not list(home.iterdir())


def test_inputs_are_read(closed: duckdb.DuckDBPyConnection, inputs: list[Path]) -> None:
    assert closed.execute(f"FROM read_parquet('{inputs[0]}')").fetchall() == [(1,), (2,)]
    assert closed.execute(f"FROM read_csv('{inputs[1]}')").fetchall() == [(1,), (2,)]


NAMES = "[1] b* it's é {1,2} x\\y"


@pytest.mark.parametrize(
    "name", [*(f"{name}.parquet" for name in NAMES.split()), "a.csv", "[a-z]*.csv", "a.csv.gz"]
)
def test_files_of_any_name_are_read_alone(tmp_path: Path, name: str) -> None:
    frame = pd.DataFrame({"x": [1, 2]})
    for file, values in ((name, frame), ("1.parquet", frame + 5), ("bc.parquet", frame + 5)):
        path = tmp_path / file
        if file.endswith(".parquet"):
            values.to_parquet(path)
        elif file.endswith(".csv"):
            values.to_csv(path, index=False)
        else:
            path.write_bytes(gzip.compress(values.to_csv(index=False).encode()))
    with engine([tmp_path / name], tmp_path) as connection:
        (table,) = open_tables(connection, [tmp_path / name])
        assert connection.execute(f"FROM {table.sql}").fetchall() == [(1,), (2,)]


def test_relative_and_linked_paths_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "here").mkdir()
    (tmp_path / "linked").symlink_to(tmp_path / "logs")
    monkeypatch.chdir(tmp_path / "here")
    pd.DataFrame({"x": [1]}).to_parquet("../logs/a.parquet")
    for path in ("../logs/a.parquet", "../linked/a.parquet", "./../here/../logs/a.parquet"):
        with engine([Path(path)], Path()) as connection:
            (table,) = open_tables(connection, [Path(path)])
            assert connection.execute(f"FROM {table.sql}").fetchall() == [(1,)]
    assert not list(Path().iterdir())


def test_rows_spill_into_the_scratch_folder_and_vanish(tmp_path: Path) -> None:
    folder = tmp_path / "it's a folder"
    folder.mkdir()
    with engine([], folder, "60MB") as connection:
        connection.execute(
            "CREATE TABLE t AS SELECT range AS i, md5(range::TEXT) AS s FROM range(400000)"
        )
        rows = connection.execute(
            "SELECT i, row_number() OVER (PARTITION BY i % 7 ORDER BY s) FROM t "
            "ORDER BY s LIMIT 5 OFFSET 300000"
        ).fetchall()
        assert len(rows) == 5
        assert [path.is_dir() for path in sorted(folder.iterdir())] == [False, True]
    assert not list(folder.iterdir())


def test_a_memory_limit_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"memory_limit 'much' is not a size; write e\.g\. 2GB"):  # noqa: SIM117
        with engine([], tmp_path, "much"):
            pass
    assert not list(tmp_path.iterdir())


def test_hostile_column_names_stay_names(tmp_path: Path) -> None:
    """Names and types of columns come from files, and into SQL."""
    rows = 40
    hostile = """x" INTEGER); COPY (SELECT 1) TO 'out'; --"""
    frame = pd.DataFrame(
        {
            "user_id": [n % 7 for n in range(rows)],
            "item_id": [n % 5 for n in range(rows)],
            "timestamp": [1_700_000_000_000 + n for n in range(rows)],
            "reward": [n % 3 for n in range(rows)],
            hostile: [{hostile: 1.0}] * rows,
        }
    )
    frame.to_parquet(tmp_path / "log.parquet")
    quoted = '"' + hostile.replace('"', '""') + '"'
    for reward in (
        "reward * 2",
        f"{quoted}.{quoted} * reward",
        f"{quoted}[{text(hostile)}] + reward",
    ):
        options = PrepareOptions(reward=reward)
        assert validate([tmp_path / "log.parquet"], LogMapping(), options)["steps"] == rows
    assert [path.name for path in tmp_path.iterdir()] == ["log.parquet"]


def test_every_connection_is_closed_to_the_environment() -> None:
    """`duckdb.connect`, and its default connection, are used in one file."""
    root = Path(sys.modules["ucfrec"].__path__[0]).parent
    opens = re.compile(r"duckdb\.(connect|sql|query|execute|read_|from_|default_connection|cursor)")
    packages = ("ucfrec", "datasets", "simulators", "control")
    files = (path for package in packages for path in (root / package).rglob("*.py"))
    found = {path.name for path in files if opens.search(path.read_text(encoding="utf-8"))}
    assert found == {"engine.py"}
    assert text("it's") == "'it''s'"


def test_scratch_of_a_killed_process_goes_with_the_next(inputs: list[Path], tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; from ucfrec.logs.engine import engine\n"
        "with engine([], Path(sys.argv[1])) as connection:\n"
        "    connection.execute('CREATE TABLE t AS SELECT range AS x FROM range(100000)')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    folder = tmp_path / "scratch"
    folder.mkdir()
    for _ in range(2):
        subprocess.run([sys.executable, "-c", code, str(folder)], check=False)
        assert sum(path.is_dir() for path in folder.iterdir()) == 1
    with engine(inputs, folder):
        assert sum(path.is_dir() for path in folder.iterdir()) == 1
    assert list(folder.iterdir()) == []
