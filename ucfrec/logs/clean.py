"""Why rows of a log are dropped: the faults that SQL finds, and what must be left."""

import time
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.tables import glob_pattern, text
from ucfrec.logs.typed import WANTED, TypedLog, not_finite

DAY_MS: Final = 86_400_000
"""One day in ms."""

REASONS: Final = {
    "left_out": "does not fulfil --where",
    "null_key": "user, item or action, time or session is missing",
    "clock_out_of_range": "time before 2000 (or --earliest, or the end of an updated store) or "
    "more than a day ahead of now",
    "vector_not_finite": "action is missing or holds NaN or infinity",
    "unknown_item": "item is not in the store",
    "duplicate": "repeats user, item or action, and time of another row, which is kept",
    "reward_not_finite": "reward is missing, NaN or infinite",
}
"""Reason to its description; a row is dropped for the first reason that applies."""

_FINE: Final = ("duplicate", "left_out")
CLOCK_HINT: Final = (
    "is the time in milliseconds? Seconds are read with --column timestamp='COLUMN * 1000'; "
    "for older times, say --earliest 1990-01-01, or earliest in the mapping"
)


def faults(log: TypedLog, known_items: Path | None = None) -> dict[str, str]:
    """Reason to the SQL condition on a row of `read`; the first that holds counts.

    Args:
        known_items: `items.parquet` of a store: other items are a fault; None for none.
    """
    keys = [schema.USER_ID, log.key, schema.TIMESTAMP]
    keys += [schema.SESSION_ID] if log.session_by == schema.SESSION_ID else []
    latest = int(time.time() * 1000) + DAY_MS
    conditions = {"left_out": f"NOT {WANTED}"} if log.has_condition else {}
    conditions |= {
        "null_key": " OR ".join(f"{k} IS NULL" for k in keys if k != schema.ACTION),
        "clock_out_of_range": f"{schema.TIMESTAMP} NOT BETWEEN {log.earliest_ms} AND {latest}",
    }
    if schema.ACTION in log.vector_size:
        conditions["vector_not_finite"] = not_finite(schema.ACTION)
    if known_items is not None:
        source = f"read_parquet({text(glob_pattern(known_items))}, hive_partitioning = false)"
        known = f"SELECT CAST(item_id AS VARCHAR) FROM {source}"
        conditions["unknown_item"] = f"CAST({log.key} AS VARCHAR) NOT IN ({known})"
    return conditions


def require_rewards_in_range(log: TypedLog, large: int, rows: int, largest: float) -> None:
    """Check the count of rewards beyond `LARGEST_REWARD`.

    Raises:
        InputError: there are any.
    """
    if large:
        raise InputError(
            f"{log.tables[0].files[0]}: {large:,} of {rows:,} rewards are beyond "
            f"±{schema.LARGEST_REWARD:g} (up to {largest:.3g}), too large to train with in "
            "float32; divide them in the reward expression"
        )


def note_dropped(
    name: str, dropped: Mapping[str, int], read: int, fine: Collection[str] = _FINE
) -> None:
    """Warn of the rows that are left out, with their numbers and reasons; silent if none is.

    Args:
        name: of the data, for the message; empty for none.
        fine: reasons that need no warning of their own.
    """
    counts = {reason: n for reason, n in dropped.items() if n}
    if not counts.keys() - {*fine}:
        return
    total = sum(counts.values())
    reasons = "; ".join(f"{n:,}: {REASONS.get(reason, reason)}" for reason, n in counts.items())
    hint = f"; {CLOCK_HINT}" if "clock_out_of_range" in counts else ""
    origin = f"{name}: " if name else ""
    warnings.warn(
        f"{origin}{total:,} of {read:,} rows were excluded ({reasons}{hint})",
        InputNote,
        stacklevel=3,
    )


class NoRowsError(InputError):
    """No row of a log can be used."""


def require_rows(log: TypedLog, kept: int, dropped: Mapping[str, int]) -> None:
    """Check that a row is left.

    Raises:
        NoRowsError: none is.
    """
    if kept == 0:
        reasons = "; ".join(f"{n} rows: {REASONS[reason]}" for reason, n in dropped.items() if n)
        hint = f"; {CLOCK_HINT}" if dropped["clock_out_of_range"] else ""
        raise NoRowsError(
            f"{log.name}: no row is left ({reasons}{hint}); correct the mapping or the log"
        )
