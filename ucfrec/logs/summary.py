"""Report on what `prepare` read, dropped and kept, and warnings that a log's owner would want."""

import re
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import duckdb

from ucfrec import schema
from ucfrec.episodes.store import LONG
from ucfrec.errors import InputError, InputNote, one_line
from ucfrec.files.remote import origin
from ucfrec.logs.binding import bind
from ucfrec.logs.kept import CLOCK_HINT, DUPLICATES, REASONS
from ucfrec.logs.measures import USED_USERS, StepCounts, measure_distributions, report_steps
from ucfrec.logs.sessions import Cut
from ucfrec.logs.sorted_rows import SortedRows
from ucfrec.logs.tables import Table, first_and_more, quoted, text
from ucfrec.logs.typed import ROWS, TypedLog

CONFLICT: Final = "duplicates with a different reward from the kept row"
"""Describes `conflicting_duplicates` of the report."""


def require_variety(rows: SortedRows) -> None:
    """Check that the usable rows do not all have the same reward.

    Raises:
        InputError: all rewards are equal.
    """
    if rows.lowest == rows.highest:
        raise InputError(
            f"{rows.log.name}: all {rows.count} rewards equal {rows.lowest:g}, so there is "
            "nothing to learn; choose another reward expression"
        )


def build_report(rows: SortedRows, cut: Cut, counts: StepCounts) -> dict[str, Any]:
    """Counts and statistics of a log, as JSON values.

    Times are in ms, `reward_statistics` in units of the reward.
    """
    return {
        "files": [origin(file) for table in rows.log.tables for file in table.files],
        "rows_read": rows.read,
        "dropped": {
            **rows.dropped,
            "long_session": counts.long_rows,
            "short_episode": rows.count - counts.steps - counts.long_rows,
        },
        "conflicting_duplicates": rows.conflicts,
        "unsorted_rows": rows.unsorted,
        "equal_times": rows.tied,
        "session_by": cut.session_by,
        "session_gap_ms": cut.gap_ms if cut.session_by == "gap" else None,
        "split_times_ms": list(cut.bounds),
        "summary": measure_distributions(rows, cut, counts),
        **report_steps(rows, counts),
    }


def format_report(report: Mapping[str, Any]) -> str:
    """The report of `prepare` as a text table with one count per line."""
    reward = report["reward_statistics"]
    lines = [("rows read", f"{report['rows_read']:,} from {len(report['files'])} file(s)")]
    for reason, rows in report["dropped"].items():
        if rows:
            lines.append((f"  dropped: {reason}", f"{rows:,}  {REASONS.get(reason, '')}"))
    if report["conflicting_duplicates"]:
        rule = DUPLICATES[report.get("duplicates", "highest")]
        conflicts = f"{report['conflicting_duplicates']:,}  {CONFLICT}, which {rule}"
        lines.append(("  conflicting duplicates", conflicts))
    if report["equal_times"]:
        text = f"{report['equal_times']:,} (in no order that could be learned)"
        lines.append(("  at equal times", text))
    lines += [
        ("  out of order", f"{report['unsorted_rows']:,} (sorted, none dropped)"),
        ("steps kept", f"{report['steps']:,}"),
        ("users", f"{report['users']:,}"),
    ]
    if "items" in report:
        lines.append(("items", f"{report['items']:,}"))
    if report.get("unknown_propensities"):
        text = f"{report['unknown_propensities']:,}  missing, NaN or infinite"
        lines.append(("  unknown propensity", text))
    lines.append(("sessions", f"{report['sessions']:,} by {report['session_by']}"))
    if report["sessions_cut"]:
        lines.append(("  cut at a split", f"{report['sessions_cut']:,}"))
    if report.get("sessions_censored"):
        text = f"{report['sessions_censored']:,}  may have gone on after the log ended"
        lines.append(("  censored", text))
    lines += [
        (f"  {name}", f"{count['episodes']:,} episodes, {count['steps']:,} steps")
        for name, count in report["splits"].items()
    ]
    lines.append(("times (UTC)", " to ".join(_clock(t) for t in report["time_range_ms"])))
    if report.get("return_length_share") is not None:
        lines.append(("return-to-go", _returns_to_go(report)))
    figures = ", ".join(f"{name} {value:.4g}" for name, value in reward.items())
    lines.append(("reward", f"{one_line(report['reward'])}: {figures}"))
    width = max(len(name) for name, _ in lines) + 2
    return "\n".join(f"{name:<{width}}{value}".rstrip() for name, value in lines)


def format_summary(report: Mapping[str, Any]) -> str:
    """What was read and dropped, in two lines, where logs are only evaluated on."""
    dropped = [f"{rows:,} {reason}" for reason, rows in report["dropped"].items() if rows]
    begin, end = (_clock(time) for time in report["time_range_ms"])
    return (
        f"{report['rows_read']:,} rows read, {report['steps']:,} kept: {report['sessions']:,} "
        f"sessions of {report['users']:,} users, {begin} to {end} UTC\n"
        f"dropped: {', '.join(dropped) or 'none'}"
    )


def _returns_to_go(report: Mapping[str, Any]) -> str:
    text = f"{report['return_length_share']:.0%} of its variance is the number of steps left"
    if report["session_by"] != "user":
        return text
    return f"{text}, which is random where sessions are users: policies learn the next step's"


def _clock(milliseconds: int) -> str:
    return datetime.fromtimestamp(milliseconds / 1000, UTC).strftime("%Y-%m-%d %H:%M:%S")


_NAMED: Final = 5
"""Users of the longest sessions that are named."""
MANY: Final = 0.2
"""Share of the rows from which on what happens to them is worth a warning."""
_REMEDIES: Final = {
    "null_key": "fill it in, or map another column",
    "clock_out_of_range": CLOCK_HINT,
    "vector_not_finite": "correct the actions",
    "unknown_item": "bring the run up to date, or leave those rows out",
    "duplicate": "log finer times, or remove the repetitions",
}


def note_losses(rows: SortedRows, reward: str, where: str | None = None) -> None:
    """Warn of more than a fifth of the rows dropped for one reason, and of undefined conditions.

    Args:
        rows: of the log; its connection is free.
        where: condition of the rows that are wanted at all.
    """
    if where is not None and rows.dropped["left_out"]:
        note_undefined(rows.log.connection, rows.log.tables, where)
    n_wanted = rows.read - rows.dropped["left_out"]
    for reason, n in rows.dropped.items():
        if n <= MANY * n_wanted or reason == "left_out":
            continue
        share = f"{n:,} of {n_wanted:,} rows ({n / n_wanted:.0%}) are dropped"
        if reason == "reward_not_finite":
            why = _missing(rows.log, reward, where or "true")
            _note(rows, f"{share}: the reward {reward} is {why}")
            continue
        which = _missing_key(rows.log) if reason == "null_key" else ""
        _note(rows, f"{share}: {REASONS[reason]}{which}; {_REMEDIES[reason]}")


def note_undefined(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], where: str
) -> None:
    """Warn of rows in which a condition is neither true nor false, which are excluded, too."""
    undefined = rows = 0
    for table in tables:
        bound = bind(connection, table, "for --where", where)
        columns_asked = f"count(*) FILTER (TRY({bound.sql}) IS NULL), count(*)"
        source = table.of(bound.columns).sql
        ((some, every),) = connection.sql(f"SELECT {columns_asked} FROM {source}").fetchall()
        undefined, rows = undefined + some, rows + every
    if undefined:
        warnings.warn(
            f"{first_and_more([file for table in tables for file in table.files])}: the condition "
            f"{where} is neither true nor false in {undefined:,} of {rows:,} rows, as a column is "
            "missing there, and these are excluded; to keep them, write IS DISTINCT FROM for <>, "
            "or coalesce(…, true) around the condition",
            InputNote,
            stacklevel=3,
        )


def note_equal_times(rows: SortedRows, time: str) -> None:
    """Warn of a log in which many rows share their user and time.

    Args:
        time: expression over the columns of the files that gives the times.
    """
    if rows.tied > MANY * rows.count:
        _note(
            rows,
            f"{rows.tied / rows.count:.0%} of the rows share their time with another row of "
            "the user, so their order is unknown and is not learned; log finer times, or add the "
            f'place on a page: --column "timestamp={time} + position" for milliseconds, --column '
            f'"timestamp={time} + to_milliseconds(position)" for dates',
        )


def note_one_item(rows: SortedRows, report: Mapping[str, Any]) -> None:
    """Warn of a log that shows the same item everywhere."""
    if report.get("items") == 1:
        _note(
            rows,
            f"all {report['steps']:,} rows show the same item, so there is nothing to choose "
            "between; check --column item_id and --where",
        )


def note_empty_splits(rows: SortedRows, report: Mapping[str, Any]) -> None:
    """Warn of times of a split that leave a part of the log without rows."""
    if names := [name for name, split in report["splits"].items() if not split["steps"]]:
        begin, end = map(_clock, report["time_range_ms"])
        _note(
            rows,
            f"--split {','.join(map(_clock, report['split_times_ms']))} leaves no rows for "
            f"{' and '.join(names)}: the rows are from {begin} to {end} UTC; give times between "
            "these, or three shares",
        )


def note_bots(rows: SortedRows, report: Mapping[str, Any], user: str) -> None:
    """Warn of sessions that are much longer than most.

    Args:
        rows: of the log; its connection is free.
        user: expression over the columns of the files that gives the users.
    """
    median = report["summary"]["session_lengths"]["quantiles"]["0.5"]
    users_found = rows.log.connection.sql(
        f"SELECT {schema.USER_ID}, longest FROM {USED_USERS} WHERE longest > {LONG * median} "
        f"ORDER BY longest DESC, code DESC LIMIT {_NAMED}"
    ).fetchall()
    if not users_found:
        return
    bots = ", ".join(f"{name} ({steps:,} rows)" for name, steps in users_found)
    users = ", ".join(str(n) if isinstance(n, int) else text(str(n)) for n, _ in users_found)
    if not re.fullmatch(r"[\w' ,:@.-]*", users):
        users = "…"  # what a shell would take for a program is not proposed
    _note(
        rows,
        f"the median session has {median:,} row{'s' * (median > 1)}, but these users have sessions "
        f"of more than {LONG} times that, as bots have: {bots}; leave them out with "
        f'--where "{user} NOT IN ({users})" or --max-session {LONG * median}',
    )


def _note(rows: SortedRows, message: str) -> None:
    warnings.warn(f"{rows.log.name}: {message}", InputNote, stacklevel=3)


def _missing_key(log: TypedLog) -> str:
    names = [schema.USER_ID, log.key, schema.TIMESTAMP]
    names += [schema.SESSION_ID] if log.session_by == schema.SESSION_ID else []
    columns_asked = ", ".join(f"count(*) FILTER ({name} IS NULL)" for name in names)
    counts = log.one(f"SELECT {columns_asked} FROM {ROWS}")
    users_found = [f"{name} in {n:,}" for name, n in zip(names, counts, strict=True) if n]
    return f" ({', '.join(users_found)})"


def _missing(log: TypedLog, reward: str, where: str) -> str:
    """Why the reward is undefined, and what to do."""
    counts: dict[str, int] = {}
    for table in log.tables:
        bound = bind(log.connection, table, "for the reward", reward)
        for name, n in _null_counts(log, table, bound.sql, bound.columns, where).items():
            counts[name] = counts.get(name, 0) + n
    most = max(counts, key=lambda name: counts[name], default=None)
    if most is None or not counts[most]:
        return "undefined there (NaN, infinite, or a division by zero); give a default by coalesce"
    return f"null because {most} is, in {counts[most]:,} rows; give a default: coalesce({most}, 0)"


def _null_counts(
    log: TypedLog, table: Table, sql: str, columns: tuple[str, ...], where: str
) -> dict[str, int]:
    if not columns:
        return {}
    undefined = f"TRY(CAST({sql} AS DOUBLE)) IS NULL"
    columns_asked = ", ".join(f"count(*) FILTER ({quoted(name)} IS NULL)" for name in columns)
    query = f"SELECT {columns_asked} FROM {table.sql} WHERE {undefined} AND ({where}\n)"
    (row,) = log.connection.sql(query).fetchall()
    return dict(zip(columns, row, strict=True))
