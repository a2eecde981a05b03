"""`ucfrec-control figures`: every figure that stored runs and result rows have the data for."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from ucfrec.benchmark.tables import select_best_target
from ucfrec.errors import InputError, damage_explained
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.provenance import config_hash
from ucfrec.reporting.charts import save
from ucfrec.results.rows import ResultRow, read_results
from ucfrec.results.statistics import grouped
from ucfrec.runs.record import RUN
from ucfrec_control.benchmark.methods import ROBUSTNESS, SCORES
from ucfrec_control.benchmark.robustness import drops, loss_rises
from ucfrec_control.data.trajectories import control_source
from ucfrec_control.figures import diagnostics, plots
from ucfrec_control.training.evaluate import EVALUATE, method_of
from ucfrec_control.training.rl_baselines import read_run

LOWS = (0.0, 0.1, 0.2, 0.3, 0.4)
HIGHS = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
"""ρ_low and ρ_high of the acceptance heatmap."""

_COPIES = "a run with augmented episodes among --runs (`ucfrec-control train --policy ucf`)"
NEEDS = {
    "moves": _COPIES,
    "states": _COPIES,
    "acceptance": _COPIES,
    "attention": "a run of ucf or ucf-paper among --runs (`ucfrec-control train --policy ucf`)",
    "training": "a run among --runs (`ucfrec-control train`)",
    "returns": "rows of one dataset with two target returns or more among --results "
    "(`ucfrec-control evaluate --target … --target … --json`)",
    "scores": "rows of `ucfrec-control benchmark` among --results",
    "lambda": "rows of ucf with two weights of the mask loss or more among --results",
    "robustness-scores": "rows of `ucfrec-control robustness` among --results",
    "robustness-drops": "such rows with and without a distractor",
    "robustness-losses": "such rows with a distractor",
}
"""What every kind of figure is made of."""
_REMEDY = "measure it again"
_SWEPT = re.compile(r"(ucf-paper|ucf)(-lambda-.+)?$")
"""Methods that differ in λ only."""


@dataclass(frozen=True)
class _Plan:
    """A figure that there seems to be data for."""

    kind: str
    task: str
    draw: Callable[[], Figure]
    """Raises InputError where some of the data is missing after all."""


@dataclass(frozen=True)
class _Run:
    path: Path
    name: str
    """Its path below the folder that was given, the parts joined."""
    group: str
    """The same of the folder it lies in; of runs given by themselves, the dataset."""
    method: str
    """Runs of one group that have it in common differ in their seed only."""
    policy: str
    settings: str
    """Hash of the data and of all settings of a training but the seed."""
    task: str

    @property
    def title(self) -> str:
        return f"{plots.label(self.method)} on {self.task}"


def make_figures(
    runs: Sequence[Path], results: Sequence[Path], out: Path
) -> tuple[list[Path], list[str]]:
    """Draw all figures into `out`, as PNG and SVG.

    Where runs differ in their seed only, edits and attention are drawn of the first.

    Args:
        runs: run folders of `ucfrec-control`, or folders that hold some at any depth.
        results: JSON lines of `benchmark` and `robustness`, and JSON of `evaluate`.

    Returns:
        The files written, and a line for each figure that lacks its data.

    Raises:
        InputError: a folder or file is missing, or holds something else.
    """
    distinct_runs = _distinguish_runs([run for folder in runs for run in _runs(folder)])
    rows = [row for path in results for row in read_results(path)]
    plans = list(_plan_runs(distinct_runs))
    with damage_explained(", ".join(map(str, results)), _REMEDY):
        plans += _plan_rows(rows)
    missing = [f"{k}: needs {w}" for k, w in NEEDS.items() if k not in {p.kind for p in plans}]
    files, failed = _drawn(plans, out)
    return files, [*missing, *failed]


def make_row_figures(rows: Sequence[ResultRow], out: Path) -> list[Path]:
    """Draw what result rows alone have the data for; returns the files written.

    Args:
        rows: of `benchmark` or `robustness`.
    """
    return _drawn(list(_plan_rows(rows)), out)[0]


def _drawn(plans: Sequence[_Plan], out: Path) -> tuple[list[Path], list[str]]:
    """The files written, and a line for each figure that lacks its data."""
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


def _runs(folder: Path) -> Iterator[_Run]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of runs; check the path")
    for file in sorted(folder.rglob(RUN)):
        path, record = file.parent, read_run(file.parent)
        if "env_id" not in record.data.others:
            continue
        dataset, below = control_source(record.data, file), path.relative_to(folder)
        distracted = " with a distractor" if dataset.get("distractors") else ""
        yield _Run(
            path=path,
            name="-".join(below.parts) or path.resolve().name,
            group="-".join(below.parent.parts) or dataset["dataset"],
            method=method_of(record),
            policy=record.config.policy_name,
            settings=config_hash({**record.settings, "seed": None, "data": record.fingerprint}),
            task=f"{dataset['dataset']}{distracted}",
        )


def _distinguish_runs(runs: Sequence[_Run]) -> list[_Run]:
    """The runs, of which those with other settings go by their folder's name, less the seed."""
    distinct = []
    for run in runs:
        same = [r for r in runs if (r.group, r.method) == (run.group, run.method)]
        if len({sibling.settings for sibling in same}) > 1:
            folder = run.path.resolve().name
            run = replace(run, method=re.sub(r"(-[0-9a-f]{12})?-\d+$", "", folder))
        distinct.append(run)
    return distinct


def _plan_runs(runs: Sequence[_Run]) -> Iterator[_Plan]:
    for run, *_ in grouped(runs, lambda run: (run.group, run.method)).values():
        kinds = ("moves", "states", "acceptance") if diagnostics.is_augmented(run.path) else ()
        for kind in (*kinds, *(("attention",) if run.policy in ("ucf", "ucf-paper") else ())):
            yield _Plan(kind, run.name, partial(_draw_run, run, kind))
    for group, same in grouped(runs, lambda run: run.group).items():
        yield _Plan("training", group, partial(_training, same))


def _draw_run(run: _Run, kind: str) -> Figure:
    """A figure of the augmented episodes or of the attention of a run."""
    if kind == "attention":
        return plots.attention_map(diagnostics.attention(run.path), run.title)
    if kind == "states":
        factual, edited = diagnostics.edit_states(run.path)
        return plots.state_overlay(factual, edited, run.title)
    edges, counts, band = diagnostics.move_histogram(run.path)
    if kind == "moves":
        return plots.move_histogram(edges, counts, band, run.title)
    shares = diagnostics.acceptance_grid(run.path, LOWS, HIGHS)
    return plots.acceptance_heatmap(LOWS, HIGHS, shares, band, run.title)


def _training(runs: Sequence[_Run]) -> Figure:
    curves: dict[str, list[Mapping[int, float]]] = {}
    for run in runs:
        if logged := read_metrics(run.path / "policy").get("validation_loss"):
            curves.setdefault(run.method, []).append(logged)
    if not curves:
        raise InputError(f"{runs[0].path.parent}: no run has logged a validation loss yet")
    return plots.training_curves(curves, "validation loss of the action", runs[0].group)


def _plan_rows(rows: Sequence[ResultRow]) -> Iterator[_Plan]:
    yield from _plan_robustness([row for row in rows if row.suite == ROBUSTNESS])
    last = [row for row in rows if row.checkpoint == "last"]
    # Of several target returns the best, as the printed tables.
    tables = grouped(
        [row for row in last if row.suite == SCORES],
        lambda row: (row.conditions["budget"], row.table),
    )
    for (budget, table), table_rows in tables.items():
        lines = [row.as_line() for row in select_best_target(table_rows)]
        draw = partial(plots.score_panels, lines, f"{table}, budget {budget}")
        yield _Plan("scores", f"{budget}-{table}", draw)
    clean = [row for row in last if not row.details.get("distractors")]
    targets = [row for row in clean if row.suite == EVALUATE and row.target_return is not None]
    yield from _plan_targets(targets)
    swept = [
        row
        for row in clean
        if _SWEPT.match(row.method)
        and row.table in ("lambda", EVALUATE)
        and row.conditions.get("lambda_mask") is not None
    ]
    families = grouped(swept, lambda row: (row.conditions.get("budget", "rows"), _family(row)))
    for (budget, family), rows_of_family in families.items():
        lines = [row.as_line() for row in rows_of_family]
        if len({line["lambda_mask"] for line in lines}) > 1:
            name = f"{budget}-{family}".removesuffix("-ucf")
            yield _Plan("lambda", name, partial(plots.lambda_curves, lines))


def _family(row: ResultRow) -> str:
    """The method whose λ a row varies."""
    matched = _SWEPT.match(row.method)
    return "" if matched is None else matched[1]


def _plan_robustness(rows: Sequence[ResultRow]) -> Iterator[_Plan]:
    groups = grouped(rows, lambda row: (row.conditions["budget"], row.task))
    for (budget, task), task_rows in groups.items():
        lines = [row.as_line() for row in task_rows]
        for kind, bars, value, label in (
            ("scores", lines, "score", "normalised score"),
            ("drops", drops(task_rows), "drop", "loss (% of the clean score)"),
            ("losses", loss_rises(task_rows), "rise", "rise of the action loss (%)"),
        ):
            if bars:
                draw = partial(plots.robustness_bars, bars, value, label, task)
                yield _Plan(f"robustness-{kind}", f"{budget}-{task}", draw)


def _plan_targets(rows: Sequence[ResultRow]) -> Iterator[_Plan]:
    """Of the methods that were given more than one target return."""
    methods = grouped(rows, lambda row: (row.task, row.method)).values()
    several = [rows for rows in methods if len({row.target_return for row in rows}) > 1]
    shown = {id(row) for rows in several for row in rows}
    rows_with_targets = [row for row in rows if id(row) in shown]
    for task, task_rows in grouped(rows_with_targets, lambda row: row.task).items():
        lines = [row.as_line() for row in task_rows]
        yield _Plan("returns", task, partial(plots.return_curves, lines, task))
