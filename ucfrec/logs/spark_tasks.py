"""What Spark's workers do: read one file of a log each, with the engine that reads it elsewhere.

Workers run DuckDB, so that an expression means the same whatever sorts the rows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Final

import pyarrow as pa

from ucfrec.logs.binding import explained
from ucfrec.logs.engine import BATCH_ROWS, engine
from ucfrec.logs.tables import Table

MEMORY: Final = "1GB"
"""Memory of DuckDB in a task."""


@dataclass(frozen=True)
class Task:
    """A query over one file of a log."""

    table: Table
    """Of the file."""
    query: str
    """SQL."""
    others: tuple[Path, ...] = ()
    """Other files that the query reads."""

    def run(self) -> Iterator[pa.RecordBatch]:
        """The result, in order.

        Raises:
            InputError: the file, or a value in it, cannot be read.
        """
        folder = Path(gettempdir())
        with (
            engine((*self.table.files, *self.others), folder, MEMORY, threads=1) as connection,
            explained(connection, (self.table,), folder),
        ):
            yield from connection.sql(self.query).to_arrow_reader(BATCH_ROWS)


def run_tasks(tasks: Sequence[Task], batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """Results of the tasks whose places are in the only column of `batches`."""
    for batch in batches:
        for number in batch.column(0).to_pylist():
            yield from tasks[number].run()
