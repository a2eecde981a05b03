"""Atomic files and folders, and JSON."""

import json
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import xxhash

from ucfrec.errors import InputError
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
            yield scratch
            scratch.rename(path)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def _require_absent(path: Path) -> None:
    if os.path.lexists(path):
        raise InputError(f"{path} exists already; remove it or name another output folder")


def require_other_files(written: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Check that files to write are none of those to read, and differ from each other.

    Raises:
        InputError: one would replace another.
    """
    taken = {path.resolve() for path in inputs}
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
            yield scratch
            scratch.replace(path)
        finally:
            remove(scratch)


def json_text(value: Any, **layout: Any) -> str:
    """`json.dumps` for every reader: NaN and ±∞, which JSON lacks, become null."""
    try:
        return json.dumps(value, allow_nan=False, **layout)
    except ValueError:
        return json.dumps(_finite(value), allow_nan=False, **layout)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Mapping[str, Any] | list[Any]) -> None:
    """Write `value` as indented JSON, atomically; see `json_text`."""
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
    value = _parse(path, _LARGEST_JSON, "JSON", json.loads)
    if isinstance(value, dict) and isinstance(value.get(CHECKSUM), str):
        stated = value.pop(CHECKSUM)
        if stated != content_checksum(value):
            raise InputError(
                f"{path} was changed after ucfrec wrote it: its checksum differs; restore the "
                f"file, or remove its entry {CHECKSUM!r} if you changed it on purpose"
            )
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of at most 16 MiB.

    Raises:
        InputError: the file is missing, cannot be read, or is not TOML.
    """
    import tomllib  # only a few commands read TOML

    value: dict[str, Any] = _parse(path, _LARGEST_TOML, "TOML", tomllib.loads)
    return value


def _parse(path: Path, largest: int, kind: str, parse: Callable[[str], Any]) -> Any:
    """Read a text file; reading a pipe or a device might never end, so it must be a regular one.

    Args:
        largest: size in bytes beyond which the file is refused.
    """
    if not path.is_file():
        what = "is not a regular file" if path.exists() else "does not exist"
        raise InputError(f"{path} {what}; check the path")
    if path.stat().st_size > largest:
        raise InputError(f"{path} has more than {largest:,} bytes; name another file")
    try:
        return parse(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text: {error}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not {kind}: {error}") from None


def content_checksum(value: Mapping[str, Any]) -> str:
    """XXH3 (64 bits, hexadecimal) of a JSON object, in whatever order and layout it is written."""
    text = json_text(value, sort_keys=True, separators=(",", ":"))
    return xxhash.xxh3_64_hexdigest(text.encode())
