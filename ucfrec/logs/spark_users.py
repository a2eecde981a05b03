"""The users of a log in parts, each read by one of Spark's workers as a log of its own.

Spark reads and types the rows (`ucfrec.logs.spark`) and gives each worker all rows of some users.
There they are one Parquet file, which is read as any other on one machine.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError, InputNote
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.binding import settled
from ucfrec.logs.engine import engine
from ucfrec.logs.kept import REASONS, NoRowsError, note_dropped, require_rows
from ucfrec.logs.mapping import KEY_COLUMNS, OPTIONAL_COLUMNS, LogMapping, log_files
from ucfrec.logs.spark import spark_failures, spark_session, typed_with_spark
from ucfrec.logs.tables import open_tables
from ucfrec.logs.typed import TypedLog

PART_ROWS: Final = 1_000_000
"""About so many rows are a part; a user's rows are never in two."""

Work = Callable[[int, Path, LogMapping], int]
"""Takes the number of a part, the file of its rows and their columns; returns a count. The rows
have the columns of the schema and `reward`."""


@dataclass(frozen=True)
class GivenLog:
    """What is to be read."""

    paths: Sequence[str | Path]
    """Log files, folders and globs, which every worker sees."""
    mapping: LogMapping
    """Log columns to the files' columns."""
    reward: str
    """Scalar SQL expression over the files' columns."""
    session_by: str | None
    """"session_id", "gap" or "user"; None for session_id if the log has it, else gap."""
    known_items: Path | None = None
    """`items.parquet` of a store or run: rows with other items are left out; None for all."""


def by_users(source: GivenLog, folder: Path, master: str, work: Work) -> list[int]:
    """Give each part of the users of a log to a worker. Warns of the rows that are left out.

    Args:
        folder: parent of a scratch folder, which every worker sees.
        master: Spark's master, e.g. "local[*]" or "spark://host:7077".
        work: runs on the workers, which need ucfrec.

    Returns:
        The counts of the parts that have a usable row, users in sorted order.

    Raises:
        InputError: the log cannot be used, no row is left, or Spark is missing or fails.
    """
    # Workers have a working folder of their own.
    files = [file.absolute() for file in log_files(source.paths)]
    known_items = source.known_items and source.known_items.absolute()
    with (
        scratch_folder(folder.absolute(), "users") as scratch,
        engine(files, scratch) as connection,
        spark_session(master) as spark,
        spark_failures(),
    ):
        tables = tuple(open_tables(connection, files, source.mapping.partitions))
        mapping, reward = settled(connection, tables, source.mapping, source.reward)
        typed = connection, tables, mapping, reward, source.session_by
        log, rows = typed_with_spark(spark, *typed, known_items, scratch)
        if log.key != schema.ITEM_ID:
            raise InputError(f"{log.name}: its actions are vectors; map item_id instead")
        usable, dropped = _counted(log, rows)
        parts = max(spark.sparkContext.defaultParallelism, ceil(usable / PART_ROWS))
        users = rows.where("fault = 0").repartitionByRange(parts, schema.USER_ID)
        users = users.sortWithinPartitions("row").drop("fault", "row")
        done = users.mapInArrow(partial(_done, work, _plain(log, mapping), log.name), _DONE)
        counts = [count for _, count in sorted(map(tuple, done.collect()))]
        require_rows(log, len(counts), dropped)
        return counts


_DONE: Final = "part bigint, count bigint"


def _counted(log: TypedLog, rows: Any) -> tuple[int, dict[str, int]]:
    """How many rows have no fault, and how many are left out by reason."""
    faults = {row[0]: row[1] for row in rows.groupBy("fault").count().collect()}
    dropped = {reason: faults.get(number, 0) for number, reason in enumerate(REASONS, 1)}
    require_rows(log, faults.get(0, 0), dropped)
    note_dropped(log.name, dropped, sum(faults.values()))
    return faults[0], dropped


def _plain(log: TypedLog, mapping: LogMapping) -> LogMapping:
    """The mapping of rows whose columns have the names and types of the schema."""
    names: Mapping[str, str] = {
        name: name if name in log.columns else "" for name in (*KEY_COLUMNS, *OPTIONAL_COLUMNS)
    }
    return LogMapping(names, earliest=mapping.earliest)


def _done(
    work: Work, mapping: LogMapping, name: str, batches: Iterator[pa.RecordBatch]
) -> Iterator[pa.RecordBatch]:
    """Run `work` on the rows of a part; nothing if none is usable."""
    from pyspark import TaskContext

    context = TaskContext.get()
    assert context is not None
    with scratch_folder(Path(gettempdir()), "part") as folder:
        file = folder / "rows.parquet"
        if not _saved(file, batches):
            return
        try:
            with warnings.catch_warnings():
                # `by_users` says it of all parts.
                warnings.simplefilter("ignore", InputNote)
                count = work(context.partitionId(), file, mapping)
        except NoRowsError:
            return
        except InputError as error:
            raise InputError(str(error).replace(str(file), name)) from None
    yield pa.record_batch({"part": [context.partitionId()], "count": [count]})


def _saved(file: Path, batches: Iterator[pa.RecordBatch]) -> int:
    """Write batches to a Parquet file; returns the number of rows."""
    rows, writer = 0, None
    for batch in batches:
        writer = writer or pq.ParquetWriter(file, batch.schema)
        writer.write_batch(batch)
        rows += batch.num_rows
    if writer is not None:
        writer.close()
    return rows
