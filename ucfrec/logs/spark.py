"""Read and sort the rows of a log with Apache Spark, for logs that outgrow one machine.

Spark's workers read the files, evaluate the columns and the reward with DuckDB (`Task`), number the
ids and sort: the rows in the scratch folder are what DuckDB's sort would give. Or each worker gets
all rows of some users (`map_users`) as one Parquet file. Workers need ucfrec and the same paths.
"""

import os
import re
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain
from math import ceil
from pathlib import Path
from tempfile import gettempdir
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow.dataset import dataset

from ucfrec import schema
from ucfrec.errors import InputError, InputNote, one_line
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.engine import BATCH_ROWS, engine, explain_errors
from ucfrec.logs.mapping import KEY_COLUMNS, OPTIONAL_COLUMNS, LogMapping, log_files
from ucfrec.logs.rows import (
    FAULT_COUNTS,
    FAULTY,
    REASONS,
    SortedRows,
    check_sorted,
    code_ids,
    code_tables,
    mark_faults,
    order_rows,
)
from ucfrec.logs.sessions import write_batches
from ucfrec.logs.summary import NoRowsError, note_dropped, require_rows
from ucfrec.logs.tables import Table
from ucfrec.logs.typed import (
    ROWS,
    VECTORS,
    LogTables,
    TypedLog,
    measure_vectors,
    number_rows,
    open_log_tables,
    survey_vectors,
    type_columns,
)

MEMORY = "2GB"
"""Memory of the process of a task."""
PART_ROWS = 1_000_000
"""About so many rows are a part; a user's rows are never in two."""
_SPARK_TYPES = {"VARCHAR": "string", "FLOAT[]": "array<float>"}
"""Spark's names of types that it does not call as DuckDB does."""
_SORTED = "sorted"
_REFUSED = re.compile(r"ucfrec\.errors\.InputError: ([^\n]+)")

Work = Callable[[int, Path, LogMapping], int]
"""Takes the number of a part, the file of its rows and their columns; returns a count. The rows
have the columns of the schema and `reward`."""


class Task(NamedTuple):
    """A query over one file of a log, and perhaps more files."""

    table: Table
    query: str
    more_files: tuple[Path, ...] = ()


def run_tasks(tasks: Sequence[Task], batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """Results of the tasks whose places are in the only column of `batches`."""
    folder = Path(gettempdir())
    for task in (tasks[place] for batch in batches for place in batch.column(0).to_pylist()):
        files = (*task.table.files, *task.more_files)
        with (
            engine(files, folder, MEMORY, threads=1) as connection,
            explain_errors(connection, (task.table,)),
        ):
            yield from connection.sql(task.query).to_arrow_reader(BATCH_ROWS)


def sort_with_spark(
    tables: LogTables,
    known_items: Path | None,
    scratch: Path,
    duplicates: str,
    master: str,
) -> SortedRows:
    """`sort_rows` with Spark, which loads the sorted rows and the numbers of ids.

    Every worker sees the folder `scratch`; `master` is Spark's, e.g. "local[*]" or
    "spark://host:7077". Raises InputError also if Spark is missing or fails.
    """
    with spark_session(master) as spark:
        log, rows = _type_rows(spark, tables, known_items, scratch)
        rows.createOrReplaceTempView(FAULTY)
        for name, table in code_tables(log).items():
            codes = _save(spark, spark.sql(code_ids(name, FAULTY)), scratch / table)
            codes.createOrReplaceTempView(table)
        _save(spark, spark.sql(order_rows(log, FAULTY)), scratch / _SORTED)
        counts = dict(spark.sql(FAULT_COUNTS).collect())
    for table in code_tables(log).values():
        log.connection.from_arrow(dataset(scratch / table)).create(table)
    names = ["row", schema.OBSERVATION]
    observations = _read_parts(scratch / FAULTY, log.batch_rows, names)
    batches = _read_parts(scratch / _SORTED, log.batch_rows)
    by_session = log.session_by == schema.SESSION_ID
    sorted_rows = check_sorted(log, counts, observations, batches, duplicates, scratch, by_session)
    shutil.rmtree(scratch / FAULTY)
    return sorted_rows


def _type_rows(
    spark: Any,
    tables: LogTables,
    known_items: Path | None,
    scratch: Path,
) -> tuple[TypedLog, Any]:
    """The log, and a Spark frame of its rows as of `mark_faults`, read from files in `scratch`."""
    typed = type_columns(tables)
    with explain_errors(tables.connection, tables.tables):
        every = zip(typed.selects, typed.tables, strict=True)
        tables.connection.execute(f"CREATE VIEW {ROWS} AS {number_rows(every)}")
    files = [
        (single := replace(table, files=(file,)), f"({number_rows([(values, single)])})")
        for values, table in zip(typed.selects, typed.tables, strict=True)
        for file in table.files
    ]
    surveys = [
        Task(file, f"SELECT {n}::BIGINT AS file, * FROM ({survey_vectors(typed.columns, rows)})")
        for n, (file, rows) in enumerate(files)
    ]
    names = ("file", *(f"{end}_{v}" for v in VECTORS for end in ("min", "max")), "n", "bad")
    survey = _run(spark, surveys, ", ".join(f"{name} bigint" for name in names)).collect()
    log = measure_vectors(typed, [row[1:] for row in survey])
    tasks, rows_before = [], 0
    for number, (file, rows) in enumerate(files):
        faulty = mark_faults(log, rows, known_items)
        query = f"SELECT * REPLACE (row + {rows_before} AS row) FROM ({faulty})"
        tasks.append(Task(file, query, () if known_items is None else (known_items,)))
        rows_before += sum(row["n"] for row in survey if row["file"] == number)
    kinds = {name: log.find_type(name) for name in log.columns}
    types = {name: _SPARK_TYPES.get(kind, kind.lower()) for name, kind in kinds.items()}
    types = {"row": "bigint", **types, schema.REWARD: "double"}
    types |= {"action_hash": "bigint"} if schema.ACTION in types else {}
    types |= {"fault": "smallint"}
    frame = _run(spark, tasks, ", ".join(f"{name} {kind}" for name, kind in types.items()))
    return log, _save(spark, frame, scratch / FAULTY)


def _run(spark: Any, tasks: Sequence[Task], columns: str) -> Any:
    numbers = spark.range(0, len(tasks), 1, len(tasks))
    return numbers.mapInArrow(partial(run_tasks, tasks), columns)


def _save(spark: Any, frame: Any, folder: Path) -> Any:
    """Write a frame to Parquet files; returns it as read from them."""
    # Each is used several times, and Spark would compute it again each time.
    # Of an address, Spark decodes no character; what it reads is a pattern.
    address = f"file://{folder.absolute()}"
    frame.write.parquet(address)
    return spark.read.parquet(re.sub(r"([\\*?{}\[\]])", r"\\\1", address))


def _read_parts(
    folder: Path, rows: int = BATCH_ROWS, columns: list[str] | None = None
) -> Iterator[pa.RecordBatch]:
    parts = folder.glob("part-*.parquet")
    for part in sorted(parts, key=lambda path: (int(path.name.split("-")[1]), path.name)):
        with pq.ParquetFile(part) as file:
            yield from file.iter_batches(rows, columns=columns, use_threads=False)


def map_users(
    paths: Sequence[str | Path],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    folder: Path,
    master: str,
    work: Work,
) -> list[int]:
    """Give each part of the users of a log to a worker, for `work`; returns the counts of the parts
    that have a usable row, users in sorted order. Warns of the rows that are left out.

    Every worker sees the parent `folder` of a scratch folder. Raises InputError if the log cannot
    be used, no row is left, or Spark is missing or fails.
    """
    # Workers have a working folder of their own.
    files = [file.absolute() for file in log_files(paths)]
    with (
        scratch_folder(folder.absolute(), "users") as scratch,
        engine(files, scratch) as connection,
        spark_session(master) as spark,
    ):
        tables = open_log_tables(connection, files, mapping, reward, session_by)
        log, rows = _type_rows(spark, tables, None, scratch)
        log.require_items()
        faults = dict(rows.groupBy("fault").count().collect())
        dropped = {reason: faults.get(number, 0) for number, reason in enumerate(REASONS, 1)}
        require_rows(log, faults.get(0, 0), dropped)
        note_dropped(log.name, dropped, sum(faults.values()))
        parts = max(spark.sparkContext.defaultParallelism, ceil(faults[0] / PART_ROWS))
        users = rows.where("fault = 0").repartitionByRange(parts, schema.USER_ID)
        users = users.sortWithinPartitions("row").drop("fault", "row")
        plain = {n: n if n in log.columns else "" for n in (*KEY_COLUMNS, *OPTIONAL_COLUMNS)}
        columns = LogMapping(plain, earliest=tables.mapping.earliest)
        work_on_part = partial(_work_on_part, work, columns, log.name)
        done = users.mapInArrow(work_on_part, "part bigint, count bigint")
        counts = [count for _, count in sorted(map(tuple, done.collect()))]
        require_rows(log, len(counts), dropped)
        return counts


def _work_on_part(
    work: Work,
    mapping: LogMapping,
    name: str,
    batches: Iterator[pa.RecordBatch],
) -> Iterator[pa.RecordBatch]:
    from pyspark import TaskContext

    context = TaskContext.get()
    assert context is not None
    with scratch_folder(Path(gettempdir()), "part") as folder:
        file, first = folder / "rows.parquet", next(batches, None)
        if first is None:
            return
        every = pa.RecordBatchReader.from_batches(first.schema, chain([first], batches))
        write_batches(file, every)
        try:
            with warnings.catch_warnings():
                # `map_users` says it of all parts.
                warnings.simplefilter("ignore", InputNote)
                count = work(context.partitionId(), file, mapping)
        except NoRowsError:
            return
        except InputError as error:
            raise InputError(str(error).replace(str(file), name)) from None
    yield pa.record_batch({"part": [context.partitionId()], "count": [count]})


@contextmanager
def spark_session(master: str) -> Iterator[Any]:
    """A session of Spark of its own; its cluster connection is kept if the program had one before.
    Raises InputError if pyspark or Java is missing, the master does not answer, or Spark fails or a
    worker refuses something in the block."""
    try:
        from py4j.protocol import Py4JError
        from pyspark.errors import PySparkException
        from pyspark.sql import SparkSession
    except ImportError:
        raise InputError("--engine spark needs pyspark; pip install 'ucfrec[spark]'") from None
    if master.startswith("local"):
        os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    running, interrupted = SparkSession.getActiveSession(), signal.getsignal(signal.SIGINT)
    builder = SparkSession.builder.appName("ucfrec")
    try:
        # The commands' own bars show how far they are.
        started = running or (
            builder.master(master).config("spark.ui.showConsoleProgress", "false").getOrCreate()
        )
    except (PySparkException, OSError) as error:
        raise InputError(
            f"Spark cannot be started at {master!r} ({one_line(str(error)):.300}); it needs Java "
            "17 or later, and a master such as local[*] or spark://HOST:7077"
        ) from None
    started.sparkContext.setLogLevel("ERROR")
    try:
        with warnings.catch_warnings():
            # Its doubts about a version of pandas do not concern Arrow, which is used here.
            warnings.filterwarnings("ignore", category=FutureWarning, module="pyspark")
            yield started.newSession()
    except (PySparkException, Py4JError) as error:
        if refused := _REFUSED.search(str(error)):
            raise InputError(refused[1]) from None
        raise InputError(f"Spark failed ({one_line(str(error)):.500}); its log says more") from None
    finally:
        if running is None:
            started.stop()
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, interrupted)  # Spark's own would look for its session
