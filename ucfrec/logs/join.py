"""Exposures and feedback as one log: what was shown, with what probability, and what came of it."""

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final

import duckdb
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError, InputNote
from ucfrec.files.atomic import atomic_file, require_other_files
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.binding import bind, explained
from ucfrec.logs.engine import BATCH_ROWS, engine
from ucfrec.logs.feedback import feedback_columns, holds_feedback, names_of
from ucfrec.logs.kept import DAY_MS
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.summary import note_undefined
from ucfrec.logs.tables import Table, open_tables, quoted
from ucfrec.logs.typed import WANTED, typed_columns

FEEDBACK: Final = "feedback"
"""Column of the log: how many rows of feedback belong to the exposure."""
_REQUEST: Final = schema.REQUEST_ID
_KEYS: Final = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP)
_OTHERS: Final = {
    _REQUEST: "VARCHAR",
    schema.POSITION: "INTEGER",
    schema.PROPENSITY: "DOUBLE",
    schema.RUN: "VARCHAR",
    schema.RULE: "VARCHAR",
    schema.ARM: "VARCHAR",
}
"""Columns of exposures besides the keys, and their DuckDB types."""
_EXPOSURE: Final = (*_KEYS, *_OTHERS)
_MEASURED: Final = (schema.TIMESTAMP, schema.PROPENSITY)
"""Columns that may differ where an exposure is written twice."""
_ONLY_SHOWN: Final = (schema.POSITION, schema.PROPENSITY, schema.RUN, schema.RULE)
"""Columns that together only exposures have, and logs that were made of them."""
_ONE_EXPOSURE: Final = ", ".join(name for name in _EXPOSURE if name not in _MEASURED)
"""SQL of the columns that are equal where an exposure is written twice."""
_SAME_KEY: Final = (
    "CAST(f.user_id AS VARCHAR) = CAST(e.user_id AS VARCHAR) "
    "AND CAST(f.item_id AS VARCHAR) = CAST(e.item_id AS VARCHAR)"
)
"""Whether feedback `f` and exposure `e` are of the same user and item."""


@dataclass(frozen=True)
class Joined:
    """What was joined."""

    exposures: int
    """Rows of the log."""
    repeated: int
    """Rows of exposures that repeat one of the same user, request, position, item, run and rule."""
    with_feedback: int
    """Rows of the log with feedback."""
    matched: int
    """Rows of feedback that belong to an exposure."""
    unmatched: int
    """Rows of feedback that belong to none."""
    columns: tuple[str, ...]
    """Columns of the feedback that the log has."""

    def __str__(self) -> str:
        share = self.with_feedback / max(self.exposures, 1)
        lines = [
            f"{self.exposures:,} exposures, {self.with_feedback:,} of them with feedback "
            f"({share:.1%}); {self.repeated:,} repeated rows left out",
            f"{self.matched:,} rows of feedback matched, {self.unmatched:,} without an exposure",
            f"feedback columns: {', '.join((FEEDBACK, *self.columns))}",
        ]
        return "\n".join(lines)


def join_feedback(
    exposures: Sequence[str | Path],
    feedback: Sequence[str | Path],
    out: Path,
    within_ms: int,
    mapping: LogMapping | None = None,
    memory_limit: str = "2GB",
) -> Joined:
    """Write a log of exposures with the feedback that they got.

    A row of feedback belongs to the latest exposure of its user and item, and of its `request_id`
    if it has one, that is at most `within_ms` older; to that one alone. Of several rows of feedback
    the log has the largest value of every column that is a number or a truth value; where there is
    none, 0.

    An `InputNote` says which columns of feedback are left out, as they are text or have the name of
    a column of exposures, and what may be wrong where no row of feedback matches.

    Args:
        exposures: files, folders and globs of `serve` and `recommend`.
        feedback: log files with `user_id`, `item_id`, `timestamp` and perhaps `request_id`.
        out: Parquet file: the columns of the exposures, `feedback` and those of the feedback. Where
            the exposures are a log of this function, `feedback` counts both, and of a number that
            both have it is the larger value.
        mapping: log columns to the columns of the feedback, and which of its rows count.
        memory_limit: of the engine; rows spill to disk.

    Raises:
        InputError: a file or column is missing, or of a wrong type; a file of feedback is one of
            exposures; or `out` is one of them.
    """
    files = log_files(exposures), log_files(feedback)
    require_other_files([out], [*files[0], *files[1]])
    with (
        scratch_folder(Path(gettempdir()), "join") as folder,
        engine([*files[0], *files[1]], folder, memory_limit, shared=True) as connection,
    ):
        mapping = mapping or LogMapping()
        shown = tuple(open_tables(connection, files[0]))
        given = tuple(open_tables(connection, files[1], mapping.partitions))
        with explained(connection, (*shown, *given), folder):
            kept = _make_exposures(connection, shown)
            _require_feedback(given)
            columns = _make_feedback(connection, given, mapping)
            _match(connection, within_ms)
            _write(connection, columns, kept, out)
            joined = _counts(connection, columns)
            if not joined.matched:
                warnings.warn(_why_unmatched(connection, joined), InputNote, stacklevel=2)
            return joined


@dataclass(frozen=True)
class _More:
    """A further column of the exposures, as those of a log that was joined before."""

    name: str
    value: str
    """Its name in the table `exposures`, so that any name is possible."""
    is_number: bool
    """Or a truth value, in all files that have it."""


def _further(tables: Sequence[Table], taken: Collection[str]) -> dict[str, _More]:
    """Further columns of the exposures, by their names in lower case.

    Args:
        taken: names in lower case of the columns that exposures have.
    """
    found: dict[str, _More] = {}
    for table in tables:
        for key, name in names_of(table).items():
            if key not in taken:
                one = found.get(key) or _More(name, f"more_{len(found)}", is_number=True)
                number = one.is_number and holds_feedback(table.columns[name])
                found[key] = replace(one, is_number=number)
    return found


def _make_exposures(
    connection: duckdb.DuckDBPyConnection, tables: tuple[Table, ...]
) -> dict[str, _More]:
    """Create the table `exposures`, each once, with its `row`; returns its further columns."""
    for table in tables:
        missing = [name for name in _EXPOSURE if name not in {*names_of(table), schema.ARM}]
        if missing:
            raise InputError(
                f"{table.files[0]} has no column {', '.join(missing)}: it is not a file of "
                "exposures; name those that serve --exposures or recommend --exposures wrote first"
            )
    typed = typed_columns(connection, tables, _keys_of(LogMapping()), "0", "user")
    more = _further(tables, {*typed.names, *_EXPOSURE})
    rows = " UNION ALL BY NAME ".join(
        f"SELECT {keys}, {_others(whole, more)} FROM {_with_others(whole, narrow, more).sql}"
        for whole, narrow, keys in zip(tables, typed.tables, typed.selects, strict=True)
    )
    connection.execute(f"CREATE TABLE given_exposures AS {rows}")
    connection.execute(
        f"CREATE TABLE exposures AS SELECT * EXCLUDE {schema.REWARD}, row_number() OVER "
        f"(ORDER BY timestamp, {_ONE_EXPOSURE}) AS row FROM given_exposures "
        f"QUALIFY row_number() OVER (PARTITION BY {_ONE_EXPOSURE} ORDER BY timestamp) = 1"
    )
    return more


def _require_feedback(tables: Sequence[Table]) -> None:
    """Refuse exposures as feedback, which a pattern that the shell expands makes of them."""
    for table in tables:
        if names_of(table).keys() >= {*_ONLY_SHOWN}:
            raise InputError(
                f"{table.files[0]} is not feedback: it has the columns of exposures "
                f"({', '.join(_ONLY_SHOWN)}), as a log of join has; name the exposures once, by "
                "their folder or as a pattern in quotes that the shell does not expand, and then "
                "files of feedback"
            )


def _others(table: Table, more: Mapping[str, _More]) -> str:
    """SQL of the columns of exposures besides the keys; the arm is empty where there is none."""
    names = names_of(table)
    found = {
        name: table.text_of(names[name]) if kind == "VARCHAR" else f"CAST({name} AS {kind})"
        for name, kind in _OTHERS.items()
        if name in names
    }
    found |= {more[key].value: quoted(name) for key, name in names.items() if key in more}
    found[schema.ARM] = f"coalesce({found.get(schema.ARM, 'NULL')}, '')"
    return ", ".join(f"{value} AS {name}" for name, value in found.items())


def _with_others(table: Table, narrow: Table, more: Mapping[str, _More]) -> Table:
    """A table of the keys, with the columns that `_others` reads."""
    kinds = {name: _OTHERS[key] for key, name in names_of(table).items() if key in _OTHERS}
    texts = [name for name, kind in kinds.items() if kind == "VARCHAR"]
    columns = [name for name in kinds if name not in texts]
    columns += [name for key, name in names_of(table).items() if key in more]
    return narrow.with_texts(columns, texts)


def _make_feedback(
    connection: duckdb.DuckDBPyConnection, tables: tuple[Table, ...], mapping: LogMapping
) -> tuple[str, ...]:
    """Create the table `feedback` with its `row`; returns its columns of feedback.

    Their values are its columns `_value(0)`, …, so that any name is possible.
    """
    typed = typed_columns(connection, tables, _keys_of(mapping), "0", "user")
    read = _keys_read(connection, tables, mapping)
    used = {*_EXPOSURE, FEEDBACK, *read}
    columns = feedback_columns(connection, tables, used, FEEDBACK, {*_OTHERS} - {_REQUEST} - read)
    selects = []
    for whole, narrow, select in zip(tables, typed.tables, typed.selects, strict=True):
        names = names_of(whole)
        has = [
            (n, names[key]) for n, name in enumerate(columns) if (key := name.casefold()) in names
        ]
        values = [f"{_as_number(name, whole.columns[name])} AS {_value(n)}" for n, name in has]
        requests = [names[_REQUEST]] if _REQUEST in names else []
        values.append(f"{whole.text_of(requests[0]) if requests else 'NULL'} AS {_REQUEST}")
        source = narrow.with_texts([name for _, name in has], requests)
        selects.append(f"SELECT {select}, {', '.join(values)} FROM {source.sql}")
    rows = " UNION ALL BY NAME ".join(selects)
    conditions = ["true"] if mapping.where is None else [WANTED]
    if mapping.where is not None:
        note_undefined(connection, tables, mapping.where)
    if mapping.earliest is not None:
        conditions.append(f"timestamp >= {int(mapping.earliest_ms)}")
    connection.execute(
        f"CREATE TABLE feedback AS SELECT *, row_number() OVER () AS row FROM ({rows}) "
        f"WHERE {' AND '.join(conditions)}"
    )
    return columns


def _value(n: int) -> str:
    return f"value_{n}"


def _as_number(name: str, kind: str) -> str:
    """SQL of a column of feedback as DOUBLE; other types hold text of numbers or nothing."""
    value = quoted(name) if holds_feedback(kind) else f"CAST({quoted(name)} AS VARCHAR)"
    return f"CAST({value} AS DOUBLE)"


def _keys_of(mapping: LogMapping) -> LogMapping:
    """The mapping of user, item and time; feedback has nothing else that a log could."""
    absent = {schema.OBSERVATION: "", schema.PROPENSITY: "", schema.IS_RANDOM: ""}
    return replace(mapping, columns={**mapping.columns, **absent})


def _keys_read(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], mapping: LogMapping
) -> set[str]:
    """Columns, in lower case, that user, item and time are read from, and those of folders."""
    given = [(table, name, mapping.columns.get(name) or name) for table in tables for name in _KEYS]
    read = (bind(connection, table, f"for {name}", each) for table, name, each in given)
    folders = {name.casefold() for table in tables for name, _ in table.partitions}
    return folders | {column.casefold() for bound in read for column in bound.columns}


def _match(connection: duckdb.DuckDBPyConnection, within_ms: int) -> None:
    """Create the table `matches`, feedback row to exposure row."""
    connection.execute(
        "CREATE TABLE matches AS SELECT f.row AS feedback_row, e.row AS row FROM feedback f "
        f"JOIN exposures e ON {_SAME_KEY} "
        f"AND (f.{_REQUEST} IS NULL OR f.{_REQUEST} = e.{_REQUEST}) "
        f"AND f.timestamp BETWEEN e.timestamp AND e.timestamp + {int(within_ms)} "
        "QUALIFY row_number() OVER (PARTITION BY f.row ORDER BY e.row DESC) = 1"
    )


def _write(
    connection: duckdb.DuckDBPyConnection,
    columns: Sequence[str],
    more: Mapping[str, _More],
    out: Path,
) -> None:
    """Write the log, users as numbers if the feedback has numbers."""
    values = [_value(n) for n in range(len(columns))]
    found = ", ".join(
        ["m.row AS row", f"count(*) AS {FEEDBACK}", *(f"max({each}) AS {each}" for each in values)]
    )
    named = dict(zip((FEEDBACK, *columns), (FEEDBACK, *values), strict=True))
    again = {name.casefold() for name in named}
    filled = [f"{one.value} AS {quoted(one.name)}" for k, one in more.items() if k not in again]
    for name, each in named.items():
        before = more.get(name.casefold())
        filled.append(f"{_filled(each, before, name == FEEDBACK)} AS {quoted(name)}")
    internal = "row", FEEDBACK, *values, *(each.value for each in more.values())
    user = "CAST(user_id AS BIGINT) AS user_id" if _whole_users(connection) else "user_id"
    query = (
        f"SELECT {user}, * EXCLUDE (user_id, {', '.join(internal)}), {', '.join(filled)} "
        f"FROM exposures LEFT JOIN (SELECT {found} FROM matches m JOIN feedback f "
        "ON f.row = m.feedback_row GROUP BY m.row) USING (row) ORDER BY exposures.row"
    )
    with atomic_file(out) as scratch:
        batches = connection.sql(query).to_arrow_reader(BATCH_ROWS)
        with pq.ParquetWriter(scratch, batches.schema) as writer:
            for batch in batches:
                writer.write_batch(batch)


def _filled(value: str, before: _More | None, counts: bool) -> str:
    """SQL of a column of feedback, with what an earlier join found of it.

    Args:
        counts: whether it counts rows, which are added; of other columns the larger value is kept.
    """
    value = f"coalesce({value}, 0)"
    if before is None or not before.is_number:
        return value
    if counts:
        return f"{value} + CAST(coalesce({before.value}, 0) AS BIGINT)"
    return f"greatest({value}, CAST(coalesce({before.value}, 0) AS DOUBLE))"


def _whole_users(connection: duckdb.DuckDBPyConnection) -> bool:
    """Whether the feedback's users are numbers, and all exposures' are written as numbers are."""
    kinds = {row[0]: row[1] for row in connection.sql("DESCRIBE feedback").fetchall()}
    if kinds[schema.USER_ID] != "BIGINT":
        return False
    ((others,),) = connection.sql(
        "SELECT bool_or(CAST(TRY_CAST(user_id AS BIGINT) AS VARCHAR) IS DISTINCT FROM "
        "CAST(user_id AS VARCHAR)) FROM exposures"
    ).fetchall()
    return not others


def _counts(connection: duckdb.DuckDBPyConnection, columns: tuple[str, ...]) -> Joined:
    def count(of: str) -> int:
        ((number,),) = connection.sql(f"SELECT count({of}").fetchall()
        return int(number)

    shown, given = count("*) FROM exposures"), count("*) FROM given_exposures")
    matched = count("*) FROM matches")
    return Joined(
        exposures=shown,
        repeated=given - shown,
        with_feedback=count("DISTINCT row) FROM matches"),
        matched=matched,
        unmatched=count("*) FROM feedback") - matched,
        columns=columns,
    )


def _why_unmatched(connection: duckdb.DuckDBPyConnection, joined: Joined) -> str:
    """What may be wrong with feedback of which no row matches."""

    def one(sql: str) -> tuple[Any, ...]:
        row: tuple[Any, ...] = connection.sql(sql).fetchall()[0]
        return row

    reasons = []
    requests, known, sample, wanted = one(
        f"SELECT count({_REQUEST}), "
        f"count(*) FILTER ({_REQUEST} IN (SELECT {_REQUEST} FROM exposures)), "
        f"min({_REQUEST}), (SELECT min({_REQUEST}) FROM exposures) FROM feedback"
    )
    if requests and not known:
        reasons.append(
            f"none of its {requests:,} values of {_REQUEST} (such as {sample!r:.60}) is one of the "
            f"exposures (such as {wanted!r:.60}), log the one that was served or omit the column"
        )
    if not one(f"SELECT count(*) FROM feedback f SEMI JOIN exposures e ON {_SAME_KEY}")[0]:
        reasons.append(
            "none of its users was shown any of their items, check --column user_id and item_id"
        )
    reasons.append(
        f"exposures are from {_time_range(connection, 'exposures')} and feedback from "
        f"{_time_range(connection, 'feedback')} (UTC), where numbers are read as milliseconds: "
        "seconds need --column timestamp='COLUMN * 1000', microseconds "
        "--column timestamp='COLUMN / 1000', and later feedback a larger --within"
    )
    if one(f"SELECT coalesce(bool_and(timestamp % {DAY_MS} = 0), false) FROM feedback")[0]:
        reasons.append(
            "its dates have no time of day and count as midnight, before what was shown on that "
            "day: log the time, too"
        )
    rows = joined.unmatched
    return f"none of the {rows:,} rows of feedback matches an exposure; {'; '.join(reasons)}"


def _time_range(connection: duckdb.DuckDBPyConnection, rows: str) -> str:
    """The first and the last time of a table, in UTC; as a number where no calendar has it."""
    first, last = (
        f"coalesce(strftime(TRY(make_timestamp_ms({each})), '%Y-%m-%d %H:%M:%S'), "
        f"CAST({each} AS VARCHAR), '(none)')"
        for each in ("first", "last")
    )
    ((told,),) = connection.sql(
        f"SELECT {first} || ' to ' || {last} FROM "
        f"(SELECT min(timestamp) AS first, max(timestamp) AS last FROM {rows})"
    ).fetchall()
    return str(told)
