"""`ucfrec benchmark recommendation`: every table of it, resumable, cells side by side."""

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.plugins import Benchmark
from ucfrec.reporting.grid import Row, run_grid
from ucfrec_simulators.benchmark.cells import keys, measure
from ucfrec_simulators.benchmark.plan import BUDGETS, Plan
from ucfrec_simulators.benchmark.plots import (
    plot_distractor,
    plot_methods,
    plot_sweeps,
    plot_targets,
)
from ucfrec_simulators.benchmark.tables import (
    distractor_table,
    method_table,
    sweep_table,
    target_table,
)

TABLES: Final = ("main", "distractor", "sweeps")


def run(budget: str, tables: Sequence[str], out: Path, results: Path, workers: int) -> str:
    """Measure the cells of `tables` that have no row yet; returns the tables as Markdown.

    Pictures of them appear in `out/budget/plots` where matplotlib is installed.

    Raises:
        InputError: an unknown budget or table, or cells that failed.
    """
    if budget not in BUDGETS or not set(tables) <= set(TABLES):
        raise InputError(f"budgets are {', '.join(BUDGETS)}; tables are {', '.join(TABLES)}")
    plan = Plan(out / budget, BUDGETS[budget])
    parts = [f"{name} is left out: its files are not in the data folder" for name in plan.missing()]
    plotted = find_spec("matplotlib") is not None
    for table in tables:
        cells = list({str(keys(cell)): cell for cell in getattr(plan, table)()}.values())
        rows = run_grid(cells, measure, keys, results, workers, describe=table)
        for title, as_table, as_plots in _SHOWN[table]:
            parts.append(f"## {title}\n\n{as_table(rows)}")
            if plotted:
                as_plots(rows, out / budget / "plots")
    told = f"pictures: {out / budget / 'plots'}" if plotted else "no pictures: install matplotlib"
    return "\n\n".join([*parts, told])


_Shown = tuple[str, Callable[[Sequence[Row]], str], Callable[[Sequence[Row], Path], list[Path]]]
_SHOWN: Final[Mapping[str, tuple[_Shown, ...]]] = {
    "main": (
        ("Methods", method_table, plot_methods),
        ("Target returns", target_table, plot_targets),
    ),
    "sweeps": (("Settings of UCF", sweep_table, plot_sweeps),),
    "distractor": (("A distractor that causes nothing", distractor_table, plot_distractor),),
}

BENCHMARK: Final = Benchmark(
    summary="Table 2 of the paper with floors, its ablations, sweeps of UCF, a planted distractor",
    tables=TABLES,
    run=run,
)
