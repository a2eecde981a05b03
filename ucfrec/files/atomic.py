"""Atomic files and folders, and JSON."""

import errno
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import xxhash

from ucfrec.errors import InputError, explain_os_error
from ucfrec.files.locks import claim, lock_path, remove, remove_leftovers, scratch_of

CHECKSUM: Final = "checksum"
"""Entry of a JSON object with the checksum of its other entries; see `content_checksum`."""
_LARGEST_JSON: Final = 2**30
_LARGEST_TOML: Final = 2**24


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a scratch folder next to `path` that is renamed to `path` when the block succeeds.

    If the block raises, the scratch folder is removed and `path` is not created. Scratch that
    killed processes left next to `path` is removed.

    Raises:
        InputError: `path` exists already, or another process is writing it.
    """
    _require_absent(path)
    with lock_path(path):
        _require_absent(path)
        remove_leftovers(path.parent)
        scratch = scratch_of(path)
        remove(scratch)
        scratch.mkdir()
        try:
            with _named_where_full(path):
                yield scratch
            _rename(scratch, path)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def _named_where_full(path: Path) -> Iterator[None]:
    """Name `path` in an error of a full disk, which names no file where an open one is written."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT) and error.filename is None:
            error.filename = str(path)
        raise


def _require_absent(path: Path) -> None:
    if os.path.lexists(path):
        raise InputError(f"{path} exists already; remove it or name another output folder")


def _rename(scratch: Path, path: Path) -> None:
    try:
        scratch.rename(path)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise
        raise InputError(
            f"{path} was made by another program meanwhile and stays as it is; name another output "
            "folder"
        ) from None


def require_other_files(written: Iterable[Path], read: Iterable[Path]) -> None:
    """Check that files to write are none of those to read, and differ from each other.

    Raises:
        InputError: one would replace another.
    """
    taken = {path.resolve() for path in read}
    for path in written:
        if path.resolve() in taken:
            raise InputError(f"{path} would be written over what is read; name another file")
        taken.add(path.resolve())


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a scratch path next to `path` that replaces `path` when the block succeeds.

    If the block raises, the scratch file is removed and `path` keeps its old content. Of two
    processes that write one file, the second waits for the first. Scratch that killed processes
    left next to `path` is removed.

    Raises:
        InputError: `path` is a folder.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder, a file is needed; name a file")
    with claim(path, wait=True):
        remove_leftovers(path.parent)
        scratch = scratch_of(path)
        remove(scratch)
        try:
            with _named_where_full(path):
                yield scratch
            os.replace(scratch, path)
        finally:
            remove(scratch)


def json_text(value: Any, **layout: Any) -> str:
    """`value` as JSON that every reader takes: NaN and ±∞, which JSON lacks, become null.

    Args:
        value: what `json.dumps` takes.
        layout: further arguments of `json.dumps`.

    Raises:
        TypeError: `value` holds an object that JSON cannot represent.
    """
    try:
        return json.dumps(value, allow_nan=False, **layout)
    except ValueError:
        return json.dumps(_finite(value), allow_nan=False, **layout)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Mapping[str, Any] | list[Any]) -> None:
    """Write `value` as indented JSON, atomically; see `json_text`.

    Raises:
        TypeError: `value` holds an object that JSON cannot represent.
    """
    with atomic_file(path) as scratch:
        scratch.write_text(json_text(value, indent=2) + "\n", encoding="utf-8")


def write_sealed_json(path: Path, value: Mapping[str, Any]) -> None:
    """`write_json` of an object, with its checksum as the entry `checksum`."""
    write_json(path, {**value, CHECKSUM: content_checksum(value)})


def read_json(path: Path) -> Any:
    """Read a JSON file; the entry `checksum` of `write_sealed_json` is verified and excluded.

    Raises:
        InputError: the file is missing, is not JSON, or was changed after it was sealed.
    """
    try:
        value = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not JSON: {_reason(error)}") from None
    if isinstance(value, dict) and isinstance(value.get(CHECKSUM), str):
        stated = value.pop(CHECKSUM)
        if stated != content_checksum(value):
            raise InputError(
                f"{path} was changed after ucfrec wrote it: its checksum differs; restore the "
                f"file, or remove its entry {CHECKSUM!r} if you changed it on purpose"
            )
    return value


def read_text(path: Path, largest: int = _LARGEST_JSON) -> str:
    """Read a text file that a person or a program wrote.

    Args:
        path: a regular file, as reading a pipe or a device might never end.
        largest: size in bytes beyond which the file is refused.

    Raises:
        InputError: the file is missing, cannot be read, is too large, or is not UTF-8.
    """
    try:
        if not path.is_file():
            kind = "is not a regular file" if path.exists() else "does not exist"
            raise InputError(f"{path} {kind}; check the path")
        if path.stat().st_size > largest:
            raise InputError(f"{path} has more than {largest:,} bytes; name another file")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text: {_reason(error)}") from None
    except OSError as error:
        raise InputError(explain_os_error(error)) from None


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of at most 16 MiB.

    Raises:
        InputError: the file is missing, cannot be read, or is not TOML.
    """
    import tomllib  # only a few commands read TOML

    try:
        return tomllib.loads(read_text(path, _LARGEST_TOML))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not TOML: {_reason(error)}") from None


def content_checksum(value: Mapping[str, Any]) -> str:
    """XXH3 (64 bits, hexadecimal) of a JSON object, in whatever order and layout it is written."""
    text = json_text(value, sort_keys=True, separators=(",", ":"))
    return xxhash.xxh3_64_hexdigest(text.encode())


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
