"""Report on what `prepare` read, dropped and kept, as a dictionary and as a text table."""

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Final

from ucfrec import schema
from ucfrec.errors import InputError, one_line
from ucfrec.logs.clean import DUPLICATES, REASONS, CleanLog
from ucfrec.logs.distributions import distributions
from ucfrec.logs.sessions import Cut

CONFLICT: Final = "duplicates with a different reward from the kept row"
"""Describes `conflicting_duplicates` of the report."""


def drop_counts(log: CleanLog) -> dict[str, int]:
    """Number of dropped rows for each of `ucfrec.logs.clean.REASONS`.

    Raises:
        InputError: every row is dropped.
    """
    counts = dict(
        log.connection.sql("SELECT reason, count(*) FROM rows GROUP BY reason").fetchall()
    )
    dropped = {reason: int(counts.get(reason, 0)) for reason in REASONS}
    if None not in counts:
        reasons = "; ".join(f"{n} rows: {REASONS[reason]}" for reason, n in dropped.items() if n)
        hint = "; is the time in milliseconds?" if dropped["clock_out_of_range"] else ""
        raise InputError(
            f"{_named(log)}: no row is left ({reasons}{hint}); correct the mapping or the log"
        )
    return dropped


def require_variety(log: CleanLog) -> None:
    """Check that the clean rows do not all have the same reward.

    Raises:
        InputError: all rewards are equal.
    """
    kept, low, high = log.one("SELECT count(*), min(reward), max(reward) FROM clean")
    if low == high:
        raise InputError(
            f"{_named(log)}: all {kept} rewards equal {low:g}, so there is nothing to learn; "
            "choose another reward expression"
        )


def _named(log: CleanLog) -> str:
    files = [str(file) for table in log.tables for file in table.files]
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return files[0] + more


def count_unsorted(log: CleanLog) -> int:
    """Number of rows that follow a later row of the same user in the files."""
    (unsorted,) = log.one(f"""
        SELECT count(*) FILTER (WHERE {schema.TIMESTAMP} < latest) FROM (
            SELECT {schema.TIMESTAMP}, max({schema.TIMESTAMP}) OVER (
                PARTITION BY {schema.USER_ID} ORDER BY row
                ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING
            ) AS latest FROM rows WHERE {schema.USER_ID} IS NOT NULL
        )
    """)
    return int(unsorted)


def build_report(log: CleanLog, cut: Cut, dropped: Mapping[str, int]) -> dict[str, Any]:
    """Counts and statistics of the tables `rows`, `clean` and `steps`, as JSON values.

    Times are in ms, `reward_statistics` in units of the reward; `summary` is of
    `ucfrec.logs.distributions`.

    Args:
        log: log with the table `steps`.
        cut: how its episodes were cut.
        dropped: result of `drop_counts`.
    """
    read, conflicts = log.one("SELECT count(*), count_if(conflict) FROM rows")
    (clean,) = log.one("SELECT count(*) FROM clean")
    steps, episodes, users, sessions, unfinished, first_ms, last_ms = log.one(f"""
        SELECT count(*), count_if(first), count(DISTINCT {schema.USER_ID}), count_if(starts),
            count_if(first AND NOT terminated), min({schema.TIMESTAMP}), max({schema.TIMESTAMP})
        FROM steps
    """)
    (censored,) = log.one(f"""
        SELECT count_if(NOT terminated) FROM (
            SELECT arg_max(terminated, episode) AS terminated FROM steps GROUP BY {schema.USER_ID}
        )
    """)
    mean, deviation, low, high = log.one(
        "SELECT avg(reward), stddev_pop(reward), min(reward), max(reward) FROM steps"
    )
    splits = {name: {"episodes": 0, "steps": 0} for name in schema.SPLITS}
    for split, in_split, rows in log.connection.sql(
        "SELECT split, count_if(first), count(*) FROM steps GROUP BY split"
    ).fetchall():
        splits[schema.SPLITS[split]] = {"episodes": in_split, "steps": rows}
    report = {
        "files": [str(file) for table in log.tables for file in table.files],
        "rows_read": read,
        "dropped": {**dropped, "short_episode": clean - steps},
        "conflicting_duplicates": conflicts,
        "unsorted_rows": count_unsorted(log),
        "steps": steps,
        "episodes": episodes,
        "sessions": sessions,
        "sessions_cut": unfinished - censored,
        "sessions_censored": censored,
        "return_length_share": _return_length_share(log),
        "users": users,
        "splits": splits,
        "session_by": cut.session_by,
        "session_gap_ms": cut.gap_ms if cut.session_by == "gap" else None,
        "split_times_ms": list(cut.bounds),
        "time_range_ms": [first_ms, last_ms],
        "summary": distributions(log),
        "reward_statistics": {"mean": mean, "std": deviation, "min": low, "max": high},
    }
    if log.key == schema.ITEM_ID:
        (report["items"],) = log.one(f"SELECT count(DISTINCT {schema.ITEM_ID}) FROM steps")
    if schema.PROPENSITY in log.columns:
        (report["unknown_propensities"],) = log.one(
            f"SELECT count_if({schema.PROPENSITY} IS NULL) FROM steps"
        )
    return report


def _return_length_share(log: CleanLog) -> float | None:
    """Share of the variance of training returns-to-go that the number of steps left explains.

    Of the whole rest of the session; None if either does not vary.
    """
    (correlation,) = log.one(f"""
        SELECT corr(rest, ahead) FROM (
            SELECT sum(reward) OVER w AS rest, count(*) OVER w AS ahead FROM steps
            WHERE split = 0
            WINDOW w AS (
                PARTITION BY {schema.USER_ID}, episode ORDER BY {schema.TIMESTAMP}
                ROWS BETWEEN CURRENT ROW AND UNBOUNDED FOLLOWING
            )
        )
    """)
    if correlation is None or not math.isfinite(correlation):
        return None
    return float(correlation**2)


def format_report(report: Mapping[str, Any]) -> str:
    """The report of `prepare` as a text table with one count per line."""
    reward = report["reward_statistics"]
    lines = [("rows read", f"{report['rows_read']:,} from {len(report['files'])} file(s)")]
    for reason, rows in report["dropped"].items():
        if rows:
            lines.append((f"  dropped: {reason}", f"{rows:,}  {REASONS.get(reason, '')}"))
    if report["conflicting_duplicates"]:
        kept = DUPLICATES[report.get("duplicates", "highest")][1]
        conflicts = f"{report['conflicting_duplicates']:,}  {CONFLICT}, which {kept}"
        lines.append(("  conflicting duplicates", conflicts))
    lines += [
        ("  out of order", f"{report['unsorted_rows']:,} (sorted, none dropped)"),
        ("steps kept", f"{report['steps']:,}"),
        ("users", f"{report['users']:,}"),
    ]
    if "items" in report:
        lines.append(("items", f"{report['items']:,}"))
    if report.get("unknown_propensities"):
        lines.append(("  unknown propensity", f"{report['unknown_propensities']:,}"))
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


def _returns_to_go(report: Mapping[str, Any]) -> str:
    text = f"{report['return_length_share']:.0%} of its variance is the number of steps left"
    if report["session_by"] != "user":
        return text
    return f"{text}, which is chance where sessions are users: policies learn the next step's"


def _clock(milliseconds: int) -> str:
    return datetime.fromtimestamp(milliseconds / 1000, UTC).strftime("%Y-%m-%d %H:%M:%S")
