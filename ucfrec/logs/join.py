"""Exposures and feedback as one log: what was shown, with what probability, and what came of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import gettempdir

import duckdb

from ucfrec import schema
from ucfrec.errors import InputError, warn_user
from ucfrec.files.atomic import atomic_file, require_other_files
from ucfrec.files.parquet import require_table_names, table_writer
from ucfrec.logs.candidates import ITEMS, list_set_files, load_named_sets, write_sets
from ucfrec.logs.engine import BATCH_ROWS, bind, engine, explain_errors
from ucfrec.logs.mapping import OPTIONAL_COLUMNS, LogMapping, log_files
from ucfrec.logs.rows import DAY_MS, DECISION_MS
from ucfrec.logs.summary import MANY, note_undefined
from ucfrec.logs.tables import (
    EXPOSED,
    PANDAS_INDEX,
    Table,
    cast_integer,
    is_number,
    open_tables,
    quote_name,
)
from ucfrec.logs.typed import WANTED, LogTables, TypedLog, type_columns

FEEDBACK = "feedback"
"""Column of the log: how many rows of feedback belong to the exposure."""
_REQUEST = schema.REQUEST_ID
_KEYS = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP)
_OTHERS = {
    _REQUEST: "VARCHAR",
    schema.POSITION: "INTEGER",
    schema.PROPENSITY: "DOUBLE",
    schema.SESSION_BEGAN: "BIGINT",
    schema.EXCLUDES_SEEN: "BOOLEAN",
    schema.RUN: "VARCHAR",
    schema.RULE: "VARCHAR",
    schema.ARM: "VARCHAR",
    schema.CANDIDATES: "VARCHAR",
}
"""Columns of exposures besides the keys, and their DuckDB types."""
_EXPOSURE = (*_KEYS, *_OTHERS)
_ABSENT = {
    **dict.fromkeys((schema.ARM, schema.CANDIDATES), "''"),
    schema.SESSION_BEGAN: "NULL::BIGINT",
    schema.EXCLUDES_SEEN: "false",
}
"""Columns that exposures may lack, and SQL of what they then are."""
_ONE_EXPOSURE = ", ".join(n for n in _EXPOSURE if n not in (schema.TIMESTAMP, schema.PROPENSITY))
"""SQL of the columns that are equal where an exposure is written twice; the others may differ."""
_SAME_KEY = (
    "CAST(f.user_id AS VARCHAR) = CAST(e.user_id AS VARCHAR) "
    "AND CAST(f.item_id AS VARCHAR) = CAST(e.item_id AS VARCHAR)"
)
"""Whether feedback `f` and exposure `e` are of the same user and item."""
_WRITE_NUMBERS = "write numbers as 12.50, truth values as true and false"


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
    unmatched: int
    """Rows of feedback that belong to an exposure, and to none."""
    columns: tuple[str, ...]
    """Columns of the feedback that the log has."""

    def __str__(self) -> str:
        share = self.with_feedback / max(self.exposures, 1)
        return (
            f"{self.exposures:,} exposures, {self.with_feedback:,} of them with feedback "
            f"({share:.1%}); {self.repeated:,} repeated rows left out\n"
            f"{self.matched:,} rows of feedback matched, {self.unmatched:,} without an exposure\n"
            f"feedback columns: {', '.join((FEEDBACK, *self.columns))}"
        )


def join_feedback(
    exposures: Sequence[str | Path],
    feedback: Sequence[str | Path],
    out: Path,
    within_ms: int,
    mapping: LogMapping | None = None,
    memory_limit: str = "2GB",
) -> Joined:
    """Write a log of exposures with the feedback that they got.

    A row of feedback belongs to the latest exposure of its user and item that is at most
    `within_ms` older; if it has one, of its `request_id`, and at most a minute newer. Of several
    rows of feedback the log has the largest value, other than 0, of every column that is a number
    or a truth value; 0 where there is none.

    An `InputNote` says which columns are left out, and what may be wrong if a fifth has no match.

    Args:
        exposures: files, folders and globs of `serve` and `recommend`.
        feedback: log files with `user_id`, `item_id`, `timestamp` and perhaps `request_id`.
        out: Parquet or CSV file: the columns of the exposures, `feedback` and those of the
            feedback. Where the exposures are a log of this function, `feedback` counts both, and of
            a number that both have it is the larger value.
        mapping: log columns to the columns of the feedback, and which of its rows count.

    Raises InputError if a file or column is missing, or of a wrong type; a file of feedback is one
    of exposures; or `out` is one of them.
    """
    require_table_names([out])
    shown_files, feedback_files = log_files(exposures), log_files(feedback)
    files = [*shown_files, *feedback_files]
    require_other_files([out], files)
    mapping = mapping or LogMapping()
    set_files = list_set_files(LogMapping(), shown_files)
    with engine([*files, *set_files], Path(gettempdir()), memory_limit) as connection:
        shown_tables = tuple(open_tables(connection, shown_files))
        tables = tuple(open_tables(connection, feedback_files, mapping.partitions))
        with explain_errors(connection, (*shown_tables, *tables), out.parent):
            further = _make_exposures(connection, shown_tables)
            columns = _make_feedback(connection, tables, mapping)
            # Of the exposures at one time, the last one counts.
            matches = (
                f"SELECT f.row AS feedback_row, e.row FROM feedback f ASOF JOIN (SELECT user_id, "
                f"item_id, timestamp, {request}, max(row) AS row FROM exposures GROUP BY ALL) e ON "
                f"{_SAME_KEY} AND f.{_REQUEST} IS NOT DISTINCT FROM e.{_REQUEST} "
                f"AND f.timestamp + if(f.{_REQUEST} IS NULL, 0, {schema.CLOCKS_DIFFER_MS}) "
                f">= e.timestamp WHERE f.{_REQUEST} IS {missing} "
                f"AND f.timestamp <= e.timestamp + {int(within_ms)}"
                for request, missing in ((_REQUEST, "NOT NULL"), (f"NULL AS {_REQUEST}", "NULL"))
            )
            connection.execute(f"CREATE TABLE matches AS {' UNION ALL '.join(matches)}")
            load_named_sets(connection, set_files)
            sets = connection.sql(
                f"SELECT {schema.CANDIDATES}, {ITEMS} FROM named_sets "
                f"SEMI JOIN exposures USING ({schema.CANDIDATES}) ORDER BY {schema.CANDIDATES}"
            )
            write_sets(out, sets.to_arrow_table())
            _write(connection, columns, further, out)
            ((exposure_rows, written, rows, matched, with_feedback),) = connection.sql(
                "SELECT (SELECT count(*) FROM exposures), (SELECT count(*) FROM given_exposures), "
                "(SELECT count(*) FROM feedback), count(*), count(DISTINCT row) FROM matches"
            ).fetchall()
            repeated, unmatched = written - exposure_rows, rows - matched
            joined = Joined(exposure_rows, repeated, with_feedback, matched, unmatched, columns)
            if unmatched >= MANY * rows > 0 or not matched:
                warn_user(_why_unmatched(connection, joined))
            return joined


_Further = dict[str, tuple[str, bool]]
"""Further columns of the exposures, as those of a log that was joined before, by their name in
lower case: name, and whether they hold numbers or truth values in all files that have them. Their
names in the table `exposures` are more_0, …, so that any name is possible."""


def _names_of(table: Table) -> dict[str, str]:
    """Column names in lower case to those of the files, without a pandas index."""
    return {name.casefold(): name for name in table.columns if not PANDAS_INDEX.fullmatch(name)}


def _holds_feedback(kind: str) -> bool:
    return is_number(kind) or kind == "BOOLEAN"


def _make_exposures(connection: duckdb.DuckDBPyConnection, tables: tuple[Table, ...]) -> _Further:
    """Create the table `exposures`, each once, with its `row`; returns its further columns."""
    for table in tables:
        missing = [name for name in _EXPOSURE if name not in {*_names_of(table), *_ABSENT}]
        if missing:
            raise InputError(
                f"{table.files[0]} has no column {', '.join(missing)}: it is not a file of "
                "exposures; name those that serve --exposures or recommend --exposures wrote first"
            )
    typed = type_columns(LogTables(connection, tables, _keys_of(LogMapping()), "0", "user"))
    further: _Further = {}
    for table in tables:
        for key, name in _names_of(table).items():
            if key not in {*typed.columns, *_EXPOSURE}:
                first, is_number = further.get(key, (name, True))
                further[key] = first, is_number and _holds_feedback(table.columns[name])
    rows = " UNION ALL BY NAME ".join(
        f"SELECT {keys}, {_select_others(whole, narrow, further)}"
        for whole, narrow, keys in zip(tables, typed.tables, typed.selects, strict=True)
    )
    connection.execute(f"CREATE TABLE given_exposures AS {rows}")
    connection.execute(
        f"CREATE TABLE exposures AS SELECT * EXCLUDE {schema.REWARD}, row_number() OVER "
        f"(ORDER BY timestamp, {_ONE_EXPOSURE}) AS row FROM given_exposures "
        f"QUALIFY coalesce(timestamp - lag(timestamp) OVER (PARTITION BY {_ONE_EXPOSURE} "
        f"ORDER BY timestamp) > {DECISION_MS}, true)"
    )
    return further


def _select_others(table: Table, keys: Table, further: _Further) -> str:
    """SQL of the columns of exposures besides the `keys` that a table has, and of its rows."""
    names, values, texts = _names_of(table), dict(_ABSENT), []
    more = {key: f"more_{n}" for n, key in enumerate(further) if key in names}
    for name, kind in _OTHERS.items():
        if name in names and kind == "VARCHAR":
            texts.append(names[name])
            values[name] = f"coalesce({table.text_of(names[name])}, {_ABSENT.get(name, 'NULL')})"
        elif name in names:
            values[name] = f"CAST({quote_name(names[name])} AS {kind})"
    values |= {alias: quote_name(names[key]) for key, alias in more.items()}
    columns = [name for key, name in names.items() if key in more or key in _OTHERS]
    selects = ", ".join(f"{value} AS {name}" for name, value in values.items())
    return f"{selects} FROM {keys.add_texts([n for n in columns if n not in texts], texts).sql}"


def _make_feedback(
    connection: duckdb.DuckDBPyConnection, tables: tuple[Table, ...], mapping: LogMapping
) -> tuple[str, ...]:
    """Create the table `feedback` with its `row`; returns its columns of feedback,
    whose values are its columns value_0, …, so that any name is possible."""
    for table in tables:
        if table.of_exposures:
            raise InputError(
                f"{table.files[0]} is not feedback: it has the columns of exposures "
                f"({', '.join(EXPOSED)}), as a log of join has; name the exposures once, by "
                "their folder or as a pattern in quotes that the shell does not expand, and then "
                "files of feedback"
            )
    typed = type_columns(LogTables(connection, tables, _keys_of(mapping), "0", "user"))
    keys = {
        column.casefold()
        for table in tables
        for name in _KEYS
        for column in bind(
            connection, table, f"for {name}", mapping.columns.get(name, name)
        ).columns
    }
    keys |= {name.casefold() for table in tables for name, _ in table.partitions}
    columns = _feedback_columns(typed, tables, keys)
    selects, folded = [], [name.casefold() for name in columns]
    for whole, narrow, select in zip(tables, typed.tables, typed.selects, strict=True):
        names = _names_of(whole)
        present = {n: names[key] for n, key in enumerate(folded) if key in names}
        values = []
        for n, name in present.items():
            column = quote_name(name)
            if not _holds_feedback(whole.columns[name]):
                column = f"CAST({column} AS VARCHAR)"  # it holds text of numbers, or nothing
            values.append(f"nullif(CAST({column} AS DOUBLE), 0) AS value_{n}")
        requests = [names[_REQUEST]] if _REQUEST in names else []
        values.append(f"{whole.text_of(requests[0]) if requests else 'NULL'} AS {_REQUEST}")
        source = narrow.add_texts(present.values(), requests)
        selects.append(f"SELECT {select}, {', '.join(values)} FROM {source.sql}")
    conditions = ["true"]
    rows = f"({' UNION ALL BY NAME '.join(selects)})"
    if mapping.where is not None:
        note_undefined(typed, mapping.where, rows)
        conditions.append(WANTED)
    if mapping.earliest is not None:
        conditions.append(f"timestamp >= {int(mapping.earliest_ms)}")
    connection.execute(
        "CREATE TABLE feedback AS SELECT *, row_number() OVER () AS row "
        f"FROM {rows} WHERE {' AND '.join(conditions)}"
    )
    return columns


def _feedback_columns(log: TypedLog, tables: Sequence[Table], keys: set[str]) -> tuple[str, ...]:
    """Numeric and boolean columns but `keys` (in lower case), with a note on those left out."""
    columns: dict[str, tuple[str, Path]] = {}
    left_out: dict[str, str] = {}
    not_numbers = []
    for table in tables:
        for key, name in _names_of(table).items():
            kind = table.columns[name]
            if key in keys or key in (*_KEYS, _REQUEST):
                continue
            if key in _OTHERS:
                left_out[name] = "of the exposures, too"
            elif not _holds_feedback(kind):
                not_numbers.append((table, key, name, kind))
            elif key == FEEDBACK:
                left_out[name] = "the log has its own, the number of rows; rename it"
            else:
                columns.setdefault(key, (name, table.files[0]))
    for table, key, name, kind in not_numbers:
        if key not in columns and kind != "VARCHAR":
            continue
        values, words, sample = log.one(
            "SELECT count(x), count(x) FILTER (n), min(x) FILTER (n) FROM (SELECT x, "
            "NOT coalesce(isfinite(TRY_CAST(x AS DOUBLE)), false) AS n FROM (SELECT "
            f"trim(CAST({quote_name(name)} AS VARCHAR)) AS x FROM {table.of([name]).sql}))"
        )
        found_words = f"{words:,} of {values:,} are not numbers (such as {sample!r:.60})"
        if words and key in columns:
            raise InputError(
                f"{table.files[0]}: column {name} has numbers in {columns[key][1]}, but here "
                f"{found_words}; {_WRITE_NUMBERS}, or remove the column"
            )
        if values and key not in columns:
            left_out[name] = f"text, {found_words if words else 'though all are numbers'}"
    if left_out:
        names = ", ".join(f"{name} ({why})" for name, why in left_out.items())
        warn_user(
            f"{log.name}: columns are left out: {names}; where one is feedback, {_WRITE_NUMBERS}, "
            "in a column of its own name"
        )
    return tuple(name for name, _ in columns.values())


def _keys_of(mapping: LogMapping) -> LogMapping:
    """The mapping of user, item and time; feedback has nothing else that a log could."""
    absent = {name: "" for name in OPTIONAL_COLUMNS if name != schema.SESSION_ID}
    return replace(mapping, columns={**mapping.columns, **absent})


def _write(
    connection: duckdb.DuckDBPyConnection,
    columns: Sequence[str],
    further: _Further,
    out: Path,
) -> None:
    """Write the log, users as numbers if the feedback has numbers."""
    values = {FEEDBACK: FEEDBACK, **{name: f"value_{n}" for n, name in enumerate(columns)}}
    largest = "".join(f", max(value_{n}) AS value_{n}" for n in range(len(columns)))
    earlier = {key: f"more_{n}" for n, key in enumerate(further)}
    again = {name.casefold() for name in values}
    selects = [
        f"{earlier[key]} AS {quote_name(name)}"
        for key, (name, _) in further.items()
        if key not in again
    ]
    for name, value in values.items():
        both, key = [value], name.casefold()
        if key in further and further[key][1]:
            both.append(f"nullif(CAST({earlier[key]} AS DOUBLE), 0)")
        # Neither `list_sum` nor `list_max` counts what is missing.
        sql = f"list_{'sum' if name == FEEDBACK else 'max'}([{', '.join(both)}])"
        kind = "BIGINT" if name == FEEDBACK else "DOUBLE"
        selects.append(f"CAST(coalesce({sql}, 0) AS {kind}) AS {quote_name(name)}")
    internal = "user_id", "row", *values.values(), *earlier.values()
    ((whole,),) = connection.sql(
        "SELECT (SELECT coalesce(any_value(typeof(user_id)) = 'BIGINT', false) FROM feedback) "
        f"AND (SELECT count({cast_integer('user_id')}) = count(user_id) FROM exposures)"
    ).fetchall()
    user = "CAST(user_id AS BIGINT) AS user_id" if whole else "user_id"
    query = (
        f"SELECT {user}, * EXCLUDE ({', '.join(internal)}), {', '.join(selects)} FROM exposures "
        f"LEFT JOIN (SELECT m.row AS row, count(*) AS {FEEDBACK}{largest} FROM matches m "
        "JOIN feedback f ON f.row = m.feedback_row GROUP BY m.row) USING (row) "
        "ORDER BY exposures.row"
    )
    batches = connection.sql(query).to_arrow_reader(BATCH_ROWS)
    with atomic_file(out) as scratch, table_writer(scratch, out, batches.schema) as writer:
        for batch in batches:
            writer.write_batch(batch)


def _why_unmatched(connection: duckdb.DuckDBPyConnection, joined: Joined) -> str:
    """What may be wrong with feedback of which few rows match."""
    # As a number where no calendar has it.
    span = " || ' to ' || ".join(
        f"coalesce({end}(TRY(strftime(make_timestamp_ms(timestamp), '%Y-%m-%d %H:%M:%S'))), "
        f"CAST({end}(timestamp) AS VARCHAR), '(none)')"
        for end in ("min", "max")
    )
    ((requests, equal, request, given_at, midnight, users, other_request, shown_at),) = (
        connection.sql(
            f"SELECT count({_REQUEST}), count_if({_REQUEST} IN (SELECT {_REQUEST} FROM exposures)),"
            f" min({_REQUEST}), {span}, coalesce(bool_and(timestamp % {DAY_MS} = 0), false), "
            f"(SELECT count(*) FROM feedback f SEMI JOIN exposures e ON {_SAME_KEY}), "
            f"(SELECT min({_REQUEST}) FROM exposures), (SELECT {span} FROM exposures) FROM feedback"
        ).fetchall()
    )
    reasons = []
    if requests and not equal:
        reasons.append(
            f"none of its {requests:,} values of {_REQUEST} (such as {request!r:.60}) is one of the"
            f" exposures (such as {other_request!r:.60}), log the one that was served or omit the "
            "column"
        )
    if not users:
        reasons.append(
            "none of its users was shown any of their items, check --column user_id and item_id"
        )
    reasons.append(
        f"exposures are from {shown_at} and feedback from {given_at} (UTC), where "
        "numbers are read as milliseconds: seconds need --column timestamp='COLUMN * 1000', "
        "microseconds --column timestamp='COLUMN / 1000', and later feedback a larger --within"
    )
    if midnight:
        reasons.append(
            "its dates have no time of day and count as midnight, before what was shown on that "
            "day: log the time, too"
        )
    rows = joined.matched + joined.unmatched
    return (
        f"{joined.unmatched:,} of {rows:,} rows of feedback "
        f"({joined.unmatched / max(rows, 1):.0%}) match no exposure; {'; '.join(reasons)}"
    )
