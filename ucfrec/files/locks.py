"""Claims: what only one process at a time may write, and the scratch that killed processes left.

A process that writes PATH holds a lock of the operating system (by `filelock`) on the file
`.NAME.ucfrec-lock` beside it and writes to the scratch `.NAME.ucfrec-partial`. The system releases
the lock when the process ends, also when it is killed; whoever gets the lock next knows that the
scratch is dead.
"""

import os
import secrets
import shutil
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from filelock import BaseFileLock, FileLock, Timeout

from ucfrec.errors import InputError, one_line

LOCK: Final = ".ucfrec-lock"
SCRATCH: Final = ".ucfrec-partial"
_PATIENCE: Final = 0.5
"""Seconds before a claim is given up: another process may just be checking whether its owner is
dead."""
_FOREVER: Final = -1.0
_COMMAND_LENGTH: Final = 160

_held: set[tuple[int, Path]] = set()
"""(process, path) of the claims that are held; a fork holds none of its parent's."""


def scratch_of(path: Path) -> Path:
    """Where the content of `path` is written before it is renamed; owned by whoever claims it."""
    return path.with_name(f".{path.name}{SCRATCH}")


def is_lock_or_scratch(name: str) -> bool:
    """Whether a file or folder of this name belongs to this module."""
    return name.startswith(".") and name.endswith((LOCK, SCRATCH))


@contextmanager
def claim(path: Path, wait: bool = False) -> Iterator[bool]:
    """Try to hold the claim on `path`; a process that holds it already holds it again.

    Args:
        path: need not exist; its folder is made if missing.
        wait: wait until the claim is free, instead of giving up.

    Yields:
        Whether the claim is held; always true if `wait` is.
    """
    key = (os.getpid(), _plain(path))
    if key in _held:
        yield True
        return
    new_folders = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = _acquire(_lock_of(path), _FOREVER if wait else _PATIENCE)
    if lock is None:
        yield False
        return
    _held.add(key)
    try:
        yield True
    finally:
        _held.discard(key)
        _release(lock)
        with suppress(OSError):  # those that are empty go; the inner ones come first
            for folder in new_folders:
                folder.rmdir()


@contextmanager
def lock_path(path: Path, use: str = "written", part: str = "") -> Iterator[None]:
    """Hold the claim on `path`, or say who does.

    Args:
        path: see `claim`.
        use: what the holder of the claim does with the path, for the message.
        part: claim this use of the path only; the path itself can be claimed by others.

    Raises:
        InputError: another process holds it; the message names that process.
    """
    part_path = path.with_name(f"{path.name}.{part}") if part else path
    with claim(part_path) as held:
        if not held:
            raise InputError(
                f"{path} is being {use} by {_holder(_lock_of(part_path))}; wait for it to end, or "
                "name another path"
            )
        yield


def remove_leftovers(folder: Path) -> None:
    """Remove the scratch and locks of processes that were killed while they wrote in `folder`."""
    for file in folder.glob(f".?*{LOCK}"):
        path = folder / file.name[1 : -len(LOCK)]
        if (os.getpid(), _plain(path)) in _held:
            continue
        with suppress(OSError):  # of another user
            if (lock := _acquire(file, 0.0)) is not None:
                remove(scratch_of(path))
                _release(lock)


def remove_leftovers_within(folder: Path) -> None:
    """`remove_leftovers` of `folder` and of every folder in it."""
    for name, _, _ in os.walk(folder):
        remove_leftovers(Path(name))


@contextmanager
def scratch_folder(parent: Path, name: str) -> Iterator[Path]:
    """Yield a new folder for scratch in `parent` that no other user can read; removed at the end.

    If this process is killed, the next one that calls this or `remove_leftovers` removes it.
    """
    path = parent / f"{name}-{secrets.token_hex(8)}"
    with lock_path(path):
        remove_leftovers(parent)
        scratch = scratch_of(path)
        scratch.mkdir(mode=0o700)
        try:
            yield scratch
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def remove(path: Path) -> None:
    """Remove a file, or a folder with all it holds, if it exists and can be removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _plain(path: Path) -> Path:
    """The same for every way to write one path."""
    return path.parent.resolve() / path.name


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.name}{LOCK}")


def _acquire(file: Path, seconds: float) -> BaseFileLock | None:
    """The held lock; None if another process holds it for longer than `seconds`."""
    # A generator that holds a claim may be closed by another thread.
    lock = FileLock(file, thread_local=False, poll_interval=0.01)
    try:
        lock.acquire(timeout=seconds)
        # On Windows no one else can read the first byte, which is what is locked.
        with file.open("r+b") as content:
            content.write(b" " + _this_process().encode())
            content.truncate()
    except Timeout:
        return None
    except BaseException:
        _release(lock)
        raise
    return lock


def _release(lock: BaseFileLock) -> None:
    # Whoever waits finds out that the file is gone. Windows removes it after the release.
    if lock.is_locked:
        with suppress(OSError):
            Path(lock.lock_file).unlink()
    lock.release()


def _this_process() -> str:
    command = " ".join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])[:_COMMAND_LENGTH]
    since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return f"process {os.getpid()} on {socket.gethostname()} ({command}) since {since}"


def _holder(file: Path) -> str:
    """The process that holds a lock, in words."""
    try:
        with file.open("rb") as content:
            content.seek(1)
            words = content.read(1024).decode(errors="replace")
    except OSError:
        words = ""
    return one_line(words) if words.startswith("process ") else "another process"
