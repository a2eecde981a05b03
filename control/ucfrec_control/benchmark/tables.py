"""Printed tables of result rows: mean and spread over seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import grouped, paired_differences, summary
from ucfrec.reporting.tables import mean_and_sd, signed_difference

MEAN = "mean"


def score_table(rows: Sequence[ResultRow], checkpoint: str) -> list[dict[str, str]]:
    """One line per method and one column per dataset: normalised score, mean ± standard deviation
    over seeds, and the mean over datasets if the method has rows of all (Table 1 of the paper).

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
    lines = []
    for method in dict.fromkeys(row.method for row in kept):
        by_task = [scores.get((method, task), []) for task in tasks]
        line = {name: mean_and_sd(values) for name, values in zip(tasks, by_task, strict=True)}
        task_means = [summary(each).mean for each in by_task]
        mean = [summary(task_means).mean] if all(by_task) else []
        lines.append({"method": method, **line, MEAN: mean_and_sd(mean)})
    return lines


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


def against_first(rows: Sequence[ResultRow], metrics: Sequence[str]) -> list[dict[str, str]]:
    """One line per dataset and later method: difference of `metrics` to the first method with the
    same seed, mean ± standard error over the seeds that both have.

    Args:
        rows: rows of one checkpoint; the method of the first row is the reference.
        metrics: names of metrics.
    """
    groups = grouped(rows, lambda row: (row.task, row.method))
    first = rows[0].method
    lines = []
    for (task, method), group in groups.items():
        line = {"task": task, "method": method}
        for name in metrics:
            reference = _by_seed(groups.get((task, first), ()), name)
            difference = summary(paired_differences(_by_seed(group, name), reference))
            if difference.count > 1:
                line[name] = signed_difference(difference)
        if method != first and len(line) == 2 + len(metrics):
            lines.append(line)
    return lines


def _by_seed(rows: Sequence[ResultRow], metric: str) -> dict[int | None, float]:
    return {row.training_seed: row.metrics[metric] for row in rows if metric in row.metrics}
