"""Arrays on disk are arrays, of any shape, and leave no file."""

import tempfile
from pathlib import Path

import numpy as np
import pytest

from ucfrec.off_policy.on_disk import array_on_disk


def test_an_array_keeps_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    values = array_on_disk((1000, 3))
    assert values.shape == (1000, 3)
    assert not values.any()
    numbers = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    values[:] = numbers
    np.testing.assert_array_equal(values, numbers)
    assert not list(tmp_path.iterdir())
    assert array_on_disk((0, 3)).shape == (0, 3)
