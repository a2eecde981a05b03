"""The array functions as others import them."""

import subprocess
import sys

import pytest

import ucfrec.off_policy


def test_every_public_name_is_there() -> None:
    for name in ucfrec.off_policy.__all__:
        assert getattr(ucfrec.off_policy, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ucfrec.off_policy.nothing


def test_array_functions_need_no_torch() -> None:
    code = (
        "from ucfrec.off_policy import diagnose, estimate, conclude; import sys; print(sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "numpy" in loaded.stdout
    assert "'torch'" not in loaded.stdout
    assert "'pandas'" not in loaded.stdout
