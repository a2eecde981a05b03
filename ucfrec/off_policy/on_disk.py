"""Arrays that grow with the logs, in files that nobody else sees."""

import os
import tempfile

import numpy as np

from ucfrec.arrays import Float32Array


def array_on_disk(shape: tuple[int, int]) -> Float32Array:
    """An array of zeros whose memory the system can take back, writing it to a file without a name.

    Raises:
        OSError: the disk of the system's temporary folder is full.
    """
    if 0 in shape:
        return np.zeros(shape, dtype=np.float32)
    with tempfile.TemporaryFile(prefix="ucfrec-") as file:
        if hasattr(os, "posix_fallocate"):  # not on macOS
            # A full disk is an error now; later it would be the end of the process.
            os.posix_fallocate(file.fileno(), 0, 4 * shape[0] * shape[1])
        return np.memmap(file, np.float32, "r+", shape=shape)
