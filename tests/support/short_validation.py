"""Trainings of tests validate on fewer windows than others do; what they do with them is theirs."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ucfrec.runs import policy_fit

BATCHES = 3
"""Of windows; two processes divide them unevenly."""
ALL_BATCHES = policy_fit._VALIDATION_BATCHES
"""Where a command runs in another process, which validates on all of them."""


@contextmanager
def short_validation(batches: int = BATCHES) -> Iterator[None]:
    """Validate on this many batches in the block."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy_fit, "_VALIDATION_BATCHES", batches)
        yield
