"""Run the measurements of a benchmark, here or in parallel processes, resumably."""

import json
import shutil
import sys
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ucfrec.benchmark.cells import Cell, Measurement, make_key
from ucfrec.errors import InputError
from ucfrec.processes import block_ctrl_c, interruptions_raised, pool_of_processes, progress
from ucfrec.provenance import config_hash, peak_memory_mib, reset_peak_memory
from ucfrec.results.rows import ResultRow, RowKey, append_rows, read_rows, remove_rows


@dataclass(frozen=True)
class _Task:
    """A cell to be measured."""

    cell: Cell
    key: RowKey
    config: Mapping[str, Any] | None
    how: Measurement
    results: Path

    def measure(self) -> list[ResultRow]:
        """Measure the cell, append its rows and return them."""
        reset_peak_memory()
        rows, peak = self.how.measure(self.cell, self.key), peak_memory_mib()
        rows = [replace(row, peak_memory_mib=peak) for row in rows]
        append_rows(self.results, rows, self.config)
        return rows


def run_grid(
    cells: Iterable[Cell],
    how: Measurement,
    results: Path,
    workers: int,
    describe: str = "benchmark",
    again: bool = False,
) -> list[ResultRow]:
    """The rows of cells, in their order; measures those that have none in `results`.

    The rows of a cell are appended as soon as it is measured, so an interruption loses none. A cell
    that fails does not stop the others and is reported at the end. One worker, or an only cell, is
    measured in this process.

    Args:
        results: file of result rows (JSON lines), which no other process may fill
            (`ucfrec.results.rows.benchmarking`).
        workers: number of cells that are measured at a time, each in a process of its own.
        describe: name of the benchmark in progress output.
        again: remove the rows, runs and shared stages of `cells` first.

    Raises:
        InputError: `workers` is below 1, a line of `results` is not a result row, or at least one
            cell failed.
    """
    if workers < 1:
        raise InputError(f"--workers is {workers}; at least one is needed")
    tasks: dict[str, _Task] = {}
    for cell in cells:
        # Of JSON, as a file of configurations has it.
        config = json.loads(json.dumps(how.config(cell)))
        key = replace(make_key(cell), config_hash=None if config is None else config_hash(config))
        tasks.setdefault(str(key), _Task(cell, key, config, how, results))
    if again:
        remove_rows(results, [task.key for task in tasks.values()])
        for task in tasks.values():
            for folder in (task.cell.run, task.cell.shared):
                if folder is not None:
                    shutil.rmtree(folder, ignore_errors=True)
    earlier = read_rows(results)
    rows = {name: [row for row in earlier if t.key.covers(row)] for name, t in tasks.items()}
    missing = {name: task for name, task in tasks.items() if not rows[name]}
    counts = f"{len(tasks)} cells, {len(missing)} of them left to measure"
    print(f"{describe}: {counts}", file=sys.stderr)
    if missing:
        rows |= _measure_all(missing, workers, describe)
    return [row for group in rows.values() for row in group]


def _measure_all(
    tasks: Mapping[str, _Task], workers: int, describe: str
) -> dict[str, list[ResultRow]]:
    """The rows of each task; raises an error at the end if one of them failed."""
    errors, rows, workers = [], {}, min(workers, len(tasks))

    def place(name: str) -> int:
        seed = tasks[name].key.training_seed
        return -1 if seed is None else seed

    # Seed by seed: when it is interrupted, its rows are whole tables of fewer seeds.
    ordered = {name: tasks[name] for name in sorted(tasks, key=place)}
    outcomes = _measure_in_processes(ordered, workers) if workers > 1 else _measure_here(ordered)
    with closing(outcomes), progress(len(tasks), describe, "cells") as bar:
        for name, outcome in outcomes:
            if isinstance(outcome, BaseException):
                errors.append(f"{tasks[name].key}: {type(outcome).__name__}: {outcome}")
            else:
                rows[name] = outcome
            bar.update()
    if errors:
        raise InputError(
            f"{len(errors)} of {len(tasks)} cells failed; run the command again to retry them. The "
            f"first: {errors[0]}"
        )
    return rows


_Outcomes = Generator[tuple[str, list[ResultRow] | BaseException], None, None]
"""Name of a task, and its rows or why it has none."""


def _measure_in_processes(tasks: Mapping[str, _Task], workers: int) -> _Outcomes:
    with pool_of_processes(workers, _use_one_thread) as pool:
        with block_ctrl_c():
            names = {pool.submit(task.measure): name for name, task in tasks.items()}
        for done in as_completed(names):
            yield names[done], done.exception() or done.result()


def _measure_here(tasks: Mapping[str, _Task]) -> _Outcomes:
    import torch  # takes a second, and is not needed to print tables

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for name, task in tasks.items():
            try:
                # What a library makes of an interruption is not a failure of the cell.
                with interruptions_raised():
                    rows = task.measure()
            except Exception as error:
                yield name, error
            else:
                yield name, rows
    finally:
        torch.set_num_threads(threads)


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def select_names(names: Iterable[str], selected: Sequence[str], what: str) -> list[str]:
    """Those of `names`, which stand for `what`, that are in `selected`; all if it is empty.

    Raises:
        InputError: `selected` has a name that `names` lacks.
    """
    choices = list(names)
    if unknown := [name for name in selected if name not in choices]:
        raise InputError(
            f"no {what} is called {', '.join(unknown)}; there are {', '.join(choices)}"
        )
    return [name for name in choices if name in selected or not selected]
