"""Report on what was read of a log, dropped and kept, and warnings that its owner would want."""

import re
from collections import Counter
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ucfrec import schema
from ucfrec.episodes.record import LONG
from ucfrec.errors import InputError, one_line, warn_user
from ucfrec.files.remote import origin
from ucfrec.logs.engine import bind
from ucfrec.logs.mapping import EARLIEST_MS
from ucfrec.logs.rows import REASONS, SortedRows
from ucfrec.logs.sessions import EPISODES, USED_USERS, Cut, StepCounts
from ucfrec.logs.tables import quote, quote_name
from ucfrec.logs.typed import ROWS, WANTED, TypedLog

MANY = 0.2
"""Share of faulty rows above which there is a warning."""
FEW_IDS = 20
MOST_UNKNOWN = 0.9
"""Share of unknown users or items, of `FEW_IDS` or more, from which on there is a warning."""
_CLOCK_HINT = (
    "is the time in milliseconds? Seconds are read with --column timestamp='COLUMN * 1000', "
    "microseconds with 'COLUMN / 1000', nanoseconds with 'COLUMN / 1000000', times such as "
    "20260131 with --time-format; for older times, say --earliest 1990-01-01, or earliest in the "
    "mapping"
)
_REMEDIES = {
    "null_key": "fill it in, or map another column",
    "clock_out_of_range": _CLOCK_HINT,
    "vector_not_finite": "correct the actions",
    "unknown_item": "bring the run up to date, or leave those rows out",
    "duplicate": "log finer times, or remove the repetitions",
}


def build_report(rows: SortedRows, cut: Cut, counts: StepCounts) -> dict[str, Any]:
    """Counts and statistics of a log, as JSON values; times are in ms."""
    log = rows.log
    splits = {name: {"episodes": 0, "steps": 0} for name in schema.SPLITS}
    for split, episodes, steps in log.connection.sql(
        f"SELECT split, count(*), CAST(sum(steps) AS BIGINT) FROM {EPISODES} GROUP BY split"
    ).fetchall():
        splits[schema.SPLITS[split]] = {"episodes": episodes, "steps": steps}
    sessions, unfinished = log.one(
        f"SELECT count(*) FILTER (begins_session), count(*) FILTER (NOT terminated) FROM {EPISODES}"
    )
    users, censored = log.one(f"SELECT count(*), count(*) FILTER (NOT ended) FROM {USED_USERS}")
    (return_to_go, both), (_, ahead) = counts.returns.covariance
    # What is left of the rounding errors of equal returns is not variance.
    varies = return_to_go > 1e-24 * counts.returns.mean[0] ** 2 and ahead
    report: dict[str, Any] = {
        "files": [origin(file) for table in log.tables for file in table.files],
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
        "split_times_ms": None if cut.leave_last else list(cut.bounds),
        "steps": counts.steps,
        "decisions": counts.decisions if counts.decisions < counts.steps else None,
        "episodes": sum(split["episodes"] for split in splits.values()),
        "sessions": sessions,
        "sessions_beyond_a_day": counts.beyond_a_day,
        "sessions_cut": unfinished - censored,
        "sessions_censored": censored,
        "return_length_share": float(both**2 / (return_to_go * ahead)) if varies else None,
        "users": users,
        "splits": splits,
        "time_range_ms": [counts.first_ms, counts.last_ms],
        "reward_statistics": {
            "mean": float(counts.rewards.mean[0]),
            "std": float(np.sqrt(counts.rewards.covariance[0, 0])),
            "min": counts.rewards.lowest[0],
            "max": counts.rewards.highest[0],
        },
    }
    if log.key == schema.ITEM_ID:
        report["items"] = int(np.count_nonzero(counts.item_steps))
    if schema.PROPENSITY in log.columns:
        report["unknown_propensities"] = counts.unknown_propensities
    return report


def format_report(report: Mapping[str, Any]) -> str:
    """The report of `prepare` as a text table with one count per line."""
    rule, session_by = report.get("duplicates", "highest"), report["session_by"]
    steps, decisions = report["steps"], report.get("decisions")
    lists = decisions and decisions < 0.9 * steps  # a few rows at one time are none
    counts = [
        (f"  dropped: {reason}", rows, f"  {REASONS.get(reason, '')}")
        for reason, rows in report["dropped"].items()
    ]
    conflicts = f"  duplicates with a different reward from the kept row, the {rule}"
    counts += [
        ("  conflicting duplicates", report["conflicting_duplicates"], conflicts),
        ("  at equal times", report["equal_times"], " (lists, or in no order to learn)"),
        ("  out of order", report["unsorted_rows"], " (sorted, none dropped)"),
        ("steps kept", steps, f" in {decisions:,} decisions" if lists else ""),
        ("users", report["users"], ""),
        ("items", report.get("items"), ""),
        ("  unknown propensity", report.get("unknown_propensities"), "  missing, NaN or infinite"),
        ("sessions", report["sessions"], f" by {session_by}"),
        ("  cut at a split", report["sessions_cut"], ""),
        ("  censored", report.get("sessions_censored"), "  may have gone on after the log ended"),
    ]
    lines = [("rows read", f"{report['rows_read']:,} from {len(report['files'])} file(s)")]
    lines += [(label, f"{n:,}{text}") for label, n, text in counts if n or "out of" in label]
    lines += [
        (f"  {name}", f"{count['episodes']:,} episodes, {count['steps']:,} steps")
        for name, count in report["splits"].items()
    ]
    lines += [
        (f"{name} features", f"{', '.join(f'{n} {kind}' for kind, n in kinds.items())} from {file}")
        for name, tables in report.get("feature_tables", {}).items()
        for file, kinds in tables.items()
    ]
    lines.append(("times (UTC)", " to ".join(_clock(t) for t in report["time_range_ms"])))
    if (share := report.get("return_length_share")) is not None:
        ahead = f"{share:.0%} of its variance is the number of steps left"
        if session_by == "user":
            ahead += ", which is random where sessions are users: policies learn the next step's"
        lines.append(("return-to-go", ahead))
    statistics = report["reward_statistics"].items()
    figures = ", ".join(f"{name} {value:.4g}" for name, value in statistics)
    lines.append(("reward", f"{report['reward']}: {figures}"))
    width = max(len(name) for name, _ in lines) + 2
    return "\n".join(one_line(f"{name:<{width}}{value}").rstrip() for name, value in lines)


def format_summary(report: Mapping[str, Any]) -> str:
    """What was read and dropped, in two lines, where logs are only evaluated on."""
    dropped = [f"{rows:,} {reason}" for reason, rows in report["dropped"].items() if rows]
    begin, end = (_clock(time) for time in report["time_range_ms"])
    return (
        f"{report['rows_read']:,} rows read, {report['steps']:,} kept: {report['sessions']:,} "
        f"sessions of {report['users']:,} users, {begin} to {end} UTC\n"
        f"dropped: {', '.join(dropped) or 'none'}"
    )


def _clock(milliseconds: int) -> str:
    return datetime.fromtimestamp(milliseconds / 1000, UTC).strftime("%Y-%m-%d %H:%M:%S")


class NoRowsError(InputError):
    """No row of a log can be used."""


def require_rows(
    log: TypedLog,
    count: int,
    dropped: Mapping[str, int],
    grown: Path | None = None,
) -> None:
    """Raise NoRowsError if no row is left, of a log that is perhaps added to a store, `grown`,
    whose end is the earliest time."""
    if count:
        return
    n_wanted, late = sum(dropped.values()) - dropped["left_out"], dropped["clock_out_of_range"]
    if grown is not None and 0 < n_wanted == late + dropped["duplicate"]:
        not_newer = f"{schema.TIMESTAMP} BETWEEN {EARLIEST_MS} AND {log.mapping.earliest_ms - 1}"
        # Times before 2000 or in the future have another cause, such as seconds for milliseconds.
        if log.one(f"SELECT count(*) FROM {ROWS} WHERE {not_newer}")[0] >= late:
            raise NoRowsError(
                f"{log.name}: all {n_wanted:,} rows are not newer than {grown}, whose last row is "
                f"of {_clock(log.mapping.earliest_ms - 1)} UTC; give newer logs"
            )
    reasons = "; ".join(f"{n} rows: {REASONS[reason]}" for reason, n in dropped.items() if n)
    hint = f"; {_CLOCK_HINT}" if late else ""
    raise NoRowsError(
        f"{log.name}: no row is left ({reasons}{hint}); correct the mapping or the log"
    )


def note_dropped(
    name: str,
    dropped: Mapping[str, int],
    n_read: int,
    fine: Collection[str] = ("duplicate", "left_out", "not_before"),
) -> None:
    """Warn of dropped rows of data (`name`, or empty) and the reasons, unless all are `fine`."""
    counts = {reason: n for reason, n in dropped.items() if n}
    if not counts.keys() - {*fine}:
        return
    reasons = "; ".join(f"{n:,}: {REASONS.get(reason, reason)}" for reason, n in counts.items())
    hint = f"; {_CLOCK_HINT}" if "clock_out_of_range" in counts else ""
    total = f"{sum(counts.values()):,} of {n_read:,} rows were excluded ({reasons}{hint})"
    warn_user(f"{name}: {total}" if name else total)


def note_unknown(
    name: str,
    column: str,
    unknown: int,
    total: int,
    known_ids: str,
) -> None:
    """Warn if nearly all of many ids of a log are not `known_ids`, as if written in another way."""
    if total < FEW_IDS or unknown < MOST_UNKNOWN * total:
        return
    ids = column.removesuffix("_id") + "s"
    warn_user(
        f"{name}: {unknown:,} of {total:,} {ids} are not among those {known_ids}; if they "
        f"should be, compare how {column} is written"
    )


def note_losses(rows: SortedRows, reward: str, where: str | None, new: bool, grows: bool) -> None:
    """Warn of reasons that drop over a fifth of the rows, undefined `where`, and equal rewards."""
    log = rows.log
    if new and rows.lowest == rows.highest:
        _note(
            rows,
            f"all {rows.count:,} rewards equal {rows.lowest:g}: policies learn what users choose "
            "next, not what rewards them; for that, choose another reward expression",
        )
    if where is not None and rows.dropped["left_out"]:
        note_undefined(log, where)
    n_wanted = rows.read - rows.dropped["left_out"]
    for reason, n in rows.dropped.items():
        if n <= MANY * n_wanted or reason in ("left_out", "clock_out_of_range" if grows else ""):
            continue
        why = f"{REASONS[reason]}; {_REMEDIES.get(reason)}"
        if reason == "reward_not_finite":
            why = f"the reward {reward} is {_explain_missing(log, reward, where)}"
        elif reason == "null_key":
            aggregates = ", ".join(f"count(*) FILTER ({name} IS NULL)" for name in log.required)
            counts = zip(log.required, log.one(f"SELECT {aggregates} FROM {ROWS}"), strict=True)
            missing = ", ".join(f"{name} in {count:,}" for name, count in counts if count)
            why = f"{REASONS[reason]} ({missing}); {_REMEDIES[reason]}"
        _note(rows, f"{n:,} of {n_wanted:,} rows ({n / n_wanted:.0%}) are dropped: {why}")


def _explain_missing(log: TypedLog, reward: str, where: str | None) -> str:
    """Why the reward is undefined, and what to do."""
    counts = Counter[str]()
    for table in log.tables:
        bound = bind(log.connection, table, "for the reward", reward)
        aggregates = ["count(*)", *(f"count(*) - count({quote_name(n)})" for n in bound.columns)]
        undefined = f"TRY(CAST({bound.sql} AS DOUBLE)) IS NULL"
        if where is not None:
            undefined += f" AND TRY({bind(log.connection, table, 'for --where', where).sql})"
        (_, *nulls) = log.one(f"SELECT {', '.join(aggregates)} FROM {table.sql} WHERE {undefined}")
        for name, n in zip(bound.columns, nulls, strict=True):
            counts[name] += n
    for most, n in counts.most_common(1):
        if n:
            return f"null because {most} is, in {n:,} rows; give a default: coalesce({most}, 0)"
    return "undefined there (NaN, infinite, or a division by zero); give a default by coalesce"


def note_undefined(log: TypedLog, where: str, rows: str = ROWS) -> None:
    """Warn of rows (SQL) in which a condition is neither true nor false: they are excluded, too."""
    undefined, count = log.one(f"SELECT count(*) - count({WANTED}), count(*) FROM {rows}")
    if undefined:
        warn_user(
            f"{log.name}: the condition {where} is neither true nor false in {undefined:,} of "
            f"{count:,} rows, as a column is missing there, and these are excluded; to keep them, "
            "write IS DISTINCT FROM for <>, or coalesce(…, true) around the condition"
        )


def note_oddities(rows: SortedRows, report: Mapping[str, Any], is_new: bool) -> None:
    """Warn of many equal times, one item only, parts of sessions, and sessions that seem odd."""
    user = rows.log.mapping.columns.get(schema.USER_ID, schema.USER_ID)
    if rows.tied > MANY * rows.count and schema.POSITION not in rows.log.columns:
        _note(
            rows,
            f"{rows.tied / rows.count:.0%} of the rows share their time with another row of "
            "the user: they count as one list, whose order is unknown and is not learned; log "
            "finer times, or columns request_id and position",
        )
    if count := rows.repeated_positions:
        what = "rows repeat a position of their list and count as another one"
        _note(rows, f"{count:,} {what}; give every list a request_id of its own")
    if rows.dropped["left_out"] and (count := _count_cuts(rows.log, report["session_gap_ms"])):
        what = "rows that are left out are inside of sessions, whose states and returns lack them"
        _note(rows, f"{count:,} {what}; if users saw them, leave out whole sessions or users")
    count, episodes = report["sessions_beyond_a_day"], report["episodes"]
    if report["session_by"] == schema.SESSION_ID and count > MANY * episodes:
        what = "sessions last longer than a day, as where ids come again"
        _note(rows, f"{count:,} of {episodes:,} {what}; give each an id of its own")
    if report.get("items") == 1:
        what = f"all {report['steps']:,} rows show the same item, so there is nothing to choose"
        _note(rows, f"{what} between; check --column item_id and --where")
    of_user, of_session = (report["steps"] / report[name] for name in ("users", "sessions"))
    if is_new and of_user > 2 * of_session and of_session < 2:
        what = f"users have {of_user:.1f} rows, but sessions {of_session:.1f}, and policies do not"
        _note(rows, f"{what} see earlier ones; for ratings or purchases, say --session-by user")
    # Of training, because held-out episodes may be the last row of each user.
    (median,) = rows.log.one(f"SELECT quantile_disc(steps, 0.5) FROM {EPISODES} WHERE split = 0")
    longest = rows.log.connection.sql(
        f"SELECT {schema.USER_ID}, longest FROM {USED_USERS} WHERE longest > {LONG * median} "
        "ORDER BY longest DESC, code DESC LIMIT 5"
    ).fetchall()
    if longest:
        bots = ", ".join(f"{name} ({steps:,} rows)" for name, steps in longest)
        users = ", ".join(str(n) if isinstance(n, int) else quote(str(n)) for n, _ in longest)
        if not re.fullmatch(r"[\w' ,:@.-]*", users):
            users = "…"  # what a shell would take for a program is not proposed
        _note(
            rows,
            f"the median session has {median:,} row{'s' * (median > 1)}, but these users have "
            f"sessions of more than {LONG} times that, as bots have: {bots}; leave them out with "
            f'--where "{user} NOT IN ({users})" or --max-session {LONG * median}',
        )


def _count_cuts(log: TypedLog, gap_ms: int | None) -> int:
    """Number of rows left out at the time of another row of the session, or between two."""
    by_session = log.session_by == schema.SESSION_ID
    keys = f"{schema.USER_ID}, {schema.SESSION_ID}" if by_session else schema.USER_ID
    within = "following IS NOT NULL" if gap_ms is None else f"following - since <= {gap_ms}"
    query = (
        f"SELECT count(*) FROM (FROM {ROWS} WHERE {WANTED} IS NOT TRUE) ASOF JOIN ("
        f"SELECT {keys}, timestamp, timestamp AS since, lead(timestamp) OVER (PARTITION BY {keys} "
        f"ORDER BY timestamp) AS following FROM {ROWS} WHERE {WANTED}) "
        f"USING ({keys}, timestamp) WHERE timestamp = since OR {within}"
    )
    return int(log.one(query)[0])


def _note(rows: SortedRows, message: str) -> None:
    warn_user(f"{rows.log.name}: {message}")
