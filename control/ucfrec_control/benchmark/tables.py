"""Result rows of several seeds to the lines of a printed table."""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import grouped, paired_differences, summary
from ucfrec.reporting.tables import mean_and_sd, signed_difference

MEAN = "mean"


def score_table(rows: Sequence[ResultRow], checkpoint: str) -> list[dict[str, str]]:
    """A line a method: normalised scores as mean ± standard deviation over seeds, a column a
    dataset, and their mean over datasets where a method has rows of all (Table 1 of the paper).

    Methods without this checkpoint are shown by their last one: IQL and CQL keep no other.

    Args:
        rows: what `ucfrec_control.benchmark.plan.benchmark` returns.
        checkpoint: "last" or "best".
    """
    kept = [r for r in rows if r.checkpoint == checkpoint or "best_step" not in r.metrics]
    scores = {
        pair: [row.value for row in own]
        for pair, own in grouped(kept, lambda row: (row.method, row.task)).items()
    }
    tasks = list(dict.fromkeys(row.task for row in kept))
    lines = []
    for method in dict.fromkeys(row.method for row in kept):
        own = [scores.get((method, task), []) for task in tasks]
        line = {name: mean_and_sd(values) for name, values in zip(tasks, own, strict=True)}
        of_tasks = [summary(each).mean for each in own]
        mean = [summary(of_tasks).mean] if all(own) else []
        lines.append({"method": method, **line, MEAN: mean_and_sd(mean)})
    return lines


def over_seeds(
    lines: Sequence[Mapping[str, Any]], by: Sequence[str], values: Sequence[str]
) -> list[dict[str, Any]]:
    """A line for each combination of `by`, the `values` as mean ± standard deviation over seeds.

    Args:
        lines: as `ResultRow.as_line` makes them; a value may be missing or None.
    """
    groups = grouped(lines, lambda line: tuple(line[name] for name in by))
    return [
        {
            **dict(zip(by, key, strict=True)),
            **{n: mean_and_sd(o[n] for o in own if o.get(n) is not None) for n in values},
        }
        for key, own in groups.items()
    ]


def against_first(rows: Sequence[ResultRow], metrics: Sequence[str]) -> list[dict[str, str]]:
    """A line a dataset and later method: by how much its `metrics` differ from the first method's
    of the same seed, mean ± standard error over the seeds that both have.

    Args:
        rows: of one checkpoint.
    """
    groups = grouped(rows, lambda row: (row.task, row.method))
    first = rows[0].method
    lines = []
    for (task, method), own in groups.items():
        line = {"task": task, "method": method}
        for name in metrics:
            of_first = _by_seed(groups.get((task, first), ()), name)
            found = summary(paired_differences(_by_seed(own, name), of_first))
            if found.count > 1:
                line[name] = signed_difference(found)
        if method != first and len(line) == 2 + len(metrics):
            lines.append(line)
    return lines


def _by_seed(rows: Sequence[ResultRow], metric: str) -> dict[int | None, float]:
    return {row.training_seed: row.metrics[metric] for row in rows if metric in row.metrics}
