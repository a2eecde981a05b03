"""Exposures and feedback as one log: what was shown, with what probability, and what came of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import gettempdir
from typing import Final

import duckdb
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.binding import explained
from ucfrec.logs.engine import BATCH_ROWS, engine
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.tables import Table, is_number, open_tables, quoted
from ucfrec.logs.typed import typed_columns

FEEDBACK: Final = "feedback"
"""Column of the log: how many rows of feedback belong to the exposure."""
_REQUEST: Final = schema.REQUEST_ID
_EXPOSURE: Final = {
    schema.USER_ID: None,
    schema.ITEM_ID: None,
    schema.TIMESTAMP: "BIGINT",
    _REQUEST: "VARCHAR",
    schema.POSITION: "INTEGER",
    schema.PROPENSITY: "DOUBLE",
    schema.RUN: "VARCHAR",
    schema.RULE: "VARCHAR",
    schema.ARM: "VARCHAR",
}
"""Columns of exposures and their DuckDB types; those of ids are kept."""
_KEYS: Final = {*_EXPOSURE, FEEDBACK, "row"}


@dataclass(frozen=True)
class Joined:
    """What was joined."""

    exposures: int
    """Rows of the log."""
    repeated: int
    """Rows of exposures that repeat one of the same user, request, position and item."""
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

    Args:
        exposures: files, folders and globs of `serve` and `recommend`.
        feedback: log files with `user_id`, `item_id`, `timestamp` and perhaps `request_id`.
        out: Parquet file: the columns of the exposures, `feedback` and those of the feedback.
        mapping: log columns to the columns of the feedback.
        memory_limit: of the engine; rows spill to disk.

    Raises:
        InputError: a file or column is missing, or of a wrong type.
    """
    files = log_files(exposures), log_files(feedback)
    with (
        scratch_folder(Path(gettempdir()), "join") as folder,
        engine([*files[0], *files[1]], folder, memory_limit, shared=True) as connection,
    ):
        shown, given = (tuple(open_tables(connection, each)) for each in files)
        with explained(connection, (*shown, *given), folder):
            _make_exposures(connection, shown)
            columns = _make_feedback(connection, given, mapping or LogMapping())
            _match(connection, within_ms)
            _write(connection, columns, out)
            return _counts(connection, columns)


def _make_exposures(connection: duckdb.DuckDBPyConnection, tables: Sequence[Table]) -> None:
    """Create the table `exposures`, each once, with its `row`."""
    for table in tables:
        missing = [name for name in _EXPOSURE if name not in (*table.columns, schema.ARM)]
        if missing:
            raise InputError(
                f"{table.files[0]} has no column {', '.join(missing)}: it is not a file of "
                "exposures; name those that serve --exposures or recommend --exposures wrote first"
            )
    rows = " UNION ALL BY NAME ".join(
        f"SELECT {_selected(table)} FROM {table.sql}" for table in tables
    )
    connection.execute(f"CREATE TABLE given_exposures AS {rows}")
    connection.execute(
        "CREATE TABLE exposures AS SELECT *, row_number() OVER (ORDER BY timestamp, user_id, "
        f"{_REQUEST}, position, item_id) AS row FROM given_exposures QUALIFY row_number() OVER "
        f"(PARTITION BY user_id, {_REQUEST}, position, item_id ORDER BY timestamp) = 1"
    )


def _selected(table: Table) -> str:
    """The columns of exposures, with their types; the arm is empty where there is none."""
    columns = []
    for name, kind in _EXPOSURE.items():
        value = quoted(name) if name in table.columns else "''"
        value = value if kind is None else f"CAST({value} AS {kind})"
        columns.append(f"{value} AS {quoted(name)}")
    return ", ".join(columns)


def _make_feedback(
    connection: duckdb.DuckDBPyConnection, tables: tuple[Table, ...], mapping: LogMapping
) -> tuple[str, ...]:
    """Create the table `feedback` with its `row`; returns its columns of feedback."""
    typed = typed_columns(connection, tables, _keys_of(mapping), "0", "user")
    used = {name.casefold() for name in _KEYS}
    used |= {name.casefold() for table in typed.tables for name in table.used or ()}
    columns = dict.fromkeys(
        name
        for table in tables
        for name, kind in table.columns.items()
        if name.casefold() not in used and (is_number(kind) or kind == "BOOLEAN")
    )
    selects = []
    for whole, narrow, select in zip(tables, typed.tables, typed.selects, strict=True):
        has = [name for name in columns if name in whole.columns]
        request = _REQUEST in whole.columns
        read = narrow.of([*(narrow.used or ()), *has, *[_REQUEST] * request], narrow.raw)
        values = [f"CAST({quoted(name)} AS DOUBLE) AS {quoted(name)}" for name in has]
        values.append(f"CAST({_REQUEST if request else 'NULL'} AS VARCHAR) AS {_REQUEST}")
        selects.append(f"SELECT {select}, {', '.join(values)} FROM {read.sql}")
    rows = " UNION ALL BY NAME ".join(selects)
    connection.execute(
        f"CREATE TABLE feedback AS SELECT *, row_number() OVER () AS row FROM ({rows})"
    )
    return tuple(columns)


def _keys_of(mapping: LogMapping) -> LogMapping:
    """The mapping of user, item and time; feedback has nothing else that a log could."""
    absent = {schema.OBSERVATION: "", schema.PROPENSITY: "", schema.IS_RANDOM: ""}
    return replace(mapping, columns={**mapping.columns, **absent}, where=None)


def _match(connection: duckdb.DuckDBPyConnection, within_ms: int) -> None:
    """Create the table `matches`, feedback row to exposure row."""
    connection.execute(
        "CREATE TABLE matches AS SELECT f.row AS feedback_row, e.row AS row FROM feedback f "
        "JOIN exposures e ON CAST(f.user_id AS VARCHAR) = CAST(e.user_id AS VARCHAR) "
        "AND CAST(f.item_id AS VARCHAR) = CAST(e.item_id AS VARCHAR) "
        f"AND (f.{_REQUEST} IS NULL OR f.{_REQUEST} = e.{_REQUEST}) "
        f"AND f.timestamp BETWEEN e.timestamp AND e.timestamp + {int(within_ms)} "
        "QUALIFY row_number() OVER (PARTITION BY f.row ORDER BY e.row DESC) = 1"
    )


def _write(connection: duckdb.DuckDBPyConnection, columns: Sequence[str], out: Path) -> None:
    """Write the log, users as numbers if the feedback has numbers."""
    values = [f"max({quoted(name)}) AS {quoted(name)}" for name in columns]
    found = ", ".join(["m.row AS row", f"count(*) AS {FEEDBACK}", *values])
    filled = ", ".join(f"coalesce({quoted(name)}, 0) AS {quoted(name)}" for name in columns)
    user = "CAST(user_id AS BIGINT) AS user_id" if _whole_users(connection) else "user_id"
    query = (
        f"SELECT {user}, * EXCLUDE (user_id, row, {', '.join((FEEDBACK, *map(quoted, columns)))}), "
        f"coalesce({FEEDBACK}, 0) AS {FEEDBACK}{', ' if filled else ''}{filled} FROM exposures "
        f"LEFT JOIN (SELECT {found} FROM matches m JOIN feedback f ON f.row = m.feedback_row "
        "GROUP BY m.row) USING (row) ORDER BY row"
    )
    with atomic_file(out) as scratch:
        batches = connection.sql(query).to_arrow_reader(BATCH_ROWS)
        with pq.ParquetWriter(scratch, batches.schema) as writer:
            for batch in batches:
                writer.write_batch(batch)


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
