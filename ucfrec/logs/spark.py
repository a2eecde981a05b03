"""Sort the rows of a log with Apache Spark, for logs that outgrow one machine.

Spark's workers read the files, evaluate the columns and the reward with DuckDB (`Task`), so that an
expression means the same whatever sorts the rows, number the ids and sort: in the scratch folder
the rows are what DuckDB's sort would give, and what follows is the same. Workers need ucfrec and
the same paths to the logs and the scratch folder.
"""

import os
import re
import shutil
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError, one_line
from ucfrec.logs.binding import explained
from ucfrec.logs.engine import BATCH_ROWS, engine
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.sorted_rows import (
    FAULT_COUNTS,
    FAULTY,
    SortedRows,
    check_sorted,
    code_tables,
    coded_ids,
    in_order,
    with_faults,
)
from ucfrec.logs.tables import Table
from ucfrec.logs.typed import (
    ROWS,
    TypedLog,
    numbered_rows,
    typed_columns,
)
from ucfrec.logs.vectors import (
    observation_counts,
    require_observations,
    vector_counts,
    vector_sizes,
    vectors,
)

MEMORY: Final = "1GB"
"""Memory of DuckDB in a task."""
_TYPES: Final = {"BIGINT": "bigint", "VARCHAR": "string"}
_COLUMNS: Final = {
    schema.ACTION: "array<float>",
    schema.TIMESTAMP: "bigint",
    schema.OBSERVATION: "array<float>",
    schema.PROPENSITY: "float",
    schema.IS_RANDOM: "boolean",
}
_SORTED: Final = "sorted"
_COUNTS: Final = "file bigint, name string, size bigint, n bigint"
_ROWS, _BAD = "rows", "bad"
_REFUSED: Final = re.compile(r"ucfrec\.errors\.InputError: ([^\n]+)")
Files = Sequence[tuple[str, Table]]
"""Of each file, the SQL of its typed columns and the table that it is."""


@dataclass(frozen=True)
class Task:
    """A query over one file of a log."""

    table: Table
    """Of the file."""
    query: str
    """SQL."""
    more_files: tuple[Path, ...] = ()
    """Other files that the query reads."""

    def run(self) -> Iterator[pa.RecordBatch]:
        """The result, in order.

        Raises:
            InputError: the file, or a value in it, cannot be read.
        """
        folder = Path(gettempdir())
        with (
            engine((*self.table.files, *self.more_files), folder, MEMORY, threads=1) as connection,
            explained(connection, (self.table,), folder),
        ):
            yield from connection.sql(self.query).to_arrow_reader(BATCH_ROWS)


def run_tasks(tasks: Sequence[Task], batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """Results of the tasks whose places are in the only column of `batches`."""
    for batch in batches:
        for number in batch.column(0).to_pylist():
            yield from tasks[number].run()


def sort_with_spark(
    connection: duckdb.DuckDBPyConnection,
    tables: tuple[Table, ...],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    known_items: Path | None,
    scratch: Path,
    duplicates: str,
    master: str,
) -> SortedRows:
    """Sort every row of a log with Spark, and load the sorted rows and the numbers of its ids.

    Args:
        connection: with the tables open; its engine is that of `ucfrec.logs.engine.engine`.
        tables: of the log's files.
        mapping: log columns to the files' columns.
        reward: scalar SQL expression over the files' columns.
        session_by: "session_id", "gap" or "user"; None for session_id if the log has it, else gap.
        known_items: `items.parquet` of a store: rows with other items are dropped; None for all.
        scratch: scratch folder, which every worker sees.
        duplicates: key of `ucfrec.logs.kept.DUPLICATES`.
        master: Spark's master, e.g. "local[*]" or "spark://host:7077".

    Returns:
        What `ucfrec.logs.sorted_rows.sort_rows` returns.

    Raises:
        InputError: a file, column or type makes the log unusable, an observation is missing or not
            finite, or Spark is missing or fails.
    """
    with spark_session(master) as spark, spark_failures():
        log_values = connection, tables, mapping, reward, session_by
        log, rows = typed_with_spark(spark, *log_values, known_items, scratch)
        rows.createOrReplaceTempView(FAULTY)
        for name, table in code_tables(log).items():
            codes = _written(spark, spark.sql(coded_ids(name, FAULTY)), scratch / table)
            codes.createOrReplaceTempView(table)
        _written(spark, spark.sql(in_order(log, FAULTY)), scratch / _SORTED)
        counts = {row[0]: row[1] for row in spark.sql(FAULT_COUNTS).collect()}
    for table in code_tables(log).values():
        _load(connection, scratch / table, table)
    observations = _batches(scratch / FAULTY, log.batch_rows, ["row", schema.OBSERVATION])
    batches = _batches(scratch / _SORTED, log.batch_rows)
    by_session = log.session_by == schema.SESSION_ID
    sorted_rows = check_sorted(log, counts, observations, batches, duplicates, scratch, by_session)
    shutil.rmtree(scratch / FAULTY)
    return sorted_rows


def typed_with_spark(
    spark: Any,
    connection: duckdb.DuckDBPyConnection,
    tables: tuple[Table, ...],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    known_items: Path | None,
    scratch: Path,
) -> tuple[TypedLog, Any]:
    """Read every row of a log; the arguments are those of `sort_with_spark`.

    Returns:
        The log, and a Spark frame of its rows as of `ucfrec.logs.sorted_rows.with_faults`, read
        from files in the scratch folder.

    Raises:
        InputError: a file, column or type makes the log unusable, or an observation is missing or
            not finite.
    """
    typed = typed_columns(connection, tables, mapping, reward, session_by)
    with explained(connection, tables, scratch):
        every = zip(typed.selects, (table.sql for table in typed.tables), strict=True)
        connection.execute(f"CREATE VIEW {ROWS} AS {numbered_rows(every)}")
    files = [
        (values, replace(table, files=(file,)))
        for values, table in zip(typed.selects, typed.tables, strict=True)
        for file in table.files
    ]
    survey = _surveyed(spark, files, vectors(typed.names))
    log = typed.log(connection, vector_sizes(survey.vectors), mapping)
    require_observations(tables, survey.bad, sum(survey.rows))
    tasks = _row_tasks(log, files, survey.rows, known_items)
    return log, _written(spark, _run(spark, tasks, _schema(log)), scratch / FAULTY)


@dataclass
class _Survey:
    """What must be known of all files before their rows are read."""

    rows: list[int]
    """Number of rows of each file."""
    vectors: dict[str, Counter[int]]
    """Vector column to the number of its vectors by size, missing ones excluded."""
    bad: int = 0
    """Number of observations that are missing or not finite."""


def _surveyed(spark: Any, files: Files, names: Sequence[str]) -> _Survey:
    """Count the rows of each file, and the vectors in the columns `names`."""
    tasks = []
    for number, (values, table) in enumerate(files):
        rows = f"({numbered_rows([(values, table.sql)])})"
        counts = {_ROWS: f"SELECT 0 AS size, count(*) AS n FROM {rows}"}
        counts |= {name: vector_counts(name, rows) for name in names}
        if schema.OBSERVATION in names:
            counts[_BAD] = (
                f"SELECT 0 AS size, n FROM ({observation_counts(rows)}) AS bad(n, of_rows)"
            )
        queries = (
            f"SELECT {number}::BIGINT AS file, '{name}' AS name, size::BIGINT AS size, "
            f"n::BIGINT AS n FROM ({query})"
            for name, query in counts.items()
        )
        tasks.append(Task(table, " UNION ALL ".join(queries)))
    survey = _Survey([0] * len(files), {name: Counter() for name in names})
    for file, name, size, n in _run(spark, tasks, _COUNTS).collect():
        if name == _ROWS:
            survey.rows[file] += n
        elif name == _BAD:
            survey.bad += n
        else:
            survey.vectors[name][size] += n
    return survey


def _row_tasks(
    log: TypedLog, files: Files, counts: Sequence[int], known_items: Path | None
) -> list[Task]:
    """Tasks that read the typed rows with faults of each file."""
    more_files = () if known_items is None else (known_items,)
    tasks, rows_before = [], 0
    for (values, table), n in zip(files, counts, strict=True):
        rows = f"({numbered_rows([(values, table.sql)])})"
        faulty = with_faults(log, rows, known_items)
        query = f"SELECT * REPLACE (row + {rows_before} AS row) FROM ({faulty})"
        tasks.append(Task(table, query, more_files))
        rows_before += n
    return tasks


def _schema(log: TypedLog) -> str:
    """Spark's types of the rows of `_row_tasks`."""
    ids = (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID)
    types = {n: _TYPES[log.id_type(n)] if n in ids else _COLUMNS[n] for n in log.columns}
    types = {"row": "bigint", **types, schema.REWARD: "double"}
    if schema.ACTION in types:
        types["action_hash"] = "bigint"
    types["fault"] = "smallint"
    return ", ".join(f"{name} {kind}" for name, kind in types.items())


def _run(spark: Any, tasks: Sequence[Task], columns: str) -> Any:
    """A Spark frame of the results of tasks, which its workers run."""
    numbers = spark.range(0, len(tasks), 1, len(tasks))
    return numbers.mapInArrow(partial(run_tasks, tasks), columns)


def _written(spark: Any, frame: Any, folder: Path) -> Any:
    """Write a frame to Parquet files; returns it as read from them."""
    # Each is used several times, and Spark would compute it again each time.
    address = folder.absolute().as_uri()
    frame.write.parquet(address)
    return spark.read.parquet(address)


def _parts(folder: Path) -> list[Path]:
    """The files that Spark wrote to a folder, in the order of their rows."""
    return sorted(folder.glob("part-*.parquet"), key=lambda p: (int(p.name.split("-")[1]), p.name))


def _batches(
    folder: Path, rows: int = BATCH_ROWS, columns: list[str] | None = None
) -> Iterator[pa.RecordBatch]:
    for part in _parts(folder):
        with pq.ParquetFile(part) as file:
            yield from file.iter_batches(rows, columns=columns, use_threads=False)


def _load(connection: duckdb.DuckDBPyConnection, folder: Path, table: str) -> None:
    """Create a table of the rows in a folder, in order."""
    batches = (batch for batch in _batches(folder) if batch.num_rows)
    reader = pa.RecordBatchReader.from_batches(pq.read_schema(_parts(folder)[0]), batches)
    connection.register("loaded", reader)
    connection.execute(f"CREATE TABLE {table} AS SELECT * FROM loaded")
    connection.unregister("loaded")


@contextmanager
def spark_session(master: str) -> Iterator[Any]:
    """A session of Spark of its own; its cluster connection is kept if the program had one before.

    Raises:
        InputError: pyspark or Java is missing, or the master does not answer.
    """
    try:
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
    finally:
        if running is None:
            started.stop()
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, interrupted)  # Spark's own would look for its session


@contextmanager
def spark_failures() -> Iterator[None]:
    """Turn errors of Spark that occur in the block into `InputError`.

    Raises:
        InputError: a worker refused the log, or Spark failed.
    """
    from py4j.protocol import Py4JError
    from pyspark.errors import PySparkException

    try:
        yield
    except (PySparkException, Py4JError) as error:
        if refused := _REFUSED.search(str(error)):
            raise InputError(refused[1]) from None
        raise InputError(f"Spark failed ({one_line(str(error)):.500}); its log says more") from None
