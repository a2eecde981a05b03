"""Compressed logs of strangers: how large a small file may unfold."""

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
_BLOCK: Final = 2**20


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
