"""Run the measurements of a benchmark, here or in parallel processes, resumably."""

import json
import shutil
import sys
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from ucfrec.errors import InputError
from ucfrec.processes import block_ctrl_c, interruptions_raised, pool_of_processes
from ucfrec.progress import progress
from ucfrec.provenance import config_hash, peak_memory_mib, reset_peak_memory
from ucfrec.results.rows import ResultRow, RowKey, append_rows, read_rows, remove_rows

Cell = TypeVar("Cell")


@dataclass(frozen=True)
class Measurement(Generic[Cell]):
    """How the cells of a benchmark are measured, by picklable (module-level) functions."""

    key: Callable[[Cell], RowKey]
    """Identifies the cell's rows among all others; `config_hash` is filled in by `run_grid`."""
    config: Callable[[Cell], Mapping[str, Any] | None]
    """Training configuration of the cell; None if nothing is trained."""
    measure: Callable[[Cell, RowKey], list[ResultRow]]
    """Measures the cell; returns its rows, all with the given key. Runs with one thread."""
    made: Callable[[Cell], Sequence[Path]] = lambda cell: ()
    """Folders of what a measurement makes and finds again: runs and shared stages."""


@dataclass(frozen=True)
class _Task(Generic[Cell]):
    """A cell to be measured."""

    cell: Cell
    key: RowKey
    config: Mapping[str, Any] | None
    measure: Callable[[Cell, RowKey], list[ResultRow]]
    results: Path


def run_grid(
    cells: Sequence[Cell],
    how: Measurement[Cell],
    results: Path,
    workers: int,
    describe: str = "benchmark",
    again: bool = False,
) -> list[ResultRow]:
    """Measure every cell that has no row in `results` yet.

    The rows of a cell are appended as soon as it is measured, so an interruption loses none. A cell
    that fails does not stop the others and is reported at the end. Cells with the same key are
    measured once.

    One worker, or an only cell, is measured in this process, whose peak memory during the cell is
    then the row's; a worker process has little else in it.

    Args:
        cells: picklable cells.
        results: file of result rows (JSON lines); its other rows are kept. No other process may
            fill it (`ucfrec.results.rows.benchmarking`).
        workers: number of cells that are measured at a time, each in a process of its own.
        describe: name of the benchmark in progress output.
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
    tasks: dict[str, _Task[Cell]] = {}
    for cell in cells:
        config = how.config(cell)
        if config is not None:
            config = json.loads(json.dumps(config))  # tuples become lists
        key = replace(how.key(cell), config_hash=None if config is None else config_hash(config))
        tasks.setdefault(str(key), _Task(cell, key, config, how.measure, results))
    if again:
        remove_rows(results, [task.key for task in tasks.values()])
        for folder in {folder for task in tasks.values() for folder in how.made(task.cell)}:
            shutil.rmtree(folder, ignore_errors=True)
    measured = read_rows(results)
    rows = {name: [row for row in measured if t.key.covers(row)] for name, t in tasks.items()}
    missing = [name for name in tasks if not rows[name]]
    # Seed by seed: when it is interrupted, its rows are whole tables of fewer seeds.
    missing.sort(key=lambda name: -1 if (seed := tasks[name].key.training_seed) is None else seed)
    print(
        f"{describe}: {len(tasks)} cells, {len(missing)} of them left to measure", file=sys.stderr
    )
    if not missing:
        return [row for group in rows.values() for row in group]
    errors: list[str] = []
    workers = min(workers, len(missing))
    measure = _measure_in_processes if workers > 1 else _measure_here
    outcomes = measure({name: tasks[name] for name in missing}, workers)
    with closing(outcomes), progress(len(missing), describe, "cells") as bar:
        for name, outcome in outcomes:
            if isinstance(outcome, BaseException):
                errors.append(f"{tasks[name].key}: {type(outcome).__name__}: {outcome}")
            else:
                rows[name] = outcome
            bar.update()
    if errors:
        raise InputError(
            f"{len(errors)} of {len(missing)} cells failed; run the command again to retry "
            f"them. The first: {errors[0]}"
        )
    return [row for group in rows.values() for row in group]


_Outcomes = Generator[tuple[str, list[ResultRow] | BaseException], None, None]
"""Name of a task, and its rows or why it has none. An interrupted benchmark ends at once; its cells
resume from their checkpoints."""


def _measure_in_processes(tasks: Mapping[str, _Task[Cell]], workers: int) -> _Outcomes:
    with pool_of_processes(workers, _use_one_thread) as pool:
        with block_ctrl_c():
            names = {pool.submit(_measure, task): name for name, task in tasks.items()}
        for done in as_completed(names):
            yield names[done], done.exception() or done.result()


def _measure_here(tasks: Mapping[str, _Task[Cell]], workers: int) -> _Outcomes:
    import torch  # takes a second, and is not needed to print tables

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for name, task in tasks.items():
            try:
                # What a library makes of an interruption is not a failure of the cell.
                with interruptions_raised():
                    rows = _measure(task)
            except Exception as error:
                yield name, error
            else:
                yield name, rows
    finally:
        torch.set_num_threads(threads)


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _measure(task: _Task[Cell]) -> list[ResultRow]:
    """Measure a cell, append its rows and return them."""
    reset_peak_memory()
    rows = task.measure(task.cell, task.key)
    peak = peak_memory_mib()
    rows = [replace(row, peak_memory_mib=peak) for row in rows]
    append_rows(task.results, rows, task.config)
    return rows


def chosen(known: Iterable[str], names: Sequence[str], what: str) -> list[str]:
    """The names of `known` that are in `names`, in the order of `known`.

    Args:
        names: selected names; empty for all.
        what: what the names stand for, for the message: "method", "table".

    Raises:
        InputError: `names` has a name that `known` lacks.
    """
    choices = list(known)
    if unknown := [name for name in names if name not in choices]:
        raise InputError(
            f"no {what} is called {', '.join(unknown)}; there are {', '.join(choices)}"
        )
    return [name for name in choices if name in names or not names]
