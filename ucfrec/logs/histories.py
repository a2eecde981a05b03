"""The item history of each user of a log, from files or from a data frame."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.engine import engine, explain_errors, settle_mapping
from ucfrec.logs.mapping import KEY_COLUMNS, OPTIONAL_COLUMNS, LogMapping, log_files
from ucfrec.logs.rows import ITEM, SESSION, USER, sort_rows
from ucfrec.logs.summary import note_dropped, require_rows
from ucfrec.logs.tables import Table, quote_name
from ucfrec.logs.typed import LogTables, open_log, open_log_tables

if TYPE_CHECKING:
    import pandas as pd

    from ucfrec.episodes.item_table import IdLookup

HISTORIES = "histories"
"""Name of a data frame in messages and in the engine."""
_UNREAD = re.compile(
    r"\b(halffloat|month_day_nano_interval)(?!:)|\b(decimal256\(|run_end_encoded<|\w+_union<)"
    r"|extension<pandas\.|struct<>|dictionary<values=(\w*list<|fixed_size_list|struct<|map<)"
)
"""Types of Arrow that the engine or Parquet lacks."""


@dataclass(frozen=True)
class Histories:
    """Histories of U users: N rows, sorted by user and then by time."""

    users: Array
    """(U,) identifiers."""
    owner: IntArray
    """(N,) user index of each row, 0 to U − 1; sorted."""
    item_ids: Array
    """(N,) identifiers in the logs."""
    rewards: Float32Array
    """(N,) in reward units."""
    timestamps: IntArray
    """(N,) milliseconds."""
    session_ids: Array | None
    """(N,); None if sessions are not split by them."""
    seen_owner: IntArray
    """(M,) user index of each entry of `seen_ids`; sorted."""
    seen_ids: Array
    """(M,) identifiers of all items that a user has seen, also before the N rows."""
    observations: Float32Array | None
    """(U, O) last logged observation; None if the logs have none."""

    @classmethod
    def joined(cls, parts: Sequence["Histories"]) -> "Histories":
        """The users of all parts, one part after the other; all have sessions, or none."""
        if len(parts) == 1:
            return parts[0]
        firsts = np.cumsum([0, *(len(part.users) for part in parts[:-1])])
        columns: dict[str, Array | None] = {}
        for column in fields(cls):
            values = [getattr(part, column.name) for part in parts]
            if column.name in ("owner", "seen_owner"):
                values = [owners + first for owners, first in zip(values, firsts, strict=True)]
            columns[column.name] = None if values[0] is None else np.concatenate(values)
        return Histories(**columns)  # type: ignore[arg-type]

    def with_numbers(self, ids: "IdLookup", filter_seen: bool) -> "Histories":
        """The same with the numbers of the items in `ids`, −1 for unknown ones, and without
        `filter_seen` for all that were seen."""
        seen = ids.numbers(self.seen_ids) if filter_seen else np.full(len(self.seen_ids), -1)
        return replace(self, item_ids=ids.numbers(self.item_ids), seen_ids=seen)

    def latest_session(self, gap_ms: float | None, new: BoolArray | None = None) -> "Histories":
        """The same users with only the rows of each user's latest session.

        With `session_ids`, these are the rows with the session id of the user's last row. Without,
        the session begins after the last pause of more than `gap_ms` milliseconds, or with the
        user's first row if `gap_ms` is None. That of users who begin a `new` one (U,) has no rows.
        """
        if new is not None and new.any():
            return self.with_rows(~new[self.owner]).latest_session(gap_ms)
        row = np.arange(len(self.owner))
        latest = np.zeros(len(self.users), dtype=np.int64)
        if self.session_ids is not None:
            # Of repeated indices, the last assignment remains: each user's last row.
            latest[self.owner] = row
            return self.with_rows(self.session_ids == self.session_ids[latest[self.owner]])
        if gap_ms is None:
            return self
        begins = np.zeros(len(self.owner), dtype=np.int64)
        begins[1:] = (np.diff(self.owner) > 0) | (np.diff(self.timestamps) > gap_ms)
        np.maximum.at(latest, self.owner, row * begins)
        return self.with_rows(row >= latest[self.owner])

    def of_users(self, numbers: IntArray) -> "Histories":
        """The users with the given numbers (M,), in that order."""
        owner, rows = _find_rows(self.owner, numbers)
        seen_owner, seen = _find_rows(self.seen_owner, numbers)
        return replace(
            self.with_rows(rows),
            users=self.users[numbers],
            owner=owner,
            seen_owner=seen_owner,
            seen_ids=self.seen_ids[seen],
            observations=None if self.observations is None else self.observations[numbers],
        )

    def with_rows(self, rows: BoolArray | IntArray) -> "Histories":
        """The same users with only some rows: their numbers, or (N,) true for them."""
        names = ("owner", "item_ids", "rewards", "timestamps", "session_ids")
        columns = ((name, getattr(self, name)) for name in names)
        return replace(self, **{n: column[rows] for n, column in columns if column is not None})


def _find_rows(owner: IntArray, numbers: IntArray) -> tuple[IntArray, IntArray]:
    """Of rows of users `numbers` (M,), by user: the user's place, the index in sorted `owner`."""
    starts, ends = (np.searchsorted(owner, numbers, side=side) for side in ("left", "right"))
    lengths = ends - starts
    place = np.repeat(np.arange(len(numbers)), lengths)
    return place, np.arange(len(place)) + (ends - np.cumsum(lengths))[place]


@dataclass(frozen=True)
class FrameTable(Table):
    """A data frame or Arrow table registered with the engine; `files` holds its name."""

    @property
    def columnar(self) -> bool:
        return True

    @property
    def source(self) -> str:
        return quote_name(str(self.files[0]))


def read_histories(
    paths: Sequence[str | Path],
    mapping: LogMapping,
    reward: str,
    last: int,
    memory_limit: str = "2GB",
    session_by: str = "user",
    duplicates: str = "highest",
) -> Iterator[Histories]:
    """Read the most recent rows, at most `last`, of each user of a log, cleaned as `prepare` cleans
    it, with a warning; yields batches of users in sorted order.

    Of `PrepareOptions` are `memory_limit` and `duplicates`; with `session_by` "session_id", batches
    have `session_ids`, equal where the session is. Raises InputError if the input cannot be used.
    """
    files = log_files(paths)
    with (
        scratch_folder(Path(gettempdir()), "histories") as folder,
        engine(files, folder, memory_limit) as connection,
    ):
        tables = open_log_tables(connection, files, mapping, reward, session_by)
        yield from _read_users(tables, last, duplicates, folder)


def frame_histories(
    frame: "pd.DataFrame",
    mapping: LogMapping,
    reward: str,
    last: int,
    session_by: str = "user",
    duplicates: str = "highest",
) -> Iterator[Histories]:
    """`read_histories` of a log in memory, without the disk; InputError as of `log_table`, too."""
    columns = log_table(frame, HISTORIES, mapping, reward)
    with engine((), None) as connection:
        connection.register(HISTORIES, columns)
        relation = connection.table(HISTORIES)
        types = zip(relation.columns, map(str, relation.types), strict=True)
        table = FrameTable((Path(HISTORIES),), tuple(types))
        mapping, reward = settle_mapping(connection, (table,), mapping, reward)
        tables = LogTables(connection, (table,), mapping, reward, session_by)
        yield from _read_users(tables, last, duplicates, None)


def log_table(
    frame: "pd.DataFrame",
    name: str,
    mapping: LogMapping,
    reward: str | None,
) -> pa.Table:
    """Convert a data frame to Arrow without the columns that it cannot hold.

    Raises InputError if `frame` is not a data frame or has no rows, two columns have the same name,
    or the mapping or the reward (None for that of the mapping) reads a column that is left out.
    """
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise InputError(
            f"{name}: a {type(frame).__name__} is not a pandas DataFrame; give one with one row "
            "per interaction"
        )
    if frame.empty:
        raise InputError(f"{name}: the frame has no rows; give one row per interaction")
    names = Counter(str(column).casefold() for column in frame.columns)
    if twice := [column for column, n in names.items() if n > 1]:
        raise InputError(
            f"{name}: two columns are called {', '.join(twice)} (case does not count); rename one"
        )
    columns, texts = {}, reward or mapping.reward or schema.REWARD
    for part in (mapping, mapping.remembered or mapping):
        mapped = (part.columns.get(n, n) for n in (*KEY_COLUMNS, *OPTIONAL_COLUMNS))
        texts = " ".join([texts, part.where or "", *mapped])
    for column in frame.columns:
        array = _convert_column(frame[column])
        if not isinstance(array, str):
            columns[str(column)] = array
        elif re.search(rf"(?<!\w){re.escape(str(column))}(?!\w)", texts, re.IGNORECASE):
            raise InputError(f"{name}: {column} {array}")
    return pa.table(columns)


def _convert_column(values: "pd.Series[Any]") -> pa.Array | str:
    """A column of a data frame, or why it cannot be read and what to do."""
    import pandas as pd

    if isinstance(values.dtype, pd.PeriodDtype):
        return "holds periods; convert them with .dt.to_timestamp()"
    try:
        array = pa.Array.from_pandas(values)
    except OverflowError:
        return "holds whole numbers of more than 64 bits; convert them with .astype(str)"
    except (TypeError, ValueError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        return f"holds values of several types ({reason}); make them one"
    if pa.types.is_duration(array.type):
        return "holds durations; convert them with .dt.total_seconds()"
    dates = values.dtype == object and pa.types.is_date(array.type)
    if dates and any(isinstance(value, datetime) for value in values):
        # Arrow would cut off the time of day.
        return "holds dates and times; convert them with pandas.to_datetime"
    if pa.types.is_float16(array.type):
        return array.cast(pa.float32())
    if _UNREAD.search(str(array.type)):
        return f"is of type {array.type}, which is not read; convert it"
    return array


def _read_users(
    tables: LogTables,
    last: int,
    duplicates: str,
    folder: Path | None,
) -> Iterator[Histories]:
    """The users of a log, some thousand rows at a time; `folder` for scratch, None for memory."""
    log = open_log(tables)
    log.require_items()
    by_session = log.session_by == schema.SESSION_ID
    with explain_errors(log.connection, log.tables):
        sorted_rows = sort_rows(log, None, duplicates, folder)
        observations = sorted_rows.observations
        require_rows(log, sorted_rows.count, sorted_rows.dropped)
        note_dropped(log.name, sorted_rows.dropped, sorted_rows.read)
        query = f"SELECT {schema.ITEM_ID} FROM item_codes ORDER BY code"
        items = np.asarray(log.connection.sql(query).to_arrow_table().column(0))
        for rows in sorted_rows.file.read():
            codes = rows[USER]
            query = (
                f"SELECT {schema.USER_ID} FROM user_codes WHERE code BETWEEN {codes[0]} AND "
                f"{codes[-1]} ORDER BY code"
            )
            users = np.asarray(log.connection.sql(query).to_arrow_table().column(0))
            first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
            ends = np.append(first[1:], len(codes))
            owner = np.repeat(np.arange(len(first)), ends - first)
            recent = ends[owner] - np.arange(len(codes)) <= last
            # Codes of items are in the order of their ids.
            seen_owner, seen = np.divmod(np.unique(owner * len(items) + rows[ITEM]), len(items))
            newest = rows["row"][ends - 1]
            yield Histories(
                users=users[codes[first].astype(np.int64) - codes[0]],
                owner=owner[recent],
                item_ids=items[rows[ITEM][recent]],
                rewards=rows[schema.REWARD][recent].astype(np.float32),
                timestamps=rows[schema.TIMESTAMP][recent].astype(np.int64),
                session_ids=rows[SESSION][recent] if by_session else None,
                seen_owner=seen_owner,
                seen_ids=items[seen],
                observations=None if observations is None else observations.read(newest),
            )
