"""Measuring the cells of a control table."""

from collections.abc import Iterable
from operator import attrgetter
from pathlib import Path

from ucfrec.reporting.grid import Measurement, run_grid
from ucfrec.reporting.result_row import ResultRow
from ucfrec_control.benchmark.cells import Cell
from ucfrec_control.benchmark.estimate import announcement


def run_cells(
    cells: Iterable[Cell],
    how: Measurement[Cell],
    results: Path,
    workers: int,
    describe: str,
    again: bool = False,
) -> list[ResultRow]:
    """`ucfrec.reporting.grid.run_grid` of cells, whose time is announced.

    Seed by seed: when it is interrupted, its rows are a whole table of fewer seeds.
    """
    by_seed = sorted(cells, key=attrgetter("seed"))
    return run_grid(by_seed, how, results, workers, describe, announcement(workers), again)
