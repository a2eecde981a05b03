"""Outputs appear whole or not at all."""

import json
import math
import os
import stat
import subprocess
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.errors import InputError
from ucfrec.files import atomic
from ucfrec.files.atomic import (
    atomic_file,
    atomic_folder,
    claim,
    lock_path,
    read_json,
    remove_leftovers,
    scratch_of,
    write_json,
)
from ucfrec.fitting.checkpoint import save_tensors


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def forked(work: Callable[[], None]) -> int:
    """A child process that does the work, and ends with status 0 if that succeeds."""
    child, status = os.fork(), 1
    if child == 0:
        try:
            work()
            status = 0
        finally:
            os._exit(status)
    return child


def test_a_folder_that_exists_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("1")
    with pytest.raises(InputError, match="out exists already"), atomic_folder(tmp_path / "out"):
        raise AssertionError("the block must not run")
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "mine").read_text() == "1"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_block_that_raises_changes_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    (tmp_path / "a.txt").write_text("old")

    def write(open_scratch: Any, name: str) -> None:
        with open_scratch(tmp_path / name) as scratch:
            (scratch / "a" if scratch.is_dir() else scratch).write_text("half of the n")
            raise error

    for open_scratch, name in ((atomic_file, "a.txt"), (atomic_folder, "new/out")):
        with pytest.raises(error):
            write(open_scratch, name)
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.txt", {"a": object()})
    assert (tmp_path / "a.txt").read_text() == "old"
    assert names(tmp_path) == ["a.txt"]
    with atomic_file(tmp_path / "a.txt") as scratch:
        scratch.write_text("new")
        assert (tmp_path / "a.txt").read_text() == "old"
    assert (tmp_path / "a.txt").read_text() == "new"


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(st.dictionaries(st.text(), json_values) | st.lists(json_values))
def test_json_comes_back(tmp_path_factory: pytest.TempPathFactory, value: object) -> None:
    path = tmp_path_factory.getbasetemp() / "value.json"
    write_json(path, value)  # type: ignore[arg-type]
    assert read_json(path) == value


NOT_FINITE = {"nan": math.nan, "within": [{"inf": (-math.inf, np.float64("nan"))}], "one": 1.5}


@pytest.mark.parametrize("seal", [False, True])
def test_numbers_that_json_lacks_become_null(tmp_path: Path, seal: bool) -> None:
    write_json(tmp_path / "a.json", NOT_FINITE, seal)
    json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    expected = {"nan": None, "within": [{"inf": [None, None]}], "one": 1.5}
    assert read_json(tmp_path / "a.json") == expected


def test_reading_what_is_not_there_or_not_json(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.json does not exist"):
        read_json(tmp_path / "a.json")
    for content in (b"{", b"", b"\xff\xfe\x00"):
        (tmp_path / "a.json").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.json is not (JSON|UTF-8)") as caught:
            read_json(tmp_path / "a.json")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mask", [0o022, 0o027])
def test_whoever_may_read_a_record_may_read_its_tensors(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        write_json(tmp_path / "record.json", {})
        save_tensors(tmp_path / "weights.safetensors", {"w": torch.ones(2)}, {})
    finally:
        os.umask(before)
    modes = {stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes == {0o666 & ~mask}


HOLD = """
import sys, time
from pathlib import Path
from ucfrec.files.atomic import atomic_folder, atomic_file
with {"folder": atomic_folder, "file": atomic_file}[sys.argv[1]](Path(sys.argv[2])) as made:
    (made / "half" if made.is_dir() else made).write_text("half written")
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("how", ["folder", "file"])
def test_the_holder_is_named_and_death_frees_its_claim(tmp_path: Path, how: str) -> None:
    path = tmp_path / "out"
    other = subprocess.Popen([sys.executable, "-c", HOLD, how, path], stdout=subprocess.PIPE)
    assert other.stdout.readline() == b"held\n"
    said = rf"out is being trained by process {other.pid} on .+ since \d{{4}}-.+ UTC; wait for it"
    with pytest.raises(InputError, match=said), lock_path(path, "trained"):
        raise AssertionError("the block must not run")
    remove_leftovers(tmp_path)
    assert scratch_of(path).exists()
    assert other.poll() is None
    other.kill()
    other.wait()
    assert names(tmp_path)
    with atomic_folder(tmp_path / "next"):
        pass
    assert names(tmp_path) == ["next"]
    with lock_path(path):
        assert names(tmp_path) == [".out.ucfrec-lock", "next"]
    assert names(tmp_path) == ["next"]


def test_one_process_may_claim_within_its_claim(tmp_path: Path) -> None:
    path = tmp_path / "made" / "out"
    with lock_path(path):
        with atomic_folder(path) as scratch:
            (scratch / "a").write_text("1")
            assert not path.exists()
            assert scratch.parent == path.parent  # so that the last step is a rename on one system
        with claim(path) as held, claim(tmp_path / "made" / ".." / "made" / "out") as again:
            assert held
            assert again
        with claim(path.with_name("other")) as other:
            assert other
    assert names(tmp_path / "made") == ["out"]


def test_an_interruption_at_any_moment_leaves_nothing_at_the_end(tmp_path: Path) -> None:
    def interrupt(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename != atomic.__file__:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode" and next(moments, None) is None:
            sys.settrace(None)
            raise KeyboardInterrupt
        return interrupt

    for moment in count():
        moments = iter(range(moment))
        sys.settrace(interrupt)
        try:
            with atomic.scratch_folder(tmp_path, "rows") as scratch:
                (scratch / "row").touch()
            break
        except KeyboardInterrupt:
            atomic.release_locks()
            assert not names(tmp_path)
        finally:
            sys.settrace(None)
    assert moment > 100  # of some 600


def test_writers_of_one_file_wait_for_each_other(tmp_path: Path) -> None:
    path = tmp_path / "count"
    path.write_text("0")

    def count() -> None:
        for _ in range(15):
            with claim(path, wait=True):
                number = int(path.read_text())
                with atomic_file(path) as scratch:
                    scratch.write_text(str(number + 1))

    children = [forked(count) for _ in range(3)]
    assert [os.waitpid(child, 0)[1] for child in children] == [0] * 3
    assert path.read_text() == "45"
    assert names(tmp_path) == ["count"]
