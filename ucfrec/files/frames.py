"""Write pandas data frames to Parquet."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec.files.atomic import atomic_file


def write_frames(
    out: Path, frames: Iterable[pd.DataFrame], about: Mapping[str, str] | None = None
) -> int:
    """Write `frames` one after the other as a single Parquet file, atomically.

    Args:
        about: added to the metadata of the schema.

    Returns:
        The number of rows.
    """
    rows, writer = 0, None
    with atomic_file(out) as scratch:
        for frame in frames:
            table = pa.Table.from_pandas(frame, preserve_index=False)
            table = table.replace_schema_metadata(
                {**(table.schema.metadata or {}), **(about or {})}
            )
            writer = writer or pq.ParquetWriter(scratch, table.schema)
            writer.write_table(table)
            rows += len(frame)
        if writer is not None:
            writer.close()
    return rows


def part_name(part: int) -> str:
    """Name of a part of a folder of Parquet files, whose names are in the order of the parts."""
    return f"part-{part:06}.parquet"
