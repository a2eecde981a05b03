"""`ucfrec-control figures`: every figure that stored runs and result rows have the data for."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from ucfrec.errors import InputError, damage_explained
from ucfrec.results.charts import save
from ucfrec.results.rows import ResultRow, read_results
from ucfrec.results.statistics import grouped
from ucfrec.runs.record import RUN
from ucfrec_control.benchmark.methods import ROBUSTNESS, SCORES
from ucfrec_control.benchmark.seeds import select_best_target
from ucfrec_control.data.trajectories import control_source
from ucfrec_control.figures import diagnostics, plots
from ucfrec_control.training.evaluate import EVALUATE, method_of
from ucfrec_control.training.rl_baselines import read_run

LOWS = (0.0, 0.1, 0.2, 0.3, 0.4)
HIGHS = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
"""ρ_low and ρ_high of the acceptance heatmap."""

_COPIES = "a run with augmented episodes among --runs (`ucfrec-control train --policy ucf-paper`)"
NEEDS = {
    "moves": _COPIES,
    "states": _COPIES,
    "acceptance": _COPIES,
    "attention": "a run of ucf or ucf-paper among --runs (`ucfrec-control train --policy ucf`)",
    "scores": "rows of `ucfrec-control benchmark` among --results",
    "lambda": "rows of ucf with two weights of the mask loss or more among --results",
    "robustness": "rows of `ucfrec-control robustness` among --results",
}
"""What every kind of figure is made of."""
_REMEDY = "measure it again"


@dataclass(frozen=True)
class Plan:
    """A figure that there seems to be data for."""

    kind: str
    task: str
    draw: Callable[[], Figure]
    """Raises InputError where some of the data is missing after all."""


def make_figures(
    runs: Sequence[Path], results: Sequence[Path], out: Path
) -> tuple[list[Path], list[str]]:
    """Draw all figures into `out`, as PNG and SVG. InputError if a folder or file is missing, or
    holds something else.

    Args:
        runs: run folders of `ucfrec-control`, or folders that hold some at any depth.
        results: JSON lines of `benchmark` and `robustness`, and JSON of `evaluate`.

    Returns:
        The files written, and a line for each figure that lacks its data.
    """
    rows = [row for path in results for row in read_results(path)]
    plans = [plan for folder in runs for plan in _plan_runs(folder)]
    with damage_explained(", ".join(map(str, results)), _REMEDY):
        plans += plan_rows(rows)
    missing = [f"{k}: needs {w}" for k, w in NEEDS.items() if k not in {p.kind for p in plans}]
    files, failed = draw_plans(plans, out)
    return files, [*missing, *failed]


def draw_plans(plans: Iterable[Plan], out: Path) -> tuple[list[Path], list[str]]:
    """Draw figures into `out`; returns the files written, and a line for each that lacks data."""
    files: list[Path] = []
    missing: list[str] = []
    for plan in plans:
        name = f"{plan.kind}-{plan.task}"
        try:
            # One figure that cannot be drawn does not keep the others from it.
            with damage_explained("what it is drawn from", _REMEDY):
                files += save(plan.draw(), out, name)
        except InputError as error:
            missing.append(f"{name}: {error}")
    return files, missing


def _plan_runs(folder: Path) -> Iterator[Plan]:
    """Figures of the augmented episodes and of the attention of the runs in a folder."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of runs; check the path")
    for file in sorted(folder.rglob(RUN)):
        run, record = file.parent, read_run(file.parent)
        if "env_id" not in record.data.others:
            continue
        kinds = ("moves", "states", "acceptance") if diagnostics.is_augmented(run) else ()
        if record.config.policy_name in ("ucf", "ucf-paper"):
            kinds = (*kinds, "attention")
        name = "-".join(run.relative_to(folder).parts) or run.resolve().name
        distracted = " with a distractor" if record.data.others.get("distractors") else ""
        dataset = control_source(record.data, file)["dataset"]
        title = f"{plots.label(method_of(record))} on {dataset}{distracted}"
        for kind in kinds:
            yield Plan(kind, name, partial(_draw_run, run, title, kind))


def _draw_run(run: Path, title: str, kind: str) -> Figure:
    if kind == "attention":
        return plots.attention_map(diagnostics.attention(run), title)
    if kind == "states":
        factual, edited = diagnostics.edit_states(run)
        return plots.state_overlay(factual, edited, title)
    edges, counts, band = diagnostics.move_histogram(run)
    if kind == "moves":
        return plots.move_histogram(edges, counts, band, title)
    shares = diagnostics.acceptance_grid(run, LOWS, HIGHS)
    return plots.acceptance_heatmap(LOWS, HIGHS, shares, band, title)


def plan_rows(rows: Sequence[ResultRow]) -> Iterator[Plan]:
    """Figures of rows of `benchmark`, `robustness` and `evaluate`."""
    robustness = [row for row in rows if row.suite == ROBUSTNESS]
    cases = grouped(robustness, lambda row: (row.conditions["budget"], row.task))
    for (budget, task), case in cases.items():
        bars = [row.as_line() for row in case]
        draw = partial(plots.robustness_bars, bars, "score", "normalised score", task)
        yield Plan("robustness", f"{budget}-{task}", draw)
    last = [row for row in rows if row.checkpoint == "last"]
    # Of several target returns the best, as the printed tables.
    tables = grouped(
        [row for row in last if row.suite == SCORES],
        lambda row: (row.conditions["budget"], row.table),
    )
    for (budget, table), table_rows in tables.items():
        lines = [row.as_line() for row in select_best_target(table_rows)]
        draw = partial(plots.score_panels, lines, f"{table}, budget {budget}")
        yield Plan("scores", f"{budget}-{table}", draw)
    clean = [row for row in last if not row.details.get("distractors")]
    swept = [
        row
        for row in clean
        if row.method.partition("-lambda-")[0] in ("ucf", "ucf-paper")
        and row.table in ("lambda", EVALUATE)
        and row.conditions.get("lambda_mask") is not None
    ]
    families = grouped(
        swept,
        lambda row: (row.conditions.get("budget", "rows"), row.method.partition("-lambda-")[0]),
    )
    for (budget, family), rows_of_family in families.items():
        lines = [row.as_line() for row in rows_of_family]
        if len({line["lambda_mask"] for line in lines}) > 1:
            name = f"{budget}-{family}".removesuffix("-ucf")
            yield Plan("lambda", name, partial(plots.lambda_curves, lines))
