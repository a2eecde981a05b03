"""Read and write files of result rows (JSON lines)."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, read_json, write_json
from ucfrec.files.locks import claim, lock_path, remove_leftovers
from ucfrec.provenance import config_hash
from ucfrec.results.row import ResultRow, RowKey, row_from_json

CONFIGURATIONS: Final = "configurations.jsonl"
"""File next to the rows with each of their configurations, by hash."""


def read_rows(path: Path) -> list[ResultRow]:
    """Read the rows of a file; none if it does not exist.

    Raises:
        InputError: a line is not a result row, or the file is not UTF-8 text.
    """
    return [row_from_json(value, f"{path}, line {n}") for n, value in read_lines(path)]


def read_results(path: Path) -> list[ResultRow]:
    """Read the rows of JSON lines, or of a JSON list (`.json`) as commands write with `--json`.

    Raises:
        InputError: the file is missing or has other content.
    """
    if path.suffix != ".json":
        if not path.exists():
            raise InputError(f"{path} does not exist; check the path")
        return read_rows(path)
    rows = read_json(path)
    if not isinstance(rows, list):
        raise InputError(f"{path} holds no list of result rows; name a file that --json wrote")
    return [row_from_json(row, f"{path}, row {n}") for n, row in enumerate(rows, start=1)]


def write_results(path: Path, rows: Sequence[ResultRow]) -> None:
    """Write rows as a JSON list, for `read_results`."""
    write_json(path, [row.to_json() for row in rows])


def read_lines(path: Path) -> list[tuple[int, object]]:
    """Read (line number, JSON value) of every line that is not blank; none if there is no file.

    Raises:
        InputError: a line is not JSON, or the file is not UTF-8 text.
    """
    values: list[tuple[int, object]] = []
    if not path.exists():
        return values
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text; name a file of result rows") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            values.append((number, json.loads(line)))
        except (ValueError, RecursionError):
            raise InputError(
                f"{path}, line {number} is not a result row; delete the line to measure it again"
            ) from None
    return values


def append_rows(
    path: Path, rows: Sequence[ResultRow], config: Mapping[str, Any] | None = None
) -> None:
    """Append rows to a file, and their configuration to `configurations.jsonl` next to it.

    Atomic: after an interruption either all rows are in the file or none. Other processes that
    append to a file of the folder wait.

    Args:
        path: file of result rows; made if missing.
        config: configuration with the rows' `config_hash`; None for rows without one.

    Raises:
        InputError: a row has a number that is not finite, or another `config_hash` than `config`.
    """
    digest = None if config is None else config_hash(config)
    if any(row.config_hash != digest for row in rows):
        raise InputError(f"rows for {path} have the hash of another configuration; pass their own")
    for row in rows:
        row_from_json(json.loads(json.dumps(row.to_json())), f"a row for {path}")
    configurations = path.with_name(CONFIGURATIONS)
    with claim(configurations, wait=True):
        configured = [value for _, value in read_lines(configurations) if isinstance(value, dict)]
        if config is not None and digest not in [value.get("hash") for value in configured]:
            _append(configurations, [{"hash": digest, "config": config}])
    with claim(path, wait=True):
        _append(path, [row.to_json() for row in rows])


def remove_rows(path: Path, keys: Sequence[RowKey]) -> None:
    """Remove the rows of some measurements from a file; atomic, other rows stay as they are."""
    with claim(path, wait=True):
        rows = read_rows(path)
        remaining = [row for row in rows if not any(key.covers(row) for key in keys)]
        if len(remaining) < len(rows):
            _write(path, b"", [row.to_json() for row in remaining])


def latest(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """The last row of each measurement, regardless of data and configuration."""
    last = {
        (*(getattr(row, name) for name in _SAME), str(sorted(row.conditions.items()))): row
        for row in rows
    }
    return list(last.values())


_SAME: Final = (
    *("suite", "table", "task", "method", "environment", "checkpoint"),
    *("training_seed", "log_seed", "evaluation_seed"),
)


@contextmanager
def benchmarking(path: Path) -> Iterator[None]:
    """Let no other command measure for the file `path` of result rows.

    Raises:
        InputError: another command does; the message names it.
    """
    with lock_path(path, "filled", part="benchmark"):
        remove_leftovers(path.parent)
        yield


def _append(path: Path, values: Sequence[Mapping[str, Any]]) -> None:
    head = path.read_bytes() if path.exists() else b""
    if head and not head.endswith(b"\n"):
        head += b"\n"
    _write(path, head, values)


def _write(path: Path, head: bytes, values: Sequence[Mapping[str, Any]]) -> None:
    with atomic_file(path) as scratch, scratch.open("wb") as file:
        file.write(head)
        for value in values:
            line = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
            file.write(line.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
