"""Logs to episodes: Parquet and CSV files, cleaned, cut into sessions, written as a store.

One SQL pipeline on an embedded DuckDB, out of core: rows are read and judged (`log_clean`), fall
into sessions, and stream sorted into the store.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.files import atomic_folder
from ucfrec.items import write_item_states
from ucfrec.log_clean import CleanLog, engine, read_log
from ucfrec.log_features import encode_features, listed_ids
from ucfrec.log_files import explained, text
from ucfrec.log_mapping import LogMapping, log_files
from ucfrec.log_report import build_report
from ucfrec.store import EpisodeStore
from ucfrec.store_writer import StoreWriter

BATCH_ROWS: Final = 2**18
SESSIONS: Final = (schema.SESSION_ID, "gap", "user")
ITEMS_FILE: Final = "items.parquet"
USERS_FILE: Final = "users.parquet"


@dataclass(frozen=True)
class PrepareOptions:
    """How logs become episodes."""

    reward: str | None = None
    """Scalar SQL expression over the files' columns; None for the mapping's, or `reward`. Where a
    part of it is undefined (missing, NaN, infinite, division by zero), so is the reward, inside
    `least` and `greatest` too; `coalesce` gives a default."""
    session_by: str | None = None
    """"session_id", "gap" or "user" (one session each); None for the mapping's, or session_id where
    the log has one, or gap."""
    gap_minutes: float = 30.0
    """With "gap", a longer silence of the user ends the session."""
    min_steps: int = 1
    """Shorter episodes are dropped."""
    split: tuple[float, ...] = (0.8, 0.1, 0.1)
    """Three shares of the rows in order of time, or two times (ms) at which validation and test
    begin."""
    embedding_size: int = 32
    """Of items, at most."""
    memory_limit: str = "2GB"
    """Beyond it, rows spill to disk."""
    temp_folder: Path | None = None
    """Where rows spill; None for beside the store, or the system's when only checking."""

    def __post_init__(self) -> None:
        if self.session_by not in (None, *SESSIONS):
            raise InputError(f"session_by is {self.session_by!r}; use {', '.join(SESSIONS)}")
        if not self.gap_minutes > 0 or self.min_steps < 1 or self.embedding_size < 1:
            raise InputError("gap_minutes, min_steps and embedding_size are above 0")
        cuts = len(self.split) == 2 and self.split[0] <= self.split[1]
        shares = len(self.split) == 3 and min(self.split) >= 0 and self.split[0] > 0
        if not cuts and not (shares and abs(sum(self.split) - 1) < 1e-9):
            raise InputError(
                f"split is {self.split}: give three shares that add up to 1, the first above 0, or "
                "two times in order"
            )


def parse_split(given: str) -> tuple[float, ...]:
    """Read "0.8,0.1,0.1", or the two times "2022-04-28,2022-04-29T12:00" (UTC), as a split.

    Raises:
        InputError: it is neither.
    """
    parts = given.split(",")
    try:
        if len(parts) == 3:
            return tuple(float(part) for part in parts)
        times = [datetime.fromisoformat(part.strip()) for part in parts]
    except ValueError:
        times = []
    if len(times) != 2:
        raise InputError(f"split {given!r}: write shares as 0.8,0.1,0.1 or two times in ISO format")
    return tuple(t.replace(tzinfo=t.tzinfo or UTC).timestamp() * 1000 for t in times)


def prepare(
    paths: Sequence[str | Path], mapping: LogMapping, out: Path, options: PrepareOptions
) -> dict[str, Any]:
    """Write the logs as an `EpisodeStore` at `out`, whole or not at all.

    The store's users and items are those of the log and of the feature tables, in sorted order:
    rows of `users.parquet` (user_id) and `items.parquet` (item_id, train_count). A session that a
    boundary between splits falls into is cut there: its pieces are episodes, all but the last not
    terminated. Same rows, whatever their order, give the same fingerprint.

    Args:
        paths: log files, folders and globs.

    Returns:
        What was read, dropped and written; also in the store's `meta.json` under "source", and
        printed by `format_report`.

    Raises:
        InputError: the input cannot be used, `out` exists, or the disk is full.
    """
    files = log_files(paths)
    with atomic_folder(out) as folder, engine(options.memory_limit, folder) as (connection, work):
        pass
    raise NotImplementedError


def validate(
    paths: Sequence[str | Path], mapping: LogMapping, options: PrepareOptions
) -> dict[str, Any]:
    """Check the logs as `prepare` does, and write nothing.

    Returns:
        The report that `prepare` would give.

    Raises:
        InputError: the input cannot be used.
    """
    raise NotImplementedError
