"""The DuckDB that logs are read with: closed to everything but its inputs and a scratch folder."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import duckdb

from ucfrec.errors import InputError
from ucfrec.logs.binding import glob_pattern, text

_CLOSED: Final = {
    "allow_community_extensions": False,
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    # Otherwise the name of a Python variable is a table.
    "python_enable_replacements": False,
}


@contextmanager
def engine(
    inputs: Iterable[Path], folder: Path, memory_limit: str | None = None
) -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB that works on disk.

    It opens the inputs and files of its own scratch folder, nothing else; it loads no extension;
    and its configuration cannot be changed any more. Every connection of ucfrec is made here.

    Args:
        inputs: files that will be read.
        folder: where it makes its scratch folder, removed at the end.
        memory_limit: e.g. "2GB"; None for DuckDB's own.

    Raises:
        InputError: the limit is none.
    """
    with TemporaryDirectory(prefix=".ucfrec-", dir=folder) as work:
        spill = str(Path(work) / "spill")
        connection = duckdb.connect(
            str(Path(work) / "rows.duckdb"), config={**_CLOSED, "temp_directory": spill}
        )
        try:
            try:
                if memory_limit is not None:
                    connection.execute("SET memory_limit = ?", [memory_limit])
            except duckdb.Error:
                raise InputError(f"memory_limit {memory_limit!r}: write e.g. 2GB") from None
            _settle(connection)
            _close(connection, inputs, work)
            yield connection
        finally:
            connection.close()


@contextmanager
def engine_in_memory() -> Iterator[duckdb.DuckDBPyConnection]:
    """The same for tables registered with it: it opens no file and never touches the disk."""
    connection = duckdb.connect(":memory:", config={**_CLOSED, "temp_directory": ""})
    try:
        _settle(connection)
        _close(connection, (), None)
        yield connection
    finally:
        connection.close()


def _settle(connection: duckdb.DuckDBPyConnection) -> None:
    """What expressions mean, the same in every engine and on every machine."""
    connection.execute("SET enable_progress_bar = false")
    connection.execute("SET error_on_division_by_zero = false")
    # Times with a zone are cast to times without one in this zone.
    connection.execute("SET TimeZone = 'UTC'")
    # SQL's own least(x, 5) is 5 where x is NULL, NaN or infinite: a video of unknown length
    # would count as watched five times. Undefined parts make a reward undefined instead.
    for name, sign in (("least", "<"), ("greatest", ">")):
        connection.execute(
            f"CREATE TEMP MACRO {name}(a, b) AS CASE WHEN isfinite(a::DOUBLE) AND "
            f"isfinite(b::DOUBLE) THEN CASE WHEN a {sign} b THEN a ELSE b END END, "
            f"(a, b, c) AS {name}({name}(a, b), c)"
        )


def _close(connection: duckdb.DuckDBPyConnection, inputs: Iterable[Path], work: str | None) -> None:
    """Shut the file system and lock every setting; later settings fail, so this comes last."""
    # A path is looked up as a pattern first, then opened as the file it stands for.
    allowed = {path for file in inputs for path in (str(file), glob_pattern(file))}
    paths = ", ".join(map(text, sorted(allowed)))
    if work is not None:
        connection.execute(f"SET allowed_directories = [{text(work)}]")
        connection.execute(f"SET allowed_paths = [{paths}]")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")
