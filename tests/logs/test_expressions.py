"""Rewards and mappings: scalar expressions are accepted, all else is refused in one line."""

import contextlib
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.attacks import ATTACKS, attack
from ucfrec import UCF, EpisodeStore
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.logs.engine import bind, engine
from ucfrec.logs.expressions import COPYING, FUNCTIONS, TYPES, NotScalarError, columns_of
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import prepare
from ucfrec.logs.tables import Table, open_tables
from ucfrec.runs.trained_policy import TrainedPolicy

SECRET = "the content of a file that was not named"
HONEST = (
    "least(play_ms / duration_ms, 5)",
    "ln(1 + play_ms)",
    "-play_ms ** 2 % 7",
    "is_click = 1 AND NOT (play_ms > 5 OR tag IS NULL)",
    "is_click -- the reward",
    "is_click /* ; COPY */ + 1",
    "CASE WHEN is_click = 1 THEN 1.5 WHEN play_ms > 100 THEN 0.5 ELSE 0 END",
    "CASE is_click WHEN 1 THEN 'yes' WHEN 0 THEN 'no' END",
    " + ".join(f"CASE tag WHEN '{n}' THEN {n} WHEN 'x{n}' THEN 0 ELSE -1 END" for n in range(6)),
    "try(1 / play_ms)",
    "try_cast(tag AS DOUBLE)",
    "tag::TEXT || '!'",
    "play_ms::DECIMAL(10, 2)",
    "play_ms::BIGINT & 255",
    "play_ms BETWEEN 0 AND 5 AND is_click IS NOT NULL",
    "tag LIKE 'a%' OR tag NOT ILIKE 'B_'",
    "tag LIKE 'a!%' ESCAPE '!'",
    "try_cast(regexp_extract(tag, '([0-9]+)', 1) AS INT)",
    "substring(tag FROM 1 FOR 2)",
    "concat_ws('-', left(tag, 8), user_id)",
    "tag = 'it''s; COPY x TO y'",
    "tag = $$a;b$$",
    "epoch_ms(strptime(day, '%Y-%m-%d'))",
    "strptime(day, ['%Y-%m-%d', '%d.%m.%Y'])",
    "day::TIMESTAMPTZ AT TIME ZONE 'UTC'",
    "TIMESTAMP '2024-01-01' + INTERVAL 1 DAY",
    "extract(hour FROM clock)",
    "date_diff('second', TIMESTAMP '2024-01-01', clock)",
    "[play_ms, seconds]::FLOAT[]",
    "numbers[1:2]",
    "list_sum(numbers) / len(numbers)",
    "1 IN numbers",
    "feedback.rating * 2",
    "feedback['rating']",
    "json ->> '$.like'",
    '"a column, with ""quotes"""',
    # What shops write is not taken for growth.
    "array_to_string(string_split(tag, '|'), ', ')",
    "concat_ws('-', tag, play_ms::VARCHAR, day)",
    " || ".join(["play_ms::VARCHAR"] * 60),
    "+".join(["play_ms"] * 90),
    "CASE WHEN " + " OR ".join(f"tag = '{n}'" for n in range(200)) + " THEN 1 END",
    "coalesce(json->>'$.x', json::JSON->>'$.like')::DOUBLE",
    "strftime(epoch_ms(seconds::BIGINT)::TIMESTAMP, '%Y-%m-%d')::VARCHAR || '!'",
)


def log_frame() -> pd.DataFrame:
    """300 rows with a column of every kind that the honest expressions read."""
    rng = np.random.default_rng(0)
    rows = 300
    return pd.DataFrame(
        {
            "user_id": rng.integers(20, size=rows),
            "item_id": rng.integers(10, size=rows),
            "timestamp": 1_700_000_000_000 + np.arange(rows) * 60_000,
            "reward": rng.random(rows),
            "is_click": rng.integers(2, size=rows),
            "play_ms": rng.random(rows) * 100,
            "duration_ms": rng.integers(3, size=rows).astype(float),
            "seconds": 1_700_000_000 + np.arange(rows),
            "clock": pd.Timestamp("2024-01-01") + pd.to_timedelta(np.arange(rows), unit="s"),
            "day": "2024-01-01",
            "tag": rng.choice(["a,b", "b", "7"], size=rows),
            "numbers": [[1, 2, 3]] * rows,
            "feedback": [{"rating": 1.5}] * rows,
            "json": '{"like": 1}',
            "user": 1,
            'a column, with "quotes"': 1.0,
        }
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("expressions") / "log.parquet"
    log_frame().to_parquet(path)
    return path


@pytest.fixture(scope="module")
def connection(log: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    """An engine with the log as a view."""
    with engine([log], log.parent) as connection:
        connection.execute(f"CREATE VIEW log AS FROM read_parquet('{log}')")
        yield connection


@pytest.fixture(scope="module")
def table(connection: duckdb.DuckDBPyConnection, log: Path) -> Table:
    return open_tables(connection, [log])[0]


@pytest.mark.parametrize("text", HONEST)
def test_honest_expressions_are_values_of_a_log(
    connection: duckdb.DuckDBPyConnection, table: Table, text: str
) -> None:
    sql, kind, *_ = bind(connection, table, "for the test", text)
    relation = connection.sql(f"SELECT {sql} AS x FROM log")
    assert [str(found) for found in relation.types] == [kind]
    assert relation.to_arrow_table().shape == (300, 1)


@pytest.mark.parametrize("name", ATTACKS)
def test_attacks_are_no_scalar_expressions(
    connection: duckdb.DuckDBPyConnection, table: Table, name: str, tmp_path: Path
) -> None:
    """By the check alone, or, of names that stand for the user and the time, by the columns."""
    out, secret = tmp_path / "out", tmp_path / "secret.txt"
    secret.write_text(SECRET)
    text = attack(name, str(out), str(secret))
    with pytest.raises(InputError) as caught:
        bind(connection, table, "for the reward", text)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 700
    assert "for the reward" in str(caught.value)
    if name not in ("the user", "the user, in short", "the clock", "type of nobody"):
        with pytest.raises(NotScalarError):
            columns_of(connection, text)
    assert list(tmp_path.iterdir()) == [secret]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, a store, and a run on it."""
    folder = tmp_path_factory.mktemp("trained")
    log_frame().to_parquet(folder / "log.parquet")
    prepare([folder / "log.parquet"], LogMapping(), folder / "store")
    fit(folder / "store", folder / "run")
    return folder


def fit(store: Path, run: Path) -> None:
    tiny = ["train.steps=2", "policy.dim=8", "policy.context=2", "augment.copies=0"]
    UCF(settings=tiny).fit(EpisodeStore.open(store), run)


def reward_of_run(run: Path, text: object) -> None:
    record = read_json(run / "run.json")
    (run / "run.json").write_text(json.dumps({**record, "reward": text}))


def toml(path: Path, text: str) -> list[str]:
    """Mapping files with the text at every place that takes an expression."""
    value = json.dumps(text)  # is a TOML string, too
    features = '[[item_features]]\nfiles = ["features.parquet"]\n'
    forms = (
        f"reward = {value}\n",
        f"[columns]\nuser_id = {value}\n",
        f'{features}key = {value}\ncolumns = ["reward"]\n',
        f'{features}key = "item_id"\ncolumns = [{value}]\n',
        f'{features}key = "item_id"\nfirst_by = {value}\n',
    )
    for number, form in enumerate(forms):
        (path / f"mapping{number}.toml").write_text(form, encoding="utf-8")
    return [str(path / f"mapping{number}.toml") for number in range(len(forms))]


def snapshot(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


BY_COMMAND = [name for name in ATTACKS if name != "half a character"][::3]
"""No argument holds half a character; every third attack comes by a command."""


@pytest.mark.parametrize("name", BY_COMMAND)
def test_no_way_in_lets_an_attack_through(
    trained: Path,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    outside, here = tmp_path / "outside", tmp_path / "here"
    outside.mkdir()
    shutil.copytree(trained, here)
    (outside / "secret.txt").write_text(SECRET)
    text = attack(name, str(outside / "out"), str(outside / "secret.txt"))
    shutil.copy(here / "log.parquet", here / "features.parquet")
    reward_of_run(here / "run", text)
    mappings = toml(here, text)
    monkeypatch.setenv("HOME", str(outside))
    monkeypatch.chdir(outside)
    before = snapshot(tmp_path)
    log, run, out = str(here / "log.parquet"), str(here / "run"), str(here / "result")
    ways = [
        ["prepare", log, "--out", out, f"--reward={text}"],
        ["prepare", log, "--out", out, "--column", f"user_id={text}"],
        *(["prepare", log, "--out", out, "--mapping", mapping] for mapping in mappings),
        ["recommend", run, log, "--out", out],
        ["score", run, log, "--out", out],
        ["ope", run, log, "--json", out],
    ]
    way = ways[BY_COMMAND.index(name) % len(ways)]
    assert main(way) == 2, way
    printed = capsys.readouterr()
    assert printed.err.strip().isprintable()
    assert len(printed.err) < 1000
    assert SECRET not in printed.out + printed.err
    assert snapshot(tmp_path) == before


def test_messages_say_where_the_expression_is_and_what_is_allowed(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def told(*arguments: str) -> str:
        assert main(["prepare", log, "--out", out, *arguments]) == 2
        return capsys.readouterr().err

    log, out = str(trained / "log.parquet"), str(tmp_path / "out")
    (tmp_path / "m.toml").write_text('[columns]\nuser_id = "(FROM x)"\n')
    message = told("--reward", "read_text('x')")
    assert "--reward: for the reward: \"read_text('x')\" is not a scalar SQL" in message
    assert f"over the columns of {log}: it calls 'read_text'; allowed are columns" in message
    by_file = told("--mapping", str(tmp_path / "m.toml"))
    assert f"{tmp_path / 'm.toml'}: for user_id: '(FROM x)' is not a scalar" in by_file
    assert "it has a subquery" in by_file


def test_a_store_of_somebody_else_brings_no_program(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "secret.txt").write_text(SECRET)
    text = attack("copy behind the expression", str(tmp_path / "out"), str(tmp_path / "secret.txt"))
    shutil.copytree(trained / "store", tmp_path / "store")
    meta = read_json(tmp_path / "store" / "meta.json")
    (tmp_path / "store" / "meta.json").write_text(json.dumps({**meta, "reward": text}))
    fit(tmp_path / "store", tmp_path / "run")
    assert TrainedPolicy.load(tmp_path / "run").record.reward == text
    log, out = str(trained / "log.parquet"), str(tmp_path / "result")
    for value, says in ((text, "not a scalar SQL expression"), (3, "run.json")):
        reward_of_run(tmp_path / "run", value)
        before = snapshot(tmp_path)
        for command, to in (("recommend", "--out"), ("score", "--out"), ("ope", "--json")):
            assert main([command, str(tmp_path / "run"), log, to, out]) == 2
            assert says in capsys.readouterr().err
            assert snapshot(tmp_path) == before


def test_listed_functions_only_compute(connection: duckdb.DuckDBPyConnection) -> None:
    """Each exists, has no state, and is neither aggregate nor table; macros copy no argument."""
    known: dict[str, list[tuple[str, str | None, list[str], str | None]]] = {}
    query = (
        "SELECT function_name, function_type, stability, parameters, macro_definition "
        "FROM duckdb_functions() WHERE schema_name <> 'temp' AND database_name = 'system'"
    )
    for name, *rest in connection.execute(query).fetchall():
        known.setdefault(name, []).append(tuple(rest))
    assert known.keys() >= FUNCTIONS
    assert len(TYPES) > 30
    for name in FUNCTIONS - {"least", "greatest"}:
        for kind, stability, parameters, macro in known[name]:
            assert kind in ("scalar", "macro"), name
            assert stability in (None, "CONSISTENT"), name
            if kind == "macro" and name not in COPYING:
                words = "".join(c if c.isalnum() else " " for c in str(macro)).split()
                assert all(words.count(p) == 1 for p in parameters), name


SQL_WORDS = """
    is_click user_id reward play_ms tag numbers feedback clock user rowid 1 2.5 -1 1e9 'a' '' $$x$$
    "is_click" NULL true ( ) [ ] { } , ; . : :: + - * / // % ^ ** || ! @ # $1 ? = <> < > <= >= & |
    ~ ~~ -> ->> => := -- /* */ ' " $$ \\ SELECT FROM WHERE GROUP ORDER BY LIMIT UNION WITH AS VALUES
    TABLE DISTINCT ALL ANY EXISTS CASE WHEN THEN ELSE END IN NOT AND OR IS BETWEEN LIKE CAST
    TRY_CAST TRY COALESCE EXTRACT INTERVAL DAY DATE TIMESTAMP AT TIME ZONE OVER FILTER LAMBDA FOR
    COPY TO ATTACH PRAGMA SET INSTALL DEFAULT COLUMNS STRUCT INT FLOAT VARCHAR least( abs( length(
    sum( unnest( list_sum( read_text( concat( round( epoch_ms( len( if( nullif( map(
"""
WORDS = st.sampled_from([*SQL_WORDS.split(), "\n"])


@settings(max_examples=100)
@given(text=st.one_of(st.lists(WORDS, max_size=12).map(" ".join), st.text(max_size=40)))
def test_soup_is_refused_or_a_value_of_each_row(
    connection: duckdb.DuckDBPyConnection, table: Table, text: str
) -> None:
    """No other error than InputError, and none of the engine but for values that do not convert."""
    with contextlib.suppress(InputError):
        sql, *_ = bind(connection, table, "for the test", text)
        with contextlib.suppress(
            duckdb.ConversionException, duckdb.InvalidInputException, duckdb.OutOfRangeException
        ):
            values = connection.sql(f"SELECT {sql} AS x FROM log").to_arrow_table()
            assert values.shape == (300, 1)


LEAVES = st.sampled_from(["is_click", "play_ms", "duration_ms", "1", "0.5", "NULL", "reward"])


def joined(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    """Sensible expressions around others."""
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "//", "%"]), inner).map(" ".join),
        st.tuples(inner, inner).map(lambda pair: f"least({pair[0]}, {pair[1]})"),
        inner.map(lambda x: f"CASE WHEN ({x}) > 1 THEN {x} ELSE 0 END"),
        inner.map(lambda x: f"coalesce(({x}), 0)"),
        inner.map(lambda x: f"({x})::DOUBLE"),
    )


@given(text=st.recursive(LEAVES, joined, max_leaves=6))
def test_sums_of_honest_parts_are_accepted(
    connection: duckdb.DuckDBPyConnection, table: Table, text: str
) -> None:
    sql, *_ = bind(connection, table, "for the test", text)
    assert len(connection.sql(f"SELECT TRY({sql}) FROM log").fetchall()) == 300


def nested(depth: int, template: str) -> str:
    return template.format(nested(depth - 1, template)) if depth else "a"


@pytest.mark.parametrize(
    "text",
    [
        nested(8, "string_split({}, '')::VARCHAR"),
        nested(12, "[{}, '''\\']::VARCHAR"),
        nested(12, "list_value({})::JSON::VARCHAR"),
        nested(12, "([{}]->>'$')"),
        nested(6, "array_to_string(string_split({}, ''), ', and then ')"),
        nested(4, "concat_ws({}" + ", ''" * 40 + ")"),
        nested(9, "concat([{}], '')"),
        "array_to_string(string_split(a, ''), a)",
        f"array_to_string(string_split(a, ''), '{'x' * 1000}')",
    ],
)
def test_text_cannot_grow_without_bound(text: str) -> None:
    with engine((), None) as connection, pytest.raises(NotScalarError, match=r"text"):
        columns_of(connection, text)


def test_the_documentation_lists_every_function() -> None:
    page = Path("docs/log-format.md").read_text(encoding="utf-8")
    section = page.partition("these functions of DuckDB are allowed:")[2].partition("\n## ")[0]
    named = {each for each in FUNCTIONS if each[0].isalpha() and not each.endswith("_escape")}
    named -= {"xor"}  # an operator
    assert set(re.findall(r"[a-z]\w*(?=[,\n])", section)) == named
