"""The array functions as others import them."""

import subprocess
import sys

import ucfrec.off_policy


def test_array_functions_need_no_torch() -> None:
    names = ucfrec.off_policy.__all__
    code = f"from ucfrec.off_policy import {', '.join(names)}; import sys; print(sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert "numpy" in loaded
    assert "'torch'" not in loaded
    assert "'pandas'" not in loaded
