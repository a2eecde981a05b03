"""Atomic files and folders, claims on what only one process at a time may write, and JSON.

A process that writes PATH holds a lock of the operating system (by `filelock`) on the file
`.NAME.ucfrec-lock` beside it and writes to the scratch `.NAME.ucfrec-partial`. The system releases
the lock when the process ends, also when it is killed; whoever gets the lock next knows that the
scratch is dead, and removes it.
"""

import json
import os
import secrets
import shutil
import socket
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import xxhash
from filelock import BaseFileLock, FileLock, Timeout

from ucfrec.errors import InputError

LOCK = ".ucfrec-lock"
SCRATCH = ".ucfrec-partial"
_CHECKSUM = "checksum"
"""Entry of a JSON object with the checksum of its other entries."""
_PATIENCE = 0.5
"""Seconds before a claim is given up: another process may just be removing a dead one."""
_COMMAND_LENGTH = 160
_LARGEST_JSON = 2**30
_LARGEST_TOML = 2**24

_held: set[tuple[int, Path]] = set()
"""(process, path) of the claims that are held; a fork holds none of its parent's."""
_locks: set[BaseFileLock] = set()
"""Locks that this process holds or waits for; what an interruption leaves is released."""


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a scratch folder next to `path` that is renamed to `path` when the block succeeds.
    InputError if `path` exists already, or another process is writing it."""
    with lock_path(path):
        if os.path.lexists(path):
            raise InputError(f"{path} exists already; remove it or name another output folder")
        scratch = _clear_scratch(path)
        scratch.mkdir()
        yield scratch
        scratch.replace(path)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a scratch path next to `path` that replaces `path` when the block succeeds. Of two
    processes that write one file, the second waits. InputError if `path` is a folder."""
    if path.is_dir():
        raise InputError(f"{path} is a folder, a file is needed; name a file")
    with claim(path, wait=True):
        scratch = _clear_scratch(path)
        yield scratch
        scratch.replace(path)


@contextmanager
def scratch_folder(parent: Path, name: str) -> Iterator[Path]:
    """Yield a new folder in `parent` that no other user can read; removed at the end."""
    path = parent / f"{name}-{secrets.token_hex(8)}"
    with lock_path(path):
        scratch = _clear_scratch(path)
        scratch.mkdir(mode=0o700)
        yield scratch


def _clear_scratch(path: Path) -> Path:
    """The scratch of a claimed path, of which nothing is there; the claim removes it at its end."""
    remove_leftovers(path.parent)
    _remove(scratch_of(path))
    return scratch_of(path)


def scratch_of(path: Path) -> Path:
    """Where the content of `path` is written before it is renamed; owned by whoever claims it."""
    return path.with_name(f".{path.name}{SCRATCH}")


def require_other_files(written: Iterable[Path], inputs: Iterable[Path]) -> None:
    """InputError unless files to write are none of those to read, and differ from each other."""
    taken = {path.resolve() for path in inputs}
    for path in written:
        if path.resolve() in taken:
            raise InputError(f"{path} would be written over what is read; name another file")
        taken.add(path.resolve())


@contextmanager
def claim(path: Path, wait: bool = False) -> Iterator[bool]:
    """Try to hold the claim on `path`, which need not exist, or `wait` until it is free. A process
    that holds it already holds it again. Yields whether the claim is held."""
    key = _key_of(path)
    if key in _held:
        yield True
        return
    new_folders = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = _acquire(_lock_of(path), -1.0 if wait else _PATIENCE)
    if lock is None:
        yield False
        return
    try:
        _held.add(key)
        yield True
    finally:
        _held.discard(key)
        _remove(scratch_of(path))
        _release(lock)
        with suppress(OSError):  # those that are empty go; the inner ones come first
            for folder in new_folders:
                folder.rmdir()


@contextmanager
def lock_path(path: Path, use: str = "written", part: str = "") -> Iterator[None]:
    """Hold the claim on `path`, or on this `part` of its use only. InputError if another process
    holds it; the message names that process, and the `use` that it makes of the path."""
    part_path = path.with_name(f"{path.name}.{part}") if part else path
    with claim(part_path) as held:
        if held:
            yield
            return
        holder = "another process"
        with suppress(OSError), _lock_of(part_path).open("rb") as content:
            words = content.read(1024)[1:]
            if words.startswith(b"process "):
                holder = words.decode(errors="replace")
        raise InputError(
            f"{path} is being {use} by {holder}; wait for it to end, or name another path"
        )


def remove_leftovers(folder: Path, within: bool = False) -> None:
    """Remove what killed processes left in `folder`, and `within`, in every folder inside."""
    for file in [*folder.glob(f"{'**/' * within}.?*{LOCK}")]:
        _remove_leftover(file)


def release_locks() -> None:
    """Remove what interruptions of this process while claims began and ended have left."""
    _held.clear()
    while _locks:
        lock = _locks.pop()
        lock.release(force=True)
        _remove_leftover(Path(lock.lock_file))


def _remove_leftover(file: Path) -> None:
    path = file.with_name(file.name[1 : -len(LOCK)])
    if _key_of(path) in _held:  # some network file systems give a process its own locks again
        return
    with suppress(OSError):  # of another user
        if (lock := _acquire(file, 0.0)) is not None:
            _remove(scratch_of(path))
            _release(lock)


def _remove(path: Path) -> None:
    """Remove a file, or a folder with all it holds, if it exists and can be removed."""
    shutil.rmtree(path, ignore_errors=True)  # a file or link is left
    with suppress(OSError):
        path.unlink()


def _key_of(path: Path) -> tuple[int, Path]:
    return os.getpid(), path.parent.resolve() / path.name


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.name}{LOCK}")


def _acquire(file: Path, seconds: float) -> BaseFileLock | None:
    """The held lock; None if another process holds it for longer than `seconds`."""
    # A generator that holds a claim may be closed by another thread.
    lock = FileLock(file, thread_local=False, poll_interval=0.01)
    _locks.add(lock)
    try:
        lock.acquire(timeout=seconds)
        program = Path(sys.argv[0] or "python").name
        command = " ".join([program, *sys.argv[1:]])[:_COMMAND_LENGTH]
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        holder = f"process {os.getpid()} on {socket.gethostname()} ({command}) since {since}"
        # On Windows no one else can read the first byte, which is what is locked.
        with file.open("r+b") as content:
            content.write(b" " + holder.encode())
            content.truncate()
    except Timeout:
        _locks.discard(lock)
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
    _locks.discard(lock)


def json_text(value: Any, **layout: Any) -> str:
    """`json.dumps` for every reader: NaN and ±∞, which JSON lacks, become null."""
    try:
        return json.dumps(value, allow_nan=False, **layout)
    except ValueError:
        finite = json.loads(json.dumps(value), parse_constant=lambda _: None)
        return json.dumps(finite, allow_nan=False, **layout)


def write_json(path: Path, value: Mapping[str, Any] | list[Any], seal: bool = False) -> None:
    """Write `value` as indented JSON, atomically; an object to `seal` gets an entry `checksum`."""
    if seal and isinstance(value, Mapping):
        value = {**value, _CHECKSUM: _content_checksum(value)}
    with atomic_file(path) as scratch:
        scratch.write_text(json_text(value, indent=2) + "\n", encoding="utf-8")


def save_arrays(path: Path, arrays: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Write contiguous arrays and JSON metadata to safetensors, atomically; InputError if full."""
    from safetensors import SafetensorError  # imports NumPy
    from safetensors.numpy import save_file

    with atomic_file(path) as scratch:
        scratch.touch()
        mode = scratch.stat().st_mode
        try:
            # One entry: safetensors writes several in any order, and files of equal content are to
            # be equal.
            save_file(dict(arrays), scratch, metadata={"about": json.dumps(metadata)})
        except SafetensorError as error:
            raise InputError(
                f"{path} cannot be written ({error}); free disk space and run the command again"
            ) from None
        # safetensors restricts its files to their owner; give them the usual permissions.
        scratch.chmod(mode)


def read_json(path: Path) -> Any:
    """Read a JSON file; the entry `checksum` of a sealed object is verified and excluded.
    InputError if the file is missing, is not JSON, or was changed after it was sealed."""
    value = _parse(path, _LARGEST_JSON, "JSON", json.loads)
    if isinstance(value, dict) and isinstance(value.get(_CHECKSUM), str):
        stated = value.pop(_CHECKSUM)
        if stated != _content_checksum(value):
            raise InputError(
                f"{path} was changed after ucfrec wrote it: its checksum differs; restore the "
                f"file, or remove its entry {_CHECKSUM!r} if you changed it on purpose"
            )
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; errors as of `read_json`."""
    import tomllib  # only a few commands read TOML

    value: dict[str, Any] = _parse(path, _LARGEST_TOML, "TOML", tomllib.loads)
    return value


def require_file(path: Path, remedy: str) -> None:
    """Check that a file is there, and no pipe or device, reading which might never end."""
    if not path.is_file():
        what = "is not a regular file" if path.exists() else "does not exist"
        raise InputError(f"{path} {what}; {remedy}")


def _parse(
    path: Path,
    largest: int,
    kind: str,
    parse: Callable[[str], Any],
) -> Any:
    """Read a text file of at most so many bytes."""
    require_file(path, "check the path")
    if path.stat().st_size > largest:
        raise InputError(f"{path} has more than {largest:,} bytes; name another file")
    try:
        return parse(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text: {error}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not {kind}: {error}") from None


def _content_checksum(value: Mapping[str, Any]) -> str:
    """XXH3 (64 bits, hexadecimal) of a JSON object, in whatever order and layout it is written."""
    text = json_text(value, sort_keys=True, separators=(",", ":"))
    return xxhash.xxh3_64_hexdigest(text.encode())
