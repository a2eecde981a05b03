"""Warnings about a log whose owner would want to know: rows that are lost, times, and bots."""

import re
import warnings
from typing import Final

import numpy as np

from ucfrec import schema
from ucfrec.episodes.long_sessions import LONG
from ucfrec.errors import InputNote
from ucfrec.logs.binding import bind
from ucfrec.logs.clean import CLOCK_HINT, REASONS
from ucfrec.logs.measures import Measures
from ucfrec.logs.sorted_rows import CODES, SortedRows, has_codes
from ucfrec.logs.tables import Table, quoted, text
from ucfrec.logs.typed import ROWS, TypedLog

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
    """Warn of more than a fifth of the rows dropped for one reason.

    Args:
        rows: of the log; its connection is free.
        reward: the reward expression.
        where: condition of the rows that are wanted at all.
    """
    wanted = rows.read - rows.dropped["left_out"]
    for reason, n in rows.dropped.items():
        if n <= MANY * wanted or reason == "left_out":
            continue
        share = f"{n:,} of {wanted:,} rows ({n / wanted:.0%}) are dropped"
        if reason == "reward_not_finite":
            why = _missing(rows.log, reward, where or "true")
            _note(rows, f"{share}: the reward {reward} is {why}")
            continue
        which = _missing_key(rows.log) if reason == "null_key" else ""
        _note(rows, f"{share}: {REASONS[reason]}{which}; {_REMEDIES[reason]}")


def note_equal_times(rows: SortedRows) -> None:
    """Warn of a log in which many rows share their user and time."""
    if rows.tied > MANY * len(rows.clean):
        _note(
            rows,
            f"{rows.tied / len(rows.clean):.0%} of the rows share their time with another row of "
            "the user, so their order is unknown and is not learned; log finer times if there are "
            "any",
        )


def note_bots(rows: SortedRows, measures: Measures, user: str) -> None:
    """Warn of sessions that are much longer than most.

    Args:
        rows: of the log; its connection is free.
        measures: of its episodes.
        user: expression over the columns of the files that gives the users.
    """
    lengths = np.array(sorted(measures.lengths))
    counts = np.cumsum([measures.lengths[int(length)] for length in lengths])
    median = int(lengths[np.searchsorted(counts, counts[-1] / 2)])
    if measures.longest[0][0] <= LONG * median:
        return
    names = _user_ids(rows.log, [code for _, code in measures.longest])
    found = [
        (name, steps)
        for (steps, _), name in zip(measures.longest, names, strict=True)
        if steps > LONG * median
    ]
    named = ", ".join(f"{name} ({steps:,} rows)" for name, steps in found)
    users = ", ".join(str(n) if isinstance(n, int) else text(str(n)) for n, _ in found)
    if not re.fullmatch(r"[\w' ,:@.-]*", users):
        users = "…"  # what a shell would take for a program is not proposed
    _note(
        rows,
        f"the median session has {median:,} row{'s' * (median > 1)}, but these users have sessions "
        f"of more than {LONG} times that, as bots have: {named}; leave them out with "
        f'--where "{user} NOT IN ({users})" or --max-session {LONG * median}',
    )


def _note(rows: SortedRows, message: str) -> None:
    warnings.warn(f"{rows.log.name}: {message}", InputNote, stacklevel=3)


def _missing_key(log: TypedLog) -> str:
    names = [schema.USER_ID, log.key, schema.TIMESTAMP]
    names += [schema.SESSION_ID] if log.session_by == schema.SESSION_ID else []
    asked = ", ".join(f"count_if({name} IS NULL)" for name in names)
    counts = log.one(f"SELECT {asked} FROM {ROWS}")
    found = [f"{name} in {n:,}" for name, n in zip(names, counts, strict=True) if n]
    return f" ({', '.join(found)})"


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
    asked = ", ".join(f"count_if({quoted(name)} IS NULL)" for name in columns)
    query = f"SELECT {asked} FROM {table.sql} WHERE {undefined} AND ({where}\n)"
    (row,) = log.connection.sql(query).fetchall()
    return dict(zip(columns, row, strict=True))


def _user_ids(log: TypedLog, codes: list[int]) -> list[object]:
    if not has_codes(log, schema.USER_ID):
        return list(codes)
    wanted = ", ".join(map(str, codes))
    table = CODES[schema.USER_ID]
    query = f"SELECT code, {schema.USER_ID} FROM {table} WHERE code IN ({wanted})"
    found = dict(log.connection.sql(query).fetchall())
    return [found[code] for code in codes]
