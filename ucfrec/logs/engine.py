"""DuckDB connections that can open nothing but their inputs and a scratch folder."""

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import duckdb
import numpy as np

from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.tables import glob_pattern, text

if TYPE_CHECKING:
    import pyarrow as pa

BATCH_ROWS: Final = 2**17
"""Most rows of a batch read from DuckDB."""
_BATCH_BYTES: Final = 2**25
_BESIDE: Final = 370 * 2**20
"""Bytes that going through rows takes beside the engine and what the process has already."""

_CLOSED: Final = {
    "allow_community_extensions": False,
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    # Otherwise SQL could read any Python variable as a table.
    "python_enable_replacements": False,
}


@contextmanager
def engine(
    inputs: Iterable[Path],
    folder: Path,
    memory_limit: str | None = None,
    shared: bool = False,
    threads: int | None = None,
) -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB connection with a database on disk.

    It can open only the inputs and files in its scratch folder, loads no extension, and its
    configuration is locked. Every DuckDB connection of ucfrec is made in this module.

    Args:
        folder: parent of the scratch folder, which is removed at the end; so is the scratch of
            killed processes in it.
        memory_limit: size such as "2GB", of the engine or with `shared` of the process, beyond
            which rows spill to disk; None for DuckDB's default.
        shared: whether the rest of the process keeps to the limit too, with at most half of it.
        threads: most threads; None for one per core.

    Raises:
        InputError: `memory_limit` is not a size.
    """
    with scratch_folder(folder, "rows") as work:
        spill = str(work / "spill")
        connection = duckdb.connect(
            str(work / "rows.duckdb"), config={**_CLOSED, "temp_directory": spill}
        )
        try:
            if memory_limit is not None:
                _set_memory_limit(connection, memory_limit)
                if (limit := bytes_of(memory_limit)) and shared:
                    size = max(limit - anonymous_bytes() - _BESIDE, limit // 2)
                    _set_memory_limit(connection, f"{size} B")
            if threads is not None:
                connection.execute("SET threads = ?", [threads])
            _set_semantics(connection)
            _close(connection, inputs, str(work))
            yield connection
        finally:
            connection.close()


def _set_memory_limit(connection: duckdb.DuckDBPyConnection, size: str) -> None:
    try:
        connection.execute("SET memory_limit = ?", [size])
    except duckdb.Error:
        raise InputError(f"memory_limit {size!r} is not a size; write e.g. 2GB") from None


def anonymous_bytes(process: int | None = None) -> int:
    """Memory of a process that is not mapped from files, which the system cannot take back.

    Args:
        process: its number; None for this one.

    Returns:
        0 where the system does not say, or the process has ended.
    """
    try:
        lines = Path(f"/proc/{process or os.getpid()}/status").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon:"))


def bytes_of(size: str) -> int | None:
    """A size such as "2GB" or "1.5 GiB" in bytes; None if it is written in another way."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmgt]?)(i?)b?\s*", size.lower())
    if match is None:
        return None
    number, prefix, binary = match.groups()
    return int(float(number) * (1024 if binary else 1000) ** " kmgt".index(prefix or " "))


def rows_of_batch(numbers: int) -> int:
    """Rows of a batch, fewer if they are long.

    Args:
        numbers: of the vectors of a row, float32.
    """
    return min(BATCH_ROWS, max(_BATCH_BYTES // (64 + 4 * numbers), 1))


@contextmanager
def engine_in_memory(memory_limit: str | None = None) -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB connection for registered tables only: it opens no file and never uses the disk.

    Args:
        memory_limit: of the engine, such as "256MB"; None for DuckDB's default.
    """
    connection = duckdb.connect(":memory:", config={**_CLOSED, "temp_directory": ""})
    try:
        if memory_limit is not None:
            _set_memory_limit(connection, memory_limit)
        _set_semantics(connection)
        _close(connection, (), None)
        yield connection
    finally:
        connection.close()


def as_numpy(column: "pa.Array") -> Array:
    """A column of numbers or truth values without missing ones, copied only if it must be.

    `pyarrow.Array.to_numpy` would import pandas, which takes longer than reading a small log.
    """
    if str(column.type) == "bool":
        return np.from_dlpack(column.cast("uint8")).view(np.bool_)
    return np.from_dlpack(column)


def as_arrow(numbers: IntArray) -> "pa.Array":
    """Whole numbers as a column; `pyarrow.array` would import pandas."""
    import pyarrow as pa

    buffer = pa.py_buffer(np.ascontiguousarray(numbers, dtype=np.int64))
    return pa.Array.from_buffers(pa.int64(), len(numbers), [None, buffer])


def _set_semantics(connection: duckdb.DuckDBPyConnection) -> None:
    """Make expressions mean the same in every connection and on every machine."""
    # In Jupyter without ipywidgets it is off already, and cannot be set.
    if connection.sql("SELECT current_setting('enable_progress_bar')").fetchall() != [(False,)]:
        connection.execute("SET enable_progress_bar = false")
    # A division by zero is NULL, and so is every comparison with it; infinity would be above every
    # threshold. The logarithm of a negative number is an error, for TRY, instead of NaN.
    connection.execute("SET error_on_division_by_zero = false")
    connection.execute("SET ieee_floating_point_ops = false")
    # What an expression computes twice DuckDB would compute once, but outside of its TRY.
    connection.execute("SET disabled_optimizers = 'common_subexpressions'")
    # Casts from TIMESTAMPTZ to TIMESTAMP use this zone.
    connection.execute("SET TimeZone = 'UTC'")
    # DuckDB's least(x, 5) is 5 if x is NULL, NaN or infinite: a video of unknown length would
    # count as watched five times. Here an undefined argument makes the result NULL.
    for name, sign in (("least", "<"), ("greatest", ">")):
        connection.execute(
            f"CREATE TEMP MACRO {name}(a, b) AS CASE WHEN isfinite(a::DOUBLE) AND "
            f"isfinite(b::DOUBLE) THEN CASE WHEN a {sign} b THEN a ELSE b END END, "
            f"(a, b, c) AS {name}({name}(a, b), c)"
        )
    # Tables read NaN as missing (`ucfrec.logs.binding.Table`).
    connection.execute("CREATE TEMP MACRO isnan(a) AS coalesce(system.main.isnan(a), true)")


def _close(connection: duckdb.DuckDBPyConnection, inputs: Iterable[Path], work: str | None) -> None:
    """Forbid access to other files and lock the settings; must come after every other setting."""
    # DuckDB first looks a path up as a glob pattern, then opens the file that it matches.
    allowed = {path for file in inputs for path in (str(file), glob_pattern(file))}
    paths = ", ".join(map(text, sorted(allowed)))
    if work is not None:
        connection.execute(f"SET allowed_directories = [{text(work)}]")
        connection.execute(f"SET allowed_paths = [{paths}]")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")
