"""Printed tables of result rows: mean and spread over seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import Summary, grouped, summary
from ucfrec.reporting.tables import NONE, mean_and_sd, signed_difference

MEAN = "mean"
NEAR = 0.05
"""Share of the best score by which scores may be lower and still count as level with it."""
_BySeed = Mapping[int | None, float]


def score_table(rows: Sequence[ResultRow], checkpoint: str) -> list[dict[str, str]]:
    """One line per method: number of seeds, or the fewest and most where datasets differ; then one
    column per dataset, normalised score, mean ± standard error over seeds (Table 1 of the paper);
    then the mean over datasets if the method has rows of all.

    As in the paper, the best of a column and what comes within 5% of it are `**bold**`.

    IQL and CQL keep only their last checkpoint, which is shown for both values of `checkpoint`.

    Args:
        rows: as returned by `ucfrec_control.benchmark.plan.benchmark`.
        checkpoint: "last" or "best".
    """
    kept = [r for r in rows if r.checkpoint == checkpoint or "best_step" not in r.metrics]
    values, tasks = _by_seed(kept, "score"), list(dict.fromkeys(row.task for row in kept))
    cells: dict[str, dict[str, Summary]] = {}
    for method in dict.fromkeys(row.method for row in kept):
        of_tasks = [values.get((method, task), {}) for task in tasks]
        own = [summary(seeds.values()) for seeds in of_tasks]
        cells[method] = dict(zip((*tasks, MEAN), (*own, _over_tasks(of_tasks)), strict=True))
    best = {
        name: max((c[name].mean for c in cells.values() if c[name].count), default=0.0)
        for name in (*tasks, MEAN)
    }
    return [
        {
            "method": method,
            "seeds": _seeds([own[task].count for task in tasks]),
            **{name: _score(each, best[name]) for name, each in own.items()},
        }
        for method, own in cells.items()
    ]


def _seeds(counts: Sequence[int]) -> str:
    fewest, most = min(filter(None, counts)), max(counts)
    return str(most) if fewest == most else f"{fewest}–{most}"


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


def difference_table(
    rows: Sequence[ResultRow], first: str, metric: str = "score"
) -> list[dict[str, str]]:
    """One line per method other than `first` and one column per dataset: difference of `metric` to
    `first` with the same seed, mean ± standard error over the seeds that both have; then the mean
    over datasets if both have rows of all.

    Args:
        rows: rows of one checkpoint.
        first: the reference.
        metric: name of a metric; of methods without it there is no line.
    """
    values, tasks = _by_seed(rows, metric), list(dict.fromkeys(row.task for row in rows))
    lines = []
    for method in dict.fromkeys(row.method for row in rows if row.method != first):
        of_tasks = [
            _less(values.get((method, task), {}), values.get((first, task), {})) for task in tasks
        ]
        found = [*(summary(own.values()) for own in of_tasks), _over_tasks(of_tasks)]
        if any(each.count for each in found):
            said = map(_difference, found)
            lines.append({"method": method, **dict(zip((*tasks, MEAN), said, strict=True))})
    return lines


def _by_seed(rows: Sequence[ResultRow], metric: str) -> dict[tuple[str, str], _BySeed]:
    """The metric, where a row has it, by training seed, of each method and dataset."""
    return {
        pair: {row.training_seed: row.metrics[metric] for row in group if metric in row.metrics}
        for pair, group in grouped(rows, lambda row: (row.method, row.task)).items()
    }


def _over_tasks(of_tasks: Sequence[_BySeed]) -> Summary:
    """Of the means over datasets of each seed; of one mean where datasets differ in their seeds."""
    seeds = set(of_tasks[0])
    if all(set(own) == seeds for own in of_tasks):
        return summary(summary(own[seed] for own in of_tasks).mean for seed in of_tasks[0])
    means = [summary(own.values()).mean for own in of_tasks]
    return summary([summary(means).mean] if all(of_tasks) else [])


def _less(values: _BySeed, others: _BySeed) -> _BySeed:
    return {seed: value - others[seed] for seed, value in values.items() if seed in others}


def _difference(differences: Summary) -> str:
    if differences.count > 1:
        return signed_difference(differences)
    return f"{differences.mean:+.3g}" if differences.count else NONE
