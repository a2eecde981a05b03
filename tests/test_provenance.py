"""What a result records of its origin: no folders of a machine, and the memory of its own work."""

import subprocess
import sys

import pytest

from ucfrec.provenance import command_line, shorten_paths


@pytest.mark.parametrize(
    ("argument", "written"),
    [
        ("/home/me/data/log.parquet", "log.parquet"),
        ("--out=/home/me/runs", "--out=runs"),
        ("/home/a=b/runs", "runs"),
        ("~/runs", "runs"),
        (r"C:\Users\me\runs", "runs"),
        ("runs/benchmark", "runs/benchmark"),
        ("--reward=is_click/2", "--reward=is_click/2"),
        ("/", "/"),
        ("", ""),
    ],
)
def test_folders_of_a_machine_are_not_written_down(argument: str, written: str) -> None:
    assert shorten_paths(argument) == written


def test_a_command_is_its_name_and_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/bin/ucfrec", "train", "/home/me/store", "--seed", "3"])
    assert command_line() == "ucfrec train store --seed 3"


_PEAKS = """
import numpy as np
from ucfrec.provenance import peak_memory_mib, reset_peak_memory
reset_peak_memory()
print(peak_memory_mib())
large = np.ones(2**25)
print(peak_memory_mib())
del large
reset_peak_memory()
print(peak_memory_mib())
"""


def test_peak_memory_is_of_what_was_done_since() -> None:
    """In a process of its own: a test session's heap has free pages to hide an array in."""
    printed = subprocess.check_output([sys.executable, "-c", _PEAKS], text=True)
    before, during, after = map(float, printed.split())
    assert during - before > 0.9 * 256
    if sys.platform == "linux":
        assert after < during - 100
