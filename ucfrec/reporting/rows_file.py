"""Files of result rows: JSON lines, read and written here alone."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final

from ucfrec.errors import InputError
from ucfrec.files import atomic_file, file_lock
from ucfrec.provenance import config_hash
from ucfrec.reporting.result_row import ResultRow, RowKey, row_from_json

CONFIGURATIONS: Final = "configurations.jsonl"
"""Beside the rows: every configuration that they name by its hash, once."""
_WRITING, _MEASURING = ".writing.lock", ".measuring.lock"
"""Locks of the folder: of who appends to a file in it, and of who measures what."""


def read_rows(path: Path) -> list[ResultRow]:
    """Rows of a file; none where it does not exist.

    Raises:
        InputError: a line is no result row, or the file is no text.
    """
    return [row_from_json(value, f"{path}, line {n}") for n, value in read_lines(path)]


def read_lines(path: Path) -> list[tuple[int, object]]:
    """Number and content of every line of a file of JSON lines; none where it does not exist.

    Raises:
        InputError: a line is no JSON, or the file is no text.
    """
    found: list[tuple[int, object]] = []
    if not path.exists():
        return found
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except UnicodeDecodeError:
        raise InputError(f"{path} is no text in UTF-8, so it holds no result rows") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            found.append((number, json.loads(line)))
        except (ValueError, RecursionError):
            raise InputError(
                f"{path}, line {number} is no result row; delete the line to measure it again"
            ) from None
    return found


def append_rows(
    path: Path, rows: Sequence[ResultRow], config: Mapping[str, Any] | None = None
) -> None:
    """Add rows to a file, and their configuration to the one beside it.

    All of them appear or none, whatever interrupts it: the file is replaced by a longer one.
    Whoever else appends to a file of the folder waits.

    Args:
        config: what the rows' `config_hash` stands for.

    Raises:
        InputError: a row's numbers are not finite, or its `config_hash` is not that of `config`.
    """
    named = None if config is None else config_hash(config)
    if any(row.config_hash != named for row in rows):
        raise InputError(f"rows for {path} name a configuration that they were not measured with")
    for row in rows:
        row_from_json(json.loads(json.dumps(row.to_json())), f"a row for {path}")
    with file_lock(path.with_name(_WRITING)):
        if config is not None and named not in _hashes(path.with_name(CONFIGURATIONS)):
            _append(path.with_name(CONFIGURATIONS), [{"hash": named, "config": config}])
        _append(path, [row.to_json() for row in rows])


def read_configurations(folder: Path) -> dict[str, Mapping[str, Any]]:
    """The configurations that rows in `folder` name, by their hash.

    Raises:
        InputError: a line is none.
    """
    path = folder / CONFIGURATIONS
    found: dict[str, Mapping[str, Any]] = {}
    for number, value in read_lines(path):
        config = value.get("config") if isinstance(value, dict) else None
        if not isinstance(config, dict) or not isinstance(value, dict):
            raise InputError(f"{path}, line {number}, is no configuration")
        if value.get("hash") != config_hash(config):
            raise InputError(f"{path}, line {number}, has another hash than its configuration")
        found[config_hash(config)] = config
    return found


def latest(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Of rows that measure the same, with whatever code, data and configuration, the last."""
    last = {
        (*(getattr(row, name) for name in _SAME), str(sorted(row.conditions.items()))): row
        for row in rows
    }
    return list(last.values())


_SAME: Final = (
    *("suite", "table", "task", "method", "world", "checkpoint"),
    *("training_seed", "log_seed", "evaluation_seed"),
)


@contextmanager
def measuring(path: Path, key: RowKey, wait: bool) -> Iterator[bool]:
    """Hold the lock of one measurement for the rows file `path`, so that nobody measures it twice.

    Args:
        wait: until it is free, or give up at once.

    Yields:
        Whether the lock is held.
    """
    name = f"{path.name} {key}".encode()
    # One byte of the file stands for a measurement.
    byte = int.from_bytes(hashlib.sha256(name).digest()[:7])
    with file_lock(path.with_name(_MEASURING), byte, wait) as held:
        yield held


def _hashes(path: Path) -> set[object]:
    return {value.get("hash") for _, value in read_lines(path) if isinstance(value, dict)}


def _append(path: Path, values: Sequence[Mapping[str, Any]]) -> None:
    before = path.read_bytes() if path.exists() else b""
    if before and not before.endswith(b"\n"):
        before += b"\n"
    with atomic_file(path) as scratch, scratch.open("wb") as file:
        file.write(before)
        for value in values:
            line = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
            file.write(line.encode() + b"\n")
        _flush(file)


def _flush(file: IO[bytes]) -> None:
    file.flush()
    os.fsync(file.fileno())
