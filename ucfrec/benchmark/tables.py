"""Tables of result rows: means and spreads over logs and seeds, and differences to a method."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd, signed_difference
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import Summary, grouped, summary

DISTRACTOR_RATES: Final = (None, 0.0, 1.0)
"""Probability that the distractor is on in an evaluation; None: an environment without a
distractor."""
OURS: Final = "ucf"
MEAN: Final = "mean"
NEAR: Final = 0.05
"""Share of the best score by which scores may be lower and still count as level with it."""
_BySeed = Mapping[tuple[int | None, int | None], float]
"""Values by the seeds of the log and of the training."""
_SHOWN: Final = ("R_cum", "R_avg_pooled", "R_avg_episode", "length")


def method_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per environment and method, in the order of the rows (Tables 2 and 3 of the paper).

    Mean ± standard deviation over logs and training seeds. `estimate` is the return of the
    chosen rule in the user model that was fitted to the log. `− ucf` is the return less that of UCF
    of the same log and seed: mean ± standard error over the pairs, and in brackets over the means
    of logs, which counts what logs differ by.
    """
    columns = (*_SHOWN, "coverage", "target", "estimate")
    head = ("environment", "method", "logs × seeds", *columns, f"− {OURS}")
    lines, rows = [], select_checkpoint(rows, checkpoint)
    less = difference_to_ours(rows)
    for (environment, method), group in grouped(rows, _line).items():
        spread = [mean_and_sd(numbers(group, name)) for name in (*_SHOWN, "coverage")]
        chosen = (_targets(group), mean_and_sd(numbers(group, "estimated_value")))
        lines.append((environment, method, len(group), *spread, *chosen, less[environment, method]))
    return markdown_table(head, lines)


def difference_to_ours(rows: Sequence[ResultRow]) -> dict[tuple[str, str], str]:
    """By (environment, method): its return less that of UCF, as in `method_table`; a dash for
    UCF."""
    texts: dict[tuple[str, str], str] = {}
    for environment, group in grouped(rows, lambda row: str(row.environment)).items():
        values = {
            name: {_seeds(row): row.value for row in rows_of_method}
            for name, rows_of_method in grouped(group, lambda row: row.method).items()
        }
        ours = values.get(OURS, {})
        texts |= {
            (environment, name): NONE if name == OURS else _format_difference(_less(seeds, ours))
            for name, seeds in values.items()
        }
    return texts


def sweep_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per environment and setting of UCF: return, validation loss and acceptance rate."""
    head = ("environment", "setting", "logs × seeds", "R_cum", "validation loss", "acceptance")
    lines, metrics = [], ("R_cum", "validation_loss", "acceptance")
    groups = grouped(select_checkpoint(rows, checkpoint), _line)
    for (environment, method), group in groups.items():
        spread = [mean_and_sd(numbers(group, name)) for name in metrics]
        lines.append((environment, method, len(group), *spread))
    return markdown_table(head, lines)


def distractor_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per environment, target and method: returns without, with it off, and with it on.

    "off" and "on" are of policies trained with the distractor. `drop` is by how many percent the
    return with the distractor off is below that of the policy trained without a distractor.
    """

    def key(row: ResultRow) -> tuple[str, float, str]:
        # Environments together, the largest target first; methods stay in their order.
        return str(row.environment), -float(str(row.conditions["quantiles"])), row.method

    groups = grouped(select_checkpoint(rows, checkpoint), key)
    lines = []
    for (environment, quantile, method), group in sorted(
        groups.items(), key=lambda item: item[0][:2]
    ):
        by_pair = [
            {_seeds(row): row.value for row in group if row.conditions["distractor"] == rate}
            for rate in DISTRACTOR_RATES
        ]
        pairs = [pair for pair in by_pair[0] if all(pair in values for values in by_pair)]
        if not pairs:  # an environment in which no distractor was planted
            continue
        clean, off, on = ([values[pair] for pair in pairs] for values in by_pair)
        drop = [100 * (1 - with_it / without) for with_it, without in zip(off, clean, strict=True)]
        spread = [mean_and_sd(values) for values in (clean, off, on, drop)]
        lines.append((environment, f"{-quantile:g}", method, len(pairs), *spread))
    head = ("environment", "target quantile", "method", "logs × seeds")
    columns = ("no distractor", "distractor off", "distractor on", "drop, %")
    return markdown_table((*head, *columns), lines)


def select_checkpoint(rows: Sequence[ResultRow], checkpoint: str) -> list[ResultRow]:
    """The rows of built-in policies, and those of one checkpoint of trained ones."""
    return [row for row in rows if row.checkpoint in (None, checkpoint)]


def numbers(rows: Sequence[ResultRow], name: str) -> list[float]:
    """Values of metric `name` of the rows that have it."""
    return [row.metrics[name] for row in rows if name in row.metrics]


def score_table(rows: Sequence[ResultRow], checkpoint: str) -> list[dict[str, str]]:
    """One line per method: number of seeds, or the fewest and most where datasets differ; then one
    column per dataset, normalised score, mean ± standard error over seeds (Table 1 of the paper);
    then the mean over datasets if the method has rows of all.

    As in the paper, the best of a column and what comes within 5% of it are `**bold**`.

    IQL and CQL keep only their last checkpoint, which is shown for both values of `checkpoint`.

    Args:
        rows: of several tasks, with the metric `score`.
        checkpoint: "last" or "best".
    """
    rows = [r for r in rows if r.checkpoint == checkpoint or "best_step" not in r.metrics]
    values, tasks = _group_by_seed(rows, "score"), list(dict.fromkeys(row.task for row in rows))
    cells: dict[str, dict[str, Summary]] = {}
    for method in dict.fromkeys(row.method for row in rows):
        of_tasks = [values.get((method, task), {}) for task in tasks]
        scores = [summary(seeds.values()) for seeds in of_tasks]
        scores.append(_summarise_tasks(of_tasks))
        cells[method] = dict(zip((*tasks, MEAN), scores, strict=True))
    best = {
        name: max((c[name].mean for c in cells.values() if c[name].count), default=0.0)
        for name in (*tasks, MEAN)
    }
    return [
        {
            "method": method,
            "seeds": _format_count([scores[task].count for task in tasks]),
            **{name: _format_score(score, best[name]) for name, score in scores.items()},
        }
        for method, scores in cells.items()
    ]


def _format_count(counts: Sequence[int]) -> str:
    fewest, most = min(filter(None, counts)), max(counts)
    return str(most) if fewest == most else f"{fewest}–{most}"


def _format_score(scores: Summary, best: float) -> str:
    if not scores.count:
        return NONE
    error = f" ± {scores.standard_error:.2g}" if scores.count > 1 else ""
    text = f"{scores.mean:.1f}{error}"
    return f"**{text}**" if scores.mean >= best - NEAR * abs(best) else text


def of_best_target(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Rows of the target return with the highest mean over seeds, for each dataset, method and
    checkpoint."""
    best: list[ResultRow] = []
    for group in grouped(rows, lambda row: (row.task, row.method, row.checkpoint)).values():
        targets = grouped(group, lambda row: row.target_return)
        best += max(targets.values(), key=lambda same: summary(row.value for row in same).mean)
    return best


def over_seeds(
    lines: Sequence[Mapping[str, Any]], by: Sequence[str], values: Sequence[str]
) -> list[dict[str, Any]]:
    """One line per combination of `by`: `values` as mean ± standard deviation over seeds.

    Args:
        lines: as `ResultRow.as_line` returns them; a value may be missing or None.
        by: names of the columns to group by.
    """
    groups = grouped(lines, lambda line: tuple(line[name] for name in by))
    return [
        {
            **dict(zip(by, key, strict=True)),
            **{
                n: mean_and_sd(line[n] for line in group if line.get(n) is not None) for n in values
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
        metric: name of a metric; of methods without it there is no line.
    """
    values, tasks = _group_by_seed(rows, metric), list(dict.fromkeys(row.task for row in rows))
    lines = []
    for method in dict.fromkeys(row.method for row in rows if row.method != first):
        of_tasks = [
            _less(values.get((method, task), {}), values.get((first, task), {})) for task in tasks
        ]
        if any(of_tasks):
            texts = [*map(_format_difference, of_tasks), _format_signed(_summarise_tasks(of_tasks))]
            lines.append({"method": method, **dict(zip((*tasks, MEAN), texts, strict=True))})
    return lines


def _group_by_seed(rows: Sequence[ResultRow], metric: str) -> dict[tuple[str, str], _BySeed]:
    """The metric, where a row has it, by seeds, of each method and task."""
    return {
        pair: {_seeds(row): row.metrics[metric] for row in group if metric in row.metrics}
        for pair, group in grouped(rows, lambda row: (row.method, row.task)).items()
    }


def _seeds(row: ResultRow) -> tuple[int | None, int | None]:
    return row.log_seed, row.training_seed


def _summarise_tasks(of_tasks: Sequence[_BySeed]) -> Summary:
    """Of the means over tasks of each seed; of one mean where tasks differ in their seeds."""
    first = of_tasks[0]
    if all(task.keys() == first.keys() for task in of_tasks):
        return summary(summary(task[seed] for task in of_tasks).mean for seed in first)
    means = [summary(task.values()) for task in of_tasks]
    return summary([summary(task.mean for task in means).mean] if all(of_tasks) else [])


def _less(values: _BySeed, reference: _BySeed) -> _BySeed:
    """By how much `values` exceed those of the same seeds in `reference`; a value that no log or
    seed changes is compared with each."""
    if values.keys() == {(None, None)}:
        values = dict.fromkeys(reference, *values.values())
    return {
        seeds: value - reference[seeds] for seeds, value in values.items() if seeds in reference
    }


def _format_difference(differences: _BySeed) -> str:
    """Mean ± standard error over all; with several logs, in brackets that over means of logs."""
    text = _format_signed(summary(differences.values()))
    of_logs = grouped(differences.items(), lambda item: item[0][0]).values()
    over_logs = summary(summary(value for _, value in log).mean for log in of_logs)
    return text if over_logs.count < 2 else f"{text} ({over_logs.standard_error:.2g})"


def _format_signed(differences: Summary) -> str:
    if differences.count > 1:
        return signed_difference(differences)
    return f"{differences.mean:+.3g}" if differences.count else NONE


def _line(row: ResultRow) -> tuple[str, str]:
    return str(row.environment), row.method


def _targets(rows: Sequence[ResultRow]) -> str:
    chosen = {f"{row.target_return:g}" for row in rows if row.target_return is not None}
    return ", ".join(sorted(chosen, key=float)) or NONE
