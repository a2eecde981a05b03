"""`ucfrec benchmark recommendation`: every table of it, resumable, cells side by side."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.grid import Row, run_grid
from ucfrec.plugins import Benchmark
from ucfrec_simulators.benchmark.cells import keys, measure
from ucfrec_simulators.benchmark.plan import BUDGETS, Plan
from ucfrec_simulators.benchmark.tables import (
    badge_table,
    method_table,
    sweep_table,
    target_table,
)

TABLES: Final = ("main", "badge", "sweeps")


def run(budget: str, tables: Sequence[str], out: Path, results: Path, workers: int) -> str:
    """Measure the cells of `tables` that have no row yet; returns the tables as Markdown.

    Raises:
        InputError: an unknown budget or table, or cells that failed.
    """
    if budget not in BUDGETS or not set(tables) <= set(TABLES):
        raise InputError(f"budgets are {', '.join(BUDGETS)}; tables are {', '.join(TABLES)}")
    plan = Plan(out / budget, BUDGETS[budget])
    parts = [f"{name} is left out: its files are not in the data folder" for name in plan.missing()]
    for table in tables:
        cells = list({str(keys(cell)): cell for cell in getattr(plan, table)()}.values())
        rows = run_grid(cells, measure, keys, results, workers, describe=table)
        parts += _SHOWN[table](rows)
    return "\n\n".join(parts)


def _main(rows: list[Row]) -> list[str]:
    return [
        f"## Methods\n\n{method_table(rows)}",
        f"## Target returns\n\n{target_table(rows)}",
    ]


def _sweeps(rows: list[Row]) -> list[str]:
    return [f"## Settings of UCF\n\n{sweep_table(rows)}"]


def _badge(rows: list[Row]) -> list[str]:
    return [f"## A badge that causes nothing\n\n{badge_table(rows)}"]


_SHOWN: Final = {"main": _main, "sweeps": _sweeps, "badge": _badge}

BENCHMARK: Final = Benchmark(
    summary="Table 2 of the paper with floors, its ablations, sweeps of UCF, a planted badge",
    tables=TABLES,
    run=run,
)
