"""Run the measurements of a benchmark, here or in parallel processes, resumably."""

import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path

from ucfrec.benchmark.cells import Cell, Measurement, make_key
from ucfrec.errors import InputError
from ucfrec.processes import block_ctrl_c, interruptions_raised, pool_of_processes, progress
from ucfrec.provenance import config_hash, peak_memory_mib, reset_peak_memory
from ucfrec.results.rows import ResultRow, RowKey, append_rows, read_rows, remove_rows


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
    measured in this process. InputError if a line of `results` is not a result row, or at least one
    cell failed.

    Args:
        results: file of result rows (JSON lines), which no other process may fill
            (`ucfrec.results.rows.benchmarking`).
        workers: number of cells that are measured at a time, each in a process of its own.
        describe: name of the benchmark in progress output.
        again: remove the rows, runs and shared stages of `cells` first.
    """
    tasks: dict[str, tuple[RowKey, Cell]] = {}
    for cell in cells:
        config = how.config(cell)
        key = replace(make_key(cell), config_hash=None if config is None else config_hash(config))
        tasks.setdefault(str(key), (key, cell))
    if again:
        remove_rows(results, [key for key, _ in tasks.values()])
        for folder in {folder for _, cell in tasks.values() for folder in (cell.run, cell.shared)}:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
    earlier = read_rows(results)
    rows = {name: [r for r in earlier if key.covers(r)] for name, (key, _) in tasks.items()}
    # Seed by seed: when it is interrupted, its rows are whole tables of fewer seeds.
    missing = sorted(
        (name for name in tasks if not rows[name]),
        key=lambda name: tasks[name][0].training_seed or 0,
    )
    print(
        f"{describe}: {len(tasks)} cells, {len(missing)} of them left to measure", file=sys.stderr
    )
    if missing:
        calls = {}
        for name in missing:
            key, cell = tasks[name]
            calls[name] = partial(_measure, how.measure, results, key, cell)
        rows |= _measure_all(calls, workers, describe)
    return [row for group in rows.values() for row in group]


def _measure(
    measure: Callable[[Cell, RowKey], list[ResultRow]],
    results: Path,
    key: RowKey,
    cell: Cell,
) -> list[ResultRow]:
    """Measure a cell, append its rows and return them."""
    reset_peak_memory()
    rows, peak = measure(cell, key), peak_memory_mib()
    rows = [replace(row, peak_memory_mib=peak) for row in rows]
    append_rows(results, rows)
    return rows


_Call = Callable[[], list[ResultRow]]


def _measure_all(
    calls: Mapping[str, _Call], workers: int, describe: str
) -> dict[str, list[ResultRow]]:
    """The rows of each key; raises an error at the end if the call for one failed."""
    import torch  # takes a second, and is not needed to print tables

    errors, rows, workers = [], {}, min(workers, len(calls))

    def collect(key: str, call: _Call) -> None:
        try:
            # What a library makes of an interruption is not a failure of the cell.
            with interruptions_raised():
                rows[key] = call()
        except Exception as error:
            errors.append(f"{key}: {type(error).__name__}: {error}")
        bar.update()

    with progress(len(calls), describe, "cells") as bar:
        if workers > 1:
            with pool_of_processes(workers, partial(torch.set_num_threads, 1)) as pool:
                with block_ctrl_c():
                    keys = {pool.submit(call): key for key, call in calls.items()}
                for done in as_completed(keys):
                    collect(keys[done], done.result)
        else:
            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            try:
                for key, call in calls.items():
                    collect(key, call)
            finally:
                torch.set_num_threads(threads)
    if errors:
        raise InputError(
            f"{len(errors)} of {len(calls)} cells failed; run the command again to retry them. The "
            f"first: {errors[0]}"
        )
    return rows


def select_names(names: Iterable[str], selected: Sequence[str], what: str) -> list[str]:
    """Those of `names`, which stand for `what`, that are in `selected`; all if it is empty.
    InputError if `selected` has a name that `names` lacks."""
    choices = list(names)
    if unknown := [name for name in selected if name not in choices]:
        raise InputError(
            f"no {what} is called {', '.join(unknown)}; there are {', '.join(choices)}"
        )
    return [name for name in choices if name in selected or not selected]
