"""Many measurements, side by side and resumable: what every benchmark is run through."""

import json
import multiprocessing
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

import torch
from tqdm import tqdm

from ucfrec.errors import InputError

Cell = TypeVar("Cell")
Row = dict[str, Any]


def run_grid(
    cells: Sequence[Cell],
    work: Callable[[Cell], list[Row]],
    keys: Callable[[Cell], Mapping[str, Any]],
    results: Path,
    workers: int,
    describe: str = "benchmark",
) -> list[Row]:
    """Measure every cell that has no row in `results` yet; returns the rows of all, in order.

    A cell's rows are appended as soon as it is measured, so an interruption loses none. A cell that
    fails does not stop the others: it is reported when they are done.

    Args:
        cells: picklable.
        work: measures one cell, in a process of one thread; a function of a module.
        keys: what tells a cell's rows from all others; merged into them.
        results: JSON lines; rows of other cells in it are left alone.
        workers: processes.

    Raises:
        InputError: `results` holds something else, or cells failed.
    """
    known = read_rows(results)
    found = [_matching(known, keys(cell)) for cell in cells]
    missing = [at for at, rows in enumerate(found) if not rows]
    failed: list[str] = []
    left = f"{len(cells)} cells, {len(missing)} of them left to measure"
    print(f"{describe}: {left}", file=sys.stderr)
    if missing:
        results.parent.mkdir(parents=True, exist_ok=True)
        spawn = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, spawn, initializer=torch.set_num_threads, initargs=(1,))
        try:
            waiting: dict[Future[list[Row]], int] = {
                pool.submit(work, cells[at]): at for at in missing
            }
            for done in tqdm(
                as_completed(waiting), describe, len(waiting), unit="cell", disable=None
            ):
                own = dict(keys(cells[waiting[done]]))
                error = done.exception()
                if error is not None:
                    failed.append(f"{own}: {type(error).__name__}: {error}")
                    continue
                found[waiting[done]] = [row | own for row in done.result()]
                append_rows(results, found[waiting[done]])
        except BaseException:
            # Whoever stops a benchmark does not wait for its cells, which go on where they were.
            for child in multiprocessing.active_children():
                child.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)
    if failed:
        raise InputError(
            f"{len(failed)} of {len(missing)} cells failed; the same command tries them again. "
            f"The first: {failed[0]}"
        )
    return [row for rows in found for row in rows]


def read_rows(results: Path) -> list[Row]:
    """Rows of a file of JSON lines; none where it does not exist.

    Raises:
        InputError: a line is no row.
    """
    rows: list[Row] = []
    if not results.exists():
        return rows
    for number, line in enumerate(results.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            rows.append(dict(json.loads(line)))
        except (ValueError, TypeError):
            raise InputError(
                f"{results}, line {number}, is no result row; delete the line to measure it again"
            ) from None
    return rows


def append_rows(results: Path, rows: Sequence[Row]) -> None:
    """Add rows to a file of JSON lines, in one write."""
    with results.open("a", encoding="utf-8") as file:
        file.write("".join(json.dumps(row) + "\n" for row in rows))


def _matching(rows: Sequence[Row], wanted: Mapping[str, Any]) -> list[Row]:
    plain = json.loads(json.dumps(wanted))
    return [row for row in rows if all(row.get(name) == value for name, value in plain.items())]
