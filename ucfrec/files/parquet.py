"""What untrusted Parquet files may claim, columns of ids, and writing tables."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ucfrec.arrays import Array
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, require_file

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

_FEW_ROWS = 1_000_000
_ROWS_PER_BYTE = 10
_REMEDY = "restore it, or make the store or run again"
_NO_THREAD = "Failed to launch worker thread"
"""How Arrow says that there is no memory for the stack of a thread."""


def require_plausible_rows(path: Path, rows: int) -> None:
    """Check that a Parquet file does not unfold into very many equal rows. InputError if it claims
    over a million rows, and over ten for each of its bytes, which can only be repetitions."""
    size = path.stat().st_size
    if rows > max(_FEW_ROWS, _ROWS_PER_BYTE * size):
        raise InputError(
            f"{path} claims {rows:,} rows in {size:,} bytes, so nearly all of them must be equal; "
            "remove the repetitions"
        )


def read_ids(path: Path, column: str) -> Array:
    """The ids in a column of a Parquet file, (n,) int64 or text; InputError if one is neither."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    require_file(path, _REMEDY)
    try:
        with pq.ParquetFile(path) as file:
            require_plausible_rows(path, file.metadata.num_rows)
            ids = file.read([column]).column(column)
    except InputError:
        raise
    except (pa.ArrowException, OSError, KeyError, ValueError, OverflowError) as error:
        if _NO_THREAD in str(error):
            raise MemoryError(str(error)) from None
        what = f"is damaged or has no column {column!r} ({error})"
        raise InputError(f"{path} {what}; {_REMEDY}") from None
    integers = pa.types.is_integer(ids.type)
    texts = pa.types.is_string(ids.type) or pa.types.is_large_string(ids.type)
    if ids.null_count or not (integers or texts):
        what = f"{ids.type} with {ids.null_count} missing values"
        raise InputError(f"{path}: {column} is {what}, not ids; {_REMEDY}")
    return np.asarray(ids, dtype=np.int64 if integers else None)


def require_table_names(paths: Iterable[Path | None]) -> None:
    """InputError unless tables to write end in .parquet, .csv, or nothing, for Parquet."""
    for path in paths:
        if path is not None and path.suffix.lower() not in ("", ".parquet", ".csv"):
            raise InputError(
                f"{path}: tables are written as Parquet or CSV; name a file that ends in .parquet "
                "or .csv"
            )


def table_writer(scratch: Path, out: Path, schema: "pa.Schema") -> Any:
    """A writer of tables to the scratch of a file, of the kind that the file's name says."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from pyarrow import csv

    require_table_names([out])
    if out.suffix.lower() != ".csv":
        return pq.ParquetWriter(scratch, schema)
    if nested := [field.name for field in schema if pa.types.is_nested(field.type)]:
        raise InputError(
            f"{out}: CSV has no lists, as in the column {nested[0]}; name a file that ends in "
            ".parquet"
        )
    return csv.CSVWriter(scratch, schema)


def write_frames(out: Path, frames: "Iterable[pd.DataFrame]") -> int:
    """Write `frames` one after the other as a single file, atomically; returns its rows."""
    import pyarrow as pa

    rows, writer = 0, None
    with atomic_file(out) as scratch:
        for frame in frames:
            table = pa.Table.from_pandas(frame, preserve_index=False)
            writer = writer or table_writer(scratch, out, table.schema)
            writer.write_table(table)
            rows += len(frame)
        if writer is not None:
            writer.close()
    return rows


def part_name(part: int) -> str:
    """Name of a part of a folder of Parquet files, whose names are in the order of the parts."""
    return f"part-{part:06}.parquet"
