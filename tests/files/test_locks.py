"""One process at a time, and nothing left of those that were killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, atomic_folder
from ucfrec.files.locks import claim, lock_path, remove_leftovers, scratch_of

HOLD = """
import sys, time
from pathlib import Path
from ucfrec.files.atomic import atomic_folder, atomic_file
from ucfrec.files.locks import lock_path
path = Path(sys.argv[2])
with {"lock": lock_path, "folder": atomic_folder, "file": atomic_file}[sys.argv[1]](path) as made:
    if sys.argv[1] == "folder":
        (made / "half").write_text("written")
    if sys.argv[1] == "file":
        made.write_text("half written")
    print("held", flush=True)
    time.sleep(60)
"""


def holder(how: str, path: Path) -> subprocess.Popen[bytes]:
    """A process that holds the claim on `path` until it is killed."""
    started = subprocess.Popen([sys.executable, "-c", HOLD, how, path], stdout=subprocess.PIPE)
    assert started.stdout is not None
    assert started.stdout.readline() == b"held\n"
    return started


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("how", ["folder", "file"])
def test_the_holder_is_named_and_death_frees_its_claim_and_scratch(
    tmp_path: Path, how: str
) -> None:
    path = tmp_path / "out"
    other = holder(how, path)
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
        with claim(path) as held, claim(tmp_path / "made" / ".." / "made" / "out") as again:
            assert held
            assert again
        with claim(path.with_name("other")) as other:
            assert other
    assert names(tmp_path / "made") == ["out"]


def test_a_claim_that_writes_nothing_leaves_nothing(tmp_path: Path) -> None:
    with lock_path(tmp_path / "a" / "b" / "out"):
        assert (tmp_path / "a" / "b").is_dir()
    assert names(tmp_path) == []


def test_writers_of_one_file_wait_for_each_other(tmp_path: Path) -> None:
    path = tmp_path / "count"
    path.write_text("0")
    children = []
    for _ in range(3):
        child = os.fork()
        if child == 0:
            try:
                for _ in range(15):
                    with claim(path, wait=True):
                        count = int(path.read_text())
                        with atomic_file(path) as scratch:
                            scratch.write_text(str(count + 1))
                os._exit(0)
            finally:
                os._exit(1)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0] * 3
    assert path.read_text() == "45"
    assert names(tmp_path) == ["count"]


def test_killed_at_any_moment_a_folder_is_whole_and_the_next_writer_tidies(tmp_path: Path) -> None:
    for attempt in range(10):
        child = os.fork()
        if child == 0:
            try:
                with atomic_folder(tmp_path / "out") as scratch:
                    for name in range(200):
                        (scratch / str(name)).write_text("x")
                os._exit(0)
            finally:
                os._exit(1)
        time.sleep(0.002 * attempt)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        if (tmp_path / "out").exists():
            assert len(names(tmp_path / "out")) == 200
            (tmp_path / "out").rename(tmp_path / f"whole-{attempt}")
    with atomic_folder(tmp_path / "last"):
        pass
    assert not [name for name in names(tmp_path) if name.startswith(".")]


def test_a_lock_file_of_a_stranger_says_nothing_but_is_respected(tmp_path: Path) -> None:
    lock = tmp_path / ".out.ucfrec-lock"
    lock.write_bytes(b"\xff")
    with lock_path(tmp_path / "out"):
        assert b"process" in lock.read_bytes()
    other = holder("lock", tmp_path / "out")
    lock.write_bytes(b"\xff" * 5000)
    with (
        pytest.raises(InputError, match="is being written by another process; wait"),
        lock_path(tmp_path / "out"),
    ):
        raise AssertionError("the block must not run")
    other.kill()
    other.wait()
