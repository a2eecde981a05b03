"""Provenance: the recorded command without folders of the machine, and peak memory."""

import sys

import numpy as np
import pytest

from ucfrec.provenance import command_line, peak_memory_mib, reset_peak_memory, without_folders


@pytest.mark.parametrize(
    ("argument", "written"),
    [
        ("/home/me/data/log.parquet", "log.parquet"),
        ("/home/me/data/", "data"),
        ("--out=/home/me/runs", "--out=runs"),
        ("/home/a=b/runs", "runs"),
        ("~/runs", "runs"),
        (r"C:\Users\me\runs", "runs"),
        ("runs/benchmark", "runs/benchmark"),
        ("train.learning_rate=1e-3", "train.learning_rate=1e-3"),
        ("is_click / 2", "is_click / 2"),
        ("--reward=is_click/2", "--reward=is_click/2"),
        ("/", "/"),
        ("", ""),
    ],
)
def test_folders_of_a_machine_are_not_written_down(argument: str, written: str) -> None:
    assert without_folders(argument) == written


def test_a_command_is_its_name_and_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/bin/ucfrec", "train", "/home/me/store", "--seed", "3"])
    assert command_line() == "ucfrec train store --seed 3"


def test_peak_memory_is_of_what_was_done_since() -> None:
    reset_peak_memory()
    before = peak_memory_mib()
    large = np.ones(2**25)  # 256 MiB
    during = peak_memory_mib()
    assert during - before > 0.9 * large.nbytes / 2**20
    del large
    reset_peak_memory()
    if sys.platform == "linux":
        assert peak_memory_mib() < during - 100
