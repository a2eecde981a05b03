"""The item history of each user of a log, from files or from a data frame."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError, warn_user
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.engine import engine, explain_errors, settle_mapping, to_arrow
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.rows import ITEM, SESSION, USER, SortedRows, sort_rows
from ucfrec.logs.summary import note_dropped, require_rows
from ucfrec.logs.tables import Table, quote_name
from ucfrec.logs.typed import LogTables, open_log, open_log_tables

if TYPE_CHECKING:
    import pandas as pd


HISTORIES: Final = "histories"
"""Name of a data frame in messages and in the engine."""
_UNREAD: Final = (
    pa.types.is_float16,
    pa.types.is_decimal256,
    pa.types.is_interval,
    pa.types.is_run_end_encoded,
    pa.types.is_union,
)
"""Types of Arrow that the engine or Parquet lacks."""


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
) -> Iterator[pa.RecordBatch]:
    """Read the history of each user of a log, cleaned as `prepare` cleans it, with a warning.

    Args:
        last: most rows of each user, the most recent ones.
        memory_limit: as of `PrepareOptions`, and so is `duplicates`.
        session_by: with "session_id", batches have the column `session_ids`.

    Yields:
        Batches of users in sorted order: `user_id`; `item_ids`, `rewards` (float32), `timestamps`
        (ms) and perhaps `session_ids`, equal where the session is, lists of at most `last` with the
        most recent last; `seen`, all item ids of the user, sorted; and, if the log has it, the most
        recent `observation`.

    Raises:
        InputError: the input cannot be used.
    """
    files = log_files(paths)
    with (
        scratch_folder(Path(gettempdir()), "histories") as folder,
        engine(files, folder, memory_limit, shared=True) as connection,
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
) -> Iterator[pa.RecordBatch]:
    """`read_histories` of a log in memory, without using the disk; InputError as of `log_table`,
    too."""
    columns = log_table(frame, HISTORIES)
    with engine((), None) as connection:
        connection.register(HISTORIES, columns)
        described = connection.sql(f"DESCRIBE {HISTORIES}").fetchall()
        table = FrameTable((Path(HISTORIES),), tuple((row[0], row[1]) for row in described))
        mapping, reward = settle_mapping(connection, (table,), mapping, reward)
        tables = LogTables(connection, (table,), mapping, reward, session_by)
        yield from _read_users(tables, last, duplicates, None)


def log_table(frame: "pd.DataFrame", name: str) -> pa.Table:
    """Convert a data frame to Arrow, leaving out, with a note, columns that it cannot hold.

    Raises InputError if `frame` is not a data frame or has no rows, two columns have the same name,
    or a key column has values of several types, durations or periods.
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
    columns = {}
    for column in frame.columns:
        try:
            columns[str(column)] = _convert_column(frame[column])
        except _UnusableError as error:
            if column in (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP):
                raise InputError(f"{name}: {column} {error}") from None
            warn_user(f"{name}: column {column} is left out: it {error}")
    return pa.table(columns)


class _UnusableError(Exception):
    """A column cannot be read; the message says why, and what to do."""


def _convert_column(values: "pd.Series[Any]") -> pa.Array:
    """A column of a data frame, or _UnusableError."""
    import pandas as pd

    if isinstance(values.dtype, pd.PeriodDtype):
        raise _UnusableError("holds periods; convert them with .dt.to_timestamp()")
    try:
        array = pa.Array.from_pandas(values)
    except OverflowError:
        raise _UnusableError(
            "holds whole numbers of more than 64 bits; convert them with .astype(str)"
        ) from None
    except (TypeError, ValueError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise _UnusableError(f"holds values of several types ({reason}); make them one") from None
    if pa.types.is_duration(array.type):
        raise _UnusableError("holds durations; convert them with .dt.total_seconds()")
    dates = values.dtype == object and pa.types.is_date(array.type)
    if dates and any(isinstance(value, datetime) for value in values):
        # Arrow would cut off the time of day.
        raise _UnusableError("holds dates and times; convert them with pandas.to_datetime")
    if pa.types.is_float16(array.type):
        return array.cast(pa.float32())
    for kind in _list_types(array.type):
        if any(is_kind(kind) for is_kind in _UNREAD) or kind == pa.struct([]):
            raise _UnusableError(f"is of type {kind}, which is not read; convert it")
    return array


def _list_types(kind: pa.DataType) -> Iterator[pa.DataType]:
    """A type, and those of its parts."""
    yield kind
    if pa.types.is_dictionary(kind):
        yield kind.value_type
    for number in range(kind.num_fields):
        yield from _list_types(kind.field(number).type)


def _read_users(
    tables: LogTables, last: int, duplicates: str, folder: Path | None
) -> Iterator[pa.RecordBatch]:
    """The users of a log, some thousand rows at a time; `folder` for scratch, None for memory."""
    log = open_log(tables, folder or Path(HISTORIES))
    log.require_items()
    with explain_errors(log.connection, log.tables, folder or Path(HISTORIES)):
        rows = sort_rows(log, None, duplicates, folder)
        require_rows(log, rows.count, rows.dropped)
        note_dropped(log.name, rows.dropped, rows.read)
        query = f"SELECT {schema.ITEM_ID} FROM item_codes ORDER BY code"
        items = log.connection.sql(query).to_arrow_table().column(0).combine_chunks()
        for batch in rows.file.read():
            yield _gather_histories(rows, batch, items, last)


def _gather_histories(
    sorted_rows: SortedRows, rows: dict[str, Array], items: pa.Array, last: int
) -> pa.RecordBatch:
    """The users of rows, which are all theirs."""
    log, codes = sorted_rows.log, rows[USER]
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
    ends = np.append(first[1:], len(codes))
    recent = np.repeat(ends, ends - first) - np.arange(len(codes)) <= last
    offsets = np.append(0, np.cumsum(recent)[ends - 1])
    query = (
        f"SELECT {schema.USER_ID} FROM user_codes WHERE code BETWEEN {codes[0]} AND {codes[-1]} "
        "ORDER BY code"
    )
    users = log.connection.sql(query).to_arrow_table().column(0).combine_chunks()
    # Codes of items are in the order of their ids.
    owner = np.repeat(np.arange(len(first)), ends - first)
    seen = np.unique(owner * len(items) + rows[ITEM])
    bounds = np.searchsorted(seen, np.arange(len(first) + 1) * len(items))
    columns = {
        schema.USER_ID: users.take(to_arrow(codes[first].astype(np.int64) - codes[0])),
        "item_ids": _make_lists(offsets, items.take(to_arrow(rows[ITEM][recent]))),
        "rewards": _make_lists(offsets, _make_floats(rows[schema.REWARD][recent])),
        "timestamps": _make_lists(offsets, to_arrow(rows[schema.TIMESTAMP][recent])),
        "seen": _make_lists(bounds, items.take(to_arrow(seen % len(items)))),
    }
    if log.session_by == schema.SESSION_ID:
        columns["session_ids"] = _make_lists(offsets, to_arrow(rows[SESSION][recent]))
    if sorted_rows.observations is not None:
        observations = sorted_rows.observations.of_rows(rows["row"][ends - 1])
        bounds = np.arange(len(first) + 1) * observations.shape[1]
        columns[schema.OBSERVATION] = _make_lists(bounds, _make_floats(observations.ravel()))
    return pa.record_batch(columns)


def _make_lists(offsets: IntArray, values: pa.Array) -> pa.ListArray:
    return pa.ListArray.from_arrays(to_arrow(offsets).cast(pa.int32()), values)


def _make_floats(values: Array) -> pa.Array:
    buffer = pa.py_buffer(np.ascontiguousarray(values, dtype=np.float32))
    return pa.Array.from_buffers(pa.float32(), len(values), [None, buffer])
