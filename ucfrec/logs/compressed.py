"""Untrusted compressed logs: how large a small file may unfold."""

import gzip
import zlib
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError

_LARGE: Final = 2**28
"""Bytes to which any file may unfold."""
_RATIO: Final = 100
"""Bytes to which a byte of a larger one may: logs with an id and a time a row reach 20."""
_DEFLATE: Final = 1032
"""Most bytes to which gzip can unfold one."""
_LONGEST_LINE: Final = 2_000_000
"""Bytes, as of DuckDB."""
_LINES_WITHIN: Final = 2**30
"""Bytes in which long lines are looked for."""
_BLOCK: Final = 2**20


def require_short_lines(path: Path) -> None:
    """Check that no line of a CSV file is so long that DuckDB would refuse it after minutes.

    Args:
        path: of the file, which may be a gzip file; damage to it is left for its reader to find.

    Raises:
        InputError: a line has more than `_LONGEST_LINE` bytes.
    """
    length, line, read = 0, 1, 0
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            while read < _LINES_WITHIN and (block := file.read(_BLOCK)):
                read += len(block)
                ends = [end for end in (block.find(b"\n"), block.find(b"\r")) if end >= 0]
                if length + min(ends, default=len(block)) > _LONGEST_LINE:
                    raise InputError(
                        f"{path}, line {line:,}: has more than {_LONGEST_LINE:,} bytes; shorten "
                        "it, or write the log as Parquet"
                    )
                last = max(block.rfind(b"\n"), block.rfind(b"\r"))
                length = len(block) - 1 - last if ends else length + len(block)
                line += block.count(b"\n")
    except (EOFError, gzip.BadGzipFile, zlib.error):
        return


def require_plausible_size(path: Path) -> None:
    """Check that a gzip file does not unfold to fill the disk, by unfolding it without writing.

    Files that are small enough for any content are not read.

    Args:
        path: of the file; damage to it is left for its reader to find.

    Raises:
        InputError: it unfolds to over 256 MiB, and to over a hundred times its size.
    """
    size = path.stat().st_size
    most, unfolded = max(_LARGE, _RATIO * size), 0
    if _DEFLATE * size <= most:
        return
    block = bytearray(_BLOCK)
    try:
        with gzip.open(path) as file:
            while unfolded <= most and (read := file.readinto(block)):
                unfolded += read
    except (EOFError, gzip.BadGzipFile, zlib.error):
        return
    if unfolded > most:
        raise InputError(
            f"{path} unfolds to more than {most:,} bytes from {size:,}, so nearly all of its rows "
            "must be equal; remove the repetitions, or unfold it yourself"
        )
