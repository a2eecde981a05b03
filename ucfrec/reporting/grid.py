"""Run the measurements of a benchmark in parallel processes, resumably."""

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Generic, TypeVar

from ucfrec.errors import InputError
from ucfrec.processes import pool_of_processes, without_ctrl_c
from ucfrec.progress import progress
from ucfrec.provenance import config_hash, peak_memory_mib, reset_peak_memory
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.reporting.rows_file import append_rows, measuring, read_rows

Cell = TypeVar("Cell")


@dataclass(frozen=True)
class Measurement(Generic[Cell]):
    """How the cells of a benchmark are measured, by picklable (module-level) functions."""

    key: Callable[[Cell], RowKey]
    """Identifies the cell's rows among all others; `config_hash` is filled in by `run_grid`."""
    config: Callable[[Cell], Mapping[str, Any] | None]
    """Training configuration of the cell; None if nothing is trained."""
    measure: Callable[[Cell, RowKey], list[ResultRow]]
    """Measures the cell; returns its rows, all with the given key. Runs in a one-thread process."""


@dataclass(frozen=True)
class _Task(Generic[Cell]):
    """A cell to be measured in a worker process."""

    cell: Cell
    key: RowKey
    config: Mapping[str, Any] | None
    how: Measurement[Cell]
    results: Path
    wait: bool


def run_grid(
    cells: Sequence[Cell],
    how: Measurement[Cell],
    results: Path,
    workers: int,
    describe: str = "benchmark",
    announce: Callable[[Sequence[Cell]], str] | None = None,
) -> list[ResultRow]:
    """Measure every cell that has no row in `results` yet.

    The rows of a cell are appended as soon as it is measured, so an interruption loses none. A cell
    that fails does not stop the others and is reported at the end. Cells with the same key are
    measured once, even if several processes share `results`.

    Args:
        cells: picklable cells.
        how: how a cell is measured.
        results: file of result rows (JSON lines); its other rows are kept.
        workers: number of worker processes.
        describe: name of the benchmark in progress output.
        announce: what to say of the cells that are left before they are measured.

    Returns:
        The rows of all cells, in the order of `cells`.

    Raises:
        InputError: a line of `results` is no result row, or at least one cell failed.
    """
    tasks: dict[str, _Task[Cell]] = {}
    for cell in cells:
        config = _plain(how.config(cell))
        named = None if config is None else config_hash(config)
        key = replace(how.key(cell), config_hash=named)
        tasks.setdefault(str(key), _Task(cell, key, config, how, results, wait=False))
    known = read_rows(results)
    found = {name: [row for row in known if t.key.covers(row)] for name, t in tasks.items()}
    missing = [name for name, rows in found.items() if not rows]
    counted = f"{len(tasks)} cells, {len(missing)} of them left to measure"
    print(f"{describe}: {counted}", file=sys.stderr)
    if missing:
        if announce is not None:
            said = announce([tasks[name].cell for name in missing])
            print(f"{describe}: {said}", file=sys.stderr)
        measured, failed = _measure_all({name: tasks[name] for name in missing}, workers, describe)
        found |= measured
        if failed:
            raise InputError(
                f"{len(failed)} of {len(missing)} cells failed; run the command again to retry "
                f"them. The first: {failed[0]}"
            )
    return [row for rows in found.values() for row in rows]


def _measure_all(
    tasks: Mapping[str, _Task[Cell]], workers: int, describe: str
) -> tuple[dict[str, list[ResultRow]], list[str]]:
    """Rows by task name, and an error line for every failed task."""
    found: dict[str, list[ResultRow]] = {}
    failed: list[str] = []
    waiting: dict[Future[list[ResultRow] | None], str] = {}
    # An interrupted benchmark ends at once; its cells resume from their checkpoints.
    with pool_of_processes(workers, _one_thread) as pool:
        with without_ctrl_c():
            waiting = {pool.submit(_measure, task): name for name, task in tasks.items()}
        # Tasks that another process is measuring are waited for at the end.
        elsewhere: dict[Future[list[ResultRow] | None], str] = {}
        with progress(len(tasks), describe, "cells") as bar:
            for done in chain.from_iterable(map(as_completed, (waiting, elsewhere))):
                name = waiting.get(done) or elsewhere[done]
                error = done.exception()
                rows = None if error else done.result()
                if error:
                    failed.append(f"{tasks[name].key}: {type(error).__name__}: {error}")
                elif rows is None:
                    again = replace(tasks[name], wait=True)
                    elsewhere[pool.submit(_measure, again)] = name
                    continue
                else:
                    found[name] = rows
                bar.update()
    return found, failed


def _one_thread() -> None:
    import torch  # takes a second, and is not needed to print tables

    torch.set_num_threads(1)


def _measure(task: _Task[Cell]) -> list[ResultRow] | None:
    """Measure a cell and append its rows, unless the file has them by now; returns the rows.

    Returns None if another process is measuring the cell and `task.wait` is false.
    """
    with measuring(task.results, task.key, task.wait) as held:
        if not held:
            return None
        rows = [row for row in read_rows(task.results) if task.key.covers(row)]
        if not rows:
            reset_peak_memory()
            rows = task.how.measure(task.cell, task.key)
            peak = peak_memory_mib()
            rows = [replace(row, peak_memory_mib=peak) for row in rows]
            append_rows(task.results, rows, task.config)
        return rows


def chosen(known: Iterable[str], wanted: Sequence[str], what: str) -> list[str]:
    """The names of `known` that are in `wanted`, in the order of `known`.

    Args:
        known: available names.
        wanted: selected names; empty for all.
        what: what the names stand for, for the message: "method", "table".

    Raises:
        InputError: `wanted` has a name that `known` lacks.
    """
    known = list(known)
    if unknown := [name for name in wanted if name not in known]:
        raise InputError(f"no {what} is called {', '.join(unknown)}; there are {', '.join(known)}")
    return [name for name in known if name in wanted or not wanted]


def _plain(config: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """A configuration after a JSON round trip, which turns tuples into lists."""
    plain: Mapping[str, Any] | None = json.loads(json.dumps(config))
    return plain
