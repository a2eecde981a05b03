"""Run the measurements of a benchmark, here or in parallel processes, resumably."""

import json
import shutil
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import Future, as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Generic, TypeVar

from ucfrec.errors import InputError
from ucfrec.processes import block_ctrl_c, interruptions_raised, pool_of_processes
from ucfrec.progress import progress
from ucfrec.provenance import config_hash, peak_memory_mib, reset_peak_memory
from ucfrec.results.row import ResultRow, RowKey
from ucfrec.results.rows_file import append_rows, measuring, read_rows, remove_rows

Cell = TypeVar("Cell")


def _nothing(cell: object) -> Sequence[Path]:
    return ()


@dataclass(frozen=True)
class Measurement(Generic[Cell]):
    """How the cells of a benchmark are measured, by picklable (module-level) functions."""

    key: Callable[[Cell], RowKey]
    """Identifies the cell's rows among all others; `config_hash` is filled in by `run_grid`."""
    config: Callable[[Cell], Mapping[str, Any] | None]
    """Training configuration of the cell; None if nothing is trained."""
    measure: Callable[[Cell, RowKey], list[ResultRow]]
    """Measures the cell; returns its rows, all with the given key. Runs with one thread."""
    made: Callable[[Cell], Sequence[Path]] = _nothing
    """Folders of what a measurement makes and finds again: runs and shared stages."""


@dataclass(frozen=True)
class _Task(Generic[Cell]):
    """A cell to be measured."""

    cell: Cell
    key: RowKey
    config: Mapping[str, Any] | None
    how: Measurement[Cell]
    results: Path
    wait: bool


_Outcome = tuple[str, list[ResultRow] | BaseException]
"""Name of a task, and its rows or why it has none."""


def run_grid(
    cells: Sequence[Cell],
    how: Measurement[Cell],
    results: Path,
    workers: int,
    describe: str = "benchmark",
    announce: Callable[[Sequence[Cell]], str] | None = None,
    again: bool = False,
) -> list[ResultRow]:
    """Measure every cell that has no row in `results` yet.

    The rows of a cell are appended as soon as it is measured, so an interruption loses none. A cell
    that fails does not stop the others and is reported at the end. Cells with the same key are
    measured once, even if several processes share `results`.

    One worker, or an only cell, is measured in this process, whose peak memory during the cell is
    then the row's; a worker process has little else in it.

    Args:
        cells: picklable cells.
        results: file of result rows (JSON lines); its other rows are kept.
        workers: number of cells that are measured at a time, each in a process of its own.
        describe: name of the benchmark in progress output.
        announce: what to say of the cells that are left before they are measured.
        again: remove the rows, runs and shared stages of `cells` first. An interrupted call is
            resumed without it.

    Returns:
        The rows of all cells, in the order of `cells`.

    Raises:
        InputError: `workers` is below 1, a line of `results` is not a result row, or at least one
            cell failed.
    """
    if workers < 1:
        raise InputError(f"--workers is {workers}; at least one is needed")
    tasks = _tasks(cells, how, results)
    if again:
        remove_rows(results, [task.key for task in tasks.values()])
        for made in {folder for task in tasks.values() for folder in how.made(task.cell)}:
            shutil.rmtree(made, ignore_errors=True)
    known = read_rows(results)
    found = {name: [row for row in known if t.key.covers(row)] for name, t in tasks.items()}
    missing = [name for name, rows in found.items() if not rows]
    # Seed by seed: when it is interrupted, its rows are whole tables of fewer seeds.
    missing.sort(key=lambda name: -1 if (seed := tasks[name].key.training_seed) is None else seed)
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


def _tasks(cells: Sequence[Cell], how: Measurement[Cell], results: Path) -> dict[str, _Task[Cell]]:
    """One task for each key, by its text."""
    tasks: dict[str, _Task[Cell]] = {}
    for cell in cells:
        config = how.config(cell)
        plain = None if config is None else json.loads(json.dumps(config))  # tuples become lists
        key = replace(how.key(cell), config_hash=None if plain is None else config_hash(plain))
        tasks.setdefault(str(key), _Task(cell, key, plain, how, results, wait=False))
    return tasks


def _measure_all(
    tasks: Mapping[str, _Task[Cell]], workers: int, describe: str
) -> tuple[dict[str, list[ResultRow]], list[str]]:
    """Rows by task name, and an error line for every failed task."""
    found: dict[str, list[ResultRow]] = {}
    failed: list[str] = []
    workers = min(workers, len(tasks))
    outcomes = _in_processes(tasks, workers) if workers > 1 else _here(tasks)
    with closing(outcomes), progress(len(tasks), describe, "cells") as bar:
        for name, outcome in outcomes:
            if isinstance(outcome, BaseException):
                failed.append(f"{tasks[name].key}: {type(outcome).__name__}: {outcome}")
            else:
                found[name] = outcome
            bar.update()
    return found, failed


# Tasks that another process is measuring are waited for at the end. An interrupted benchmark ends
# at once; its cells resume from their checkpoints.


def _in_processes(
    tasks: Mapping[str, _Task[Cell]], workers: int
) -> Generator[_Outcome, None, None]:
    waiting: dict[Future[list[ResultRow] | None], str] = {}
    with pool_of_processes(workers, _one_thread) as pool:
        with block_ctrl_c():
            waiting = {pool.submit(_measure, task): name for name, task in tasks.items()}
        elsewhere: dict[Future[list[ResultRow] | None], str] = {}
        for done in chain.from_iterable(map(as_completed, (waiting, elsewhere))):
            name = waiting.get(done) or elsewhere[done]
            error = done.exception()
            rows = None if error else done.result()
            if error is not None:
                yield name, error
            elif rows is not None:
                yield name, rows
            else:
                again = replace(tasks[name], wait=True)
                elsewhere[pool.submit(_measure, again)] = name


def _here(tasks: Mapping[str, _Task[Cell]]) -> Generator[_Outcome, None, None]:
    import torch  # takes a second, and is not needed to print tables

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        left = deque(tasks.items())
        while left:
            name, task = left.popleft()
            try:
                # What a library makes of an interruption is not a failure of the cell.
                with interruptions_raised():
                    rows = _measure(task)
            except Exception as error:
                yield name, error
            else:
                if rows is None:
                    left.append((name, replace(task, wait=True)))
                else:
                    yield name, rows
    finally:
        torch.set_num_threads(threads)


def _one_thread() -> None:
    import torch

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
        wanted: selected names; empty for all.
        what: what the names stand for, for the message: "method", "table".

    Raises:
        InputError: `wanted` has a name that `known` lacks.
    """
    known = list(known)
    if unknown := [name for name in wanted if name not in known]:
        raise InputError(f"no {what} is called {', '.join(unknown)}; there are {', '.join(known)}")
    return [name for name in known if name in wanted or not wanted]
