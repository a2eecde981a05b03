"""The item history of each user of a log, from files or from a data frame."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Final

import pyarrow as pa

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.binding import Table, explained, quoted
from ucfrec.logs.clean import REASONS, check_rows, drop_counts, read_log
from ucfrec.logs.engine import BATCH_ROWS, engine, engine_in_memory
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.typed import TypedLog

if TYPE_CHECKING:
    import pandas as pd

HISTORIES: Final = "histories"
"""Name of a data frame in messages and in the engine."""


@dataclass(frozen=True)
class FrameTable(Table):
    """A data frame or Arrow table registered with the engine; `files` holds its name."""

    @property
    def columnar(self) -> bool:
        return True

    @property
    def sql(self) -> str:
        return quoted(str(self.files[0]))


def read_histories(
    paths: Sequence[str | Path],
    mapping: LogMapping,
    reward: str,
    last: int,
    memory_limit: str = "2GB",
    session_by: str = "user",
    duplicates: str = "highest",
) -> Iterator[pa.RecordBatch]:
    """Read the history of each user of a log, cleaned as `prepare` cleans it.

    Args:
        paths: log files, folders and globs.
        mapping: log columns to the files' columns.
        reward: scalar SQL expression over the files' columns.
        last: most rows of each user, the most recent ones.
        memory_limit: size such as "2GB", beyond which rows spill to disk.
        session_by: with "session_id", batches have the column `session_ids`.
        duplicates: see `PrepareOptions.duplicates`.

    Yields:
        Batches of users in sorted order: `user_id`; `item_ids`, `rewards` (float32), `timestamps`
        (ms) and perhaps `session_ids`, lists of at most `last` with the most recent last; `seen`,
        all item ids of the user, sorted; and, if the log has it, the most recent `observation`.

    Raises:
        InputError: the input cannot be used.
    """
    folder, files = Path(gettempdir()), log_files(paths)
    with engine(files, folder, memory_limit) as connection:
        log = read_log(connection, files, mapping, reward, session_by, folder, duplicates)
        drop_counts(log)
        with explained(connection, log.tables, folder):
            yield from _by_user(log, last)


def frame_histories(
    frame: "pd.DataFrame",
    mapping: LogMapping,
    reward: str,
    last: int,
    session_by: str = "user",
    duplicates: str = "highest",
) -> Iterator[pa.RecordBatch]:
    """`read_histories` of a log in memory, without using the disk.

    Of rows with the same user, item and time one is kept, as in `read_histories`; any other row
    that `prepare` would drop is an error.

    Args:
        frame: one row per interaction.
        mapping: log columns to the frame's columns.
        reward: scalar SQL expression over the frame's columns.
        last: most rows of each user, the most recent ones.
        session_by: with "session_id", batches have the column `session_ids`.
        duplicates: see `PrepareOptions.duplicates`.

    Yields:
        Batches as of `read_histories`.

    Raises:
        InputError: `frame` is no data frame or has no rows, a column is missing, repeated or of a
            wrong type, or a row cannot be used.
    """
    columns = log_table(frame, HISTORIES)
    with engine_in_memory() as connection:
        connection.register(HISTORIES, columns)
        described = connection.sql(f"DESCRIBE {HISTORIES}").fetchall()
        table = FrameTable((Path(HISTORIES),), tuple((row[0], row[1]) for row in described))
        source = Path(HISTORIES)
        log = check_rows(connection, (table,), mapping, reward, session_by, source, duplicates)
        _require_clean(log)
        with explained(connection, log.tables, Path(HISTORIES)):
            yield from _by_user(log, last)


def log_table(frame: "pd.DataFrame", name: str) -> pa.Table:
    """Convert a data frame to Arrow, leaving out columns of mixed Python objects.

    Args:
        frame: one row per interaction.
        name: name of the frame in messages.

    Raises:
        InputError: `frame` is no data frame or has no rows, two columns have the same name, or a
            key column has values of several types.
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
            columns[str(column)] = pa.Array.from_pandas(frame[column])
        except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError) as error:
            if column in (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP):
                reason = str(error).splitlines()[0]
                raise InputError(
                    f"{name}: {column} holds values of several types ({reason}); make them one"
                ) from None
            # A reward expression cannot use another column of mixed Python objects.
    return pa.table(columns)


def _require_clean(log: TypedLog) -> None:
    dropped = drop_counts(log)
    faults = {reason: n for reason, n in dropped.items() if n and reason != "duplicate"}
    if faults:
        rows = "; ".join(f"{n:,} rows: {REASONS[reason]}" for reason, n in faults.items())
        hint = "; is the time in milliseconds?" if "clock_out_of_range" in faults else ""
        raise InputError(f"{HISTORIES}: {rows}{hint}; correct those rows or leave them out")


def _by_user(log: TypedLog, last: int) -> Iterator[pa.RecordBatch]:
    if log.key != schema.ITEM_ID:
        raise InputError(f"{log.tables[0].files[0]}: its actions are vectors; map item_id instead")
    lists = {
        "item_ids": schema.ITEM_ID,
        "rewards": f"CAST({schema.REWARD} AS FLOAT)",
        "timestamps": schema.TIMESTAMP,
    }
    if log.session_by == schema.SESSION_ID:
        lists["session_ids"] = schema.SESSION_ID
    order = f"ORDER BY {schema.TIMESTAMP}, {schema.ITEM_ID}"
    gathered = ", ".join(
        f"list({value} {order}) FILTER (WHERE back <= {last}) AS {name}"
        for name, value in lists.items()
    )
    if schema.OBSERVATION in log.columns:
        gathered += f", any_value({schema.OBSERVATION}) FILTER (WHERE back = 1) AS observation"
    backwards = f"{schema.TIMESTAMP} DESC, {schema.ITEM_ID} DESC"
    query = f"""
        SELECT {schema.USER_ID}, {gathered}, list_sort(list(DISTINCT {schema.ITEM_ID})) AS seen
        FROM (SELECT *, row_number() OVER (
            PARTITION BY {schema.USER_ID} ORDER BY {backwards}
        ) AS back FROM clean)
        GROUP BY {schema.USER_ID} ORDER BY {schema.USER_ID}
    """
    yield from log.connection.sql(query).to_arrow_reader(BATCH_ROWS)
