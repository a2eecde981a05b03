"""Restoring the global random state, so that seeding inside a function does not affect callers."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def random_state_kept() -> Iterator[None]:
    """Restore the global generators of torch (every device), numpy and `random` on exit.

    The code inside may seed them and draw from them. Usable in a `with` statement and as the
    decorator `@random_state_kept()`.
    """
    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002
    devices = range(torch.cuda.device_count())
    try:
        with torch.random.fork_rng(devices=devices):
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002
