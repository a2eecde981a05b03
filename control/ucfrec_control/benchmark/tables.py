"""Printed tables of result rows: mean and spread over seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import Summary, grouped, paired_differences, summary
from ucfrec.reporting.tables import NONE, mean_and_sd, signed_difference

MEAN = "mean"
NEAR = 0.05
"""Share of the best score by which scores may be lower and still count as level with it."""


def score_table(rows: Sequence[ResultRow], checkpoint: str) -> list[dict[str, str]]:
    """One line per method and one column per dataset: normalised score, mean ± standard error over
    seeds, and the mean over datasets if the method has rows of all (Table 1 of the paper).

    As in the paper, the best of a column and what comes within 5% of it are `**bold**`.

    IQL and CQL keep only their last checkpoint, which is shown for both values of `checkpoint`.

    Args:
        rows: as returned by `ucfrec_control.benchmark.plan.benchmark`.
        checkpoint: "last" or "best".
    """
    kept = [r for r in rows if r.checkpoint == checkpoint or "best_step" not in r.metrics]
    scores = {
        pair: [row.value for row in group]
        for pair, group in grouped(kept, lambda row: (row.method, row.task)).items()
    }
    tasks = list(dict.fromkeys(row.task for row in kept))
    cells: dict[str, dict[str, Summary]] = {}
    for method in dict.fromkeys(row.method for row in kept):
        own = {task: summary(scores.get((method, task), ())) for task in tasks}
        complete = all(each.count for each in own.values())
        means = [each.mean for each in own.values()] if complete else []
        cells[method] = {**own, MEAN: summary([summary(means).mean] if means else [])}
    best = {
        name: max((c[name].mean for c in cells.values() if c[name].count), default=0.0)
        for name in (*tasks, MEAN)
    }
    return [
        {"method": method, **{name: _score(each, best[name]) for name, each in own.items()}}
        for method, own in cells.items()
    ]


def _score(scores: Summary, best: float) -> str:
    if not scores.count:
        return NONE
    error = f" ± {scores.standard_error:.2g}" if scores.count > 1 else ""
    text = f"{scores.mean:.1f}{error}"
    return f"**{text}**" if scores.mean >= best - NEAR * abs(best) else text


def of_best_target(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Rows of the target return with the highest mean over seeds, for each dataset, method and
    checkpoint."""
    kept: list[ResultRow] = []
    for group in grouped(rows, lambda row: (row.task, row.method, row.checkpoint)).values():
        targets = grouped(group, lambda row: row.target_return)
        means = {target: summary(row.value for row in own).mean for target, own in targets.items()}
        kept += targets[max(means, key=lambda target: means[target])]
    return kept


def over_seeds(
    lines: Sequence[Mapping[str, Any]], by: Sequence[str], values: Sequence[str]
) -> list[dict[str, Any]]:
    """One line per combination of `by`: `values` as mean ± standard deviation over seeds.

    Args:
        lines: as `ResultRow.as_line` returns them; a value may be missing or None.
        by: names of the columns to group by.
        values: names of the numeric columns.
    """
    groups = grouped(lines, lambda line: tuple(line[name] for name in by))
    return [
        {
            **dict(zip(by, key, strict=True)),
            **{
                n: mean_and_sd(each[n] for each in group if each.get(n) is not None) for n in values
            },
        }
        for key, group in groups.items()
    ]


def against(rows: Sequence[ResultRow], first: str, metrics: Sequence[str]) -> list[dict[str, str]]:
    """One line per dataset and other method: difference of `metrics` to the method `first` with the
    same seed, mean ± standard error over the seeds that both have.

    Args:
        rows: rows of one checkpoint.
        first: the reference.
        metrics: names of metrics; one that a method does not have is a dash.
    """
    groups = grouped(rows, lambda row: (row.task, row.method))
    lines = []
    for (task, method), group in groups.items():
        line = {"task": task, "method": method}
        for name in metrics:
            reference = _by_seed(groups.get((task, first), ()), name)
            difference = summary(paired_differences(_by_seed(group, name), reference))
            line[name] = signed_difference(difference) if difference.count > 1 else NONE
        if method != first and any(line[name] != NONE for name in metrics):
            lines.append(line)
    return lines


def _by_seed(rows: Sequence[ResultRow], metric: str) -> dict[int | None, float]:
    return {row.training_seed: row.metrics[metric] for row in rows if metric in row.metrics}
