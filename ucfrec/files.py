"""Atomic files and folders, JSON, and locks between processes."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ucfrec.errors import InputError


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a scratch folder next to `path` that is renamed to `path` when the block succeeds.

    If the block raises, the scratch folder is removed and `path` is not created.

    Raises:
        InputError: `path` exists already.
    """
    if path.exists():
        raise InputError(f"{path} exists already; remove it or name another output folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.partial-{os.getpid()}")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch
        scratch.rename(path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a scratch path next to `path` that replaces `path` when the block succeeds.

    If the block raises, the scratch file is removed and `path` keeps its old content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        yield scratch
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def write_json(path: Path, value: Mapping[str, Any] | list[Any]) -> None:
    """Write `value` as indented JSON, atomically; NaN and ±∞ become `NaN` and `Infinity`.

    Raises:
        TypeError: `value` holds an object that JSON cannot represent.
    """
    with atomic_file(path) as scratch:
        scratch.write_text(json.dumps(value, indent=2, allow_nan=True) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: the file is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not JSON: {error}") from None


@contextmanager
def file_lock(file: Path, byte: int = 0, wait: bool = True) -> Iterator[bool]:
    """Hold a lock on one byte of a file, shared by all processes that lock the same file.

    The operating system releases the lock when the process ends, also when it is killed. A process
    must not hold locks on two bytes of one file at a time: releasing one releases both (POSIX).

    Args:
        file: created, with its parent folders, if missing.
        byte: offset of the locked byte; locks on different bytes do not conflict.
        wait: block until the lock is free; if false, give up at once.

    Yields:
        Whether the lock is held; always true if `wait` is.
    """
    import fcntl  # not on Windows

    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a") as opened:
        try:
            fcntl.lockf(opened, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, byte)
        except (BlockingIOError, PermissionError):
            yield False
        else:
            yield True
