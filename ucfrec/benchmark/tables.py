"""Tables and plots of result rows: means and spreads over logs and seeds, and differences to a
method."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ucfrec.reporting.charts import LIGHT, PLAIN, file_style, save
from ucfrec.reporting.charts import OURS as OURS_COLOR
from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import Summary, grouped, summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DISTRACTOR_NAMES: Final = ("no distractor", "distractor off", "distractor on")
DISTRACTOR_RATES: Final = (None, 0.0, 1.0)
"""Probability that the distractor is on in an evaluation, for each of these names; None: an
environment without a distractor."""
OURS: Final = "ucf"
MEAN: Final = "mean"
NEAR: Final = 0.05
"""Share of the best score by which scores may be lower and still count as level with it."""
_Column = str | Callable[[Sequence[ResultRow]], str]
"""A metric, whose mean and spread is shown, or what makes the text for the rows of a line."""
_BySeed = dict[tuple[int | None, int | None], float]
"""Values by the seeds of the log and of the training."""


def method_table(rows: Sequence[ResultRow]) -> str:
    """One line per environment and method, in the order of the rows (Tables 2 and 3 of the paper).

    Mean ± standard deviation over logs and training seeds. `estimate` is the return of the chosen
    rule in the user model of the log. `− ucf` is the return less that of UCF of the same log and
    seed: mean ± standard error over the pairs, and in brackets over the means of logs.
    """
    ours = [row for row in _select_checkpoint(rows) if row.method == OURS]
    of_ours = grouped(ours, lambda row: row.environment)

    def list_targets(group: Sequence[ResultRow]) -> str:
        targets = {f"{row.target_return:g}" for row in group if row.target_return is not None}
        return ", ".join(sorted(targets, key=float)) or NONE

    def compare(group: Sequence[ResultRow]) -> str:
        if group[0].method == OURS:
            return NONE
        ours = _index_by_seeds(of_ours.get(group[0].environment, ()))
        return _format_difference(_subtract(_index_by_seeds(group), ours))

    names = ("R_cum", "R_avg_pooled", "R_avg_episode", "length", "coverage")
    columns: dict[str, _Column] = {name: name for name in names}
    columns |= {"target": list_targets, "estimate": "estimated_value", f"− {OURS}": compare}
    return _make_table(rows, "method", columns)


def sweep_table(rows: Sequence[ResultRow]) -> str:
    """One line per environment and setting of UCF: return, validation loss and acceptance rate."""
    columns = {"R_cum": "R_cum", "validation loss": "validation_loss", "acceptance": "acceptance"}
    return _make_table(rows, "setting", columns)


def _make_table(rows: Sequence[ResultRow], name: str, columns: Mapping[str, _Column]) -> str:
    def fill(group: Sequence[ResultRow], column: _Column) -> str:
        if not isinstance(column, str):
            return column(group)
        return mean_and_sd(row.metrics[column] for row in group if column in row.metrics)

    lines = []
    groups = grouped(_select_checkpoint(rows), lambda row: (row.environment, row.method))
    for (environment, method), group in groups.items():
        cells = [fill(group, column) for column in columns.values()]
        lines.append((environment, method, len(group), *cells))
    return markdown_table(("environment", name, "logs × seeds", *columns), lines)


def distractor_table(rows: Sequence[ResultRow]) -> str:
    """One line per environment, target and method: returns without, with it off, and with it on.

    "off" and "on" are of policies trained with the distractor. `drop` is by how many percent the
    return with the distractor off is below that of the policy trained without a distractor.
    """
    groups = grouped(
        _select_checkpoint(rows),
        lambda r: (str(r.environment), -float(str(r.conditions["quantiles"])), r.method),
    )
    lines = []
    # Environments together, the largest target first; methods stay in their order.
    for (environment, quantile, method), group in sorted(groups.items(), key=lambda g: g[0][:2]):
        by_rate = grouped(group, lambda row: row.conditions["distractor"])
        indexed = [_index_by_seeds(by_rate.get(rate, ())) for rate in DISTRACTOR_RATES]
        pairs = [pair for pair in indexed[0] if all(pair in values for values in indexed)]
        if not pairs:  # an environment in which no distractor was planted
            continue
        clean, off, on = ([values[pair] for pair in pairs] for values in indexed)
        drop = [100 * (1 - with_it / without) for with_it, without in zip(off, clean, strict=True)]
        spread = [mean_and_sd(values) for values in (clean, off, on, drop)]
        lines.append((environment, f"{-quantile:g}", method, len(pairs), *spread))
    head = ("environment", "target quantile", "method", "logs × seeds")
    return markdown_table((*head, *DISTRACTOR_NAMES, "drop, %"), lines)


def _select_checkpoint(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """The rows of built-in policies, and those of the best checkpoint of trained ones."""
    return [row for row in rows if row.checkpoint in (None, "best")]


def score_table(rows: Sequence[ResultRow], checkpoint: str) -> list[dict[str, str]]:
    """One line per method: number of seeds, or the fewest and most where datasets differ; then one
    column per dataset, normalised score, mean ± standard error over seeds (Table 1 of the paper);
    then the mean over datasets if the method has rows of all. As in the paper, the best of a column
    and what comes within 5% of it are `**bold**`.

    Args:
        checkpoint: "last" or "best"; IQL and CQL keep only their last one, which is always shown.
    """
    rows = [r for r in rows if r.checkpoint == checkpoint or "best_step" not in r.metrics]
    values, tasks = _group_by_seed(rows, "score"), list(dict.fromkeys(row.task for row in rows))
    cells: dict[str, dict[str, Summary]] = {}
    for method in dict.fromkeys(row.method for row in rows):
        of_tasks = [values[method, task] for task in tasks]
        scores = [summary(seeds.values()) for seeds in of_tasks]
        scores.append(_summarise_tasks(of_tasks))
        cells[method] = dict(zip((*tasks, MEAN), scores, strict=True))
    best = {}
    for name in (*tasks, MEAN):
        means = [of[name].mean for of in cells.values() if of[name].count]
        best[name] = max(means, default=0.0)
    lines = []
    for method, of_method in cells.items():
        counts = [of_method[task].count for task in tasks]
        fewest, most = min(filter(None, counts)), max(counts)
        seeds = str(most) if fewest == most else f"{fewest}–{most}"
        texts = {name: _format_score(score, best[name]) for name, score in of_method.items()}
        lines.append({"method": method, "seeds": seeds, **texts})
    return lines


def _format_score(scores: Summary, best: float) -> str:
    if not scores.count:
        return NONE
    error = f" ± {scores.standard_error:.2g}" if scores.count > 1 else ""
    text = f"{scores.mean:.1f}{error}"
    return f"**{text}**" if scores.mean >= best - NEAR * abs(best) else text


def select_best_target(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Rows of the target return with the highest mean over seeds, for each dataset, method and
    checkpoint."""
    best: list[ResultRow] = []
    for group in grouped(rows, lambda row: (row.task, row.method, row.checkpoint)).values():
        targets = grouped(group, lambda row: row.target_return)
        best += max(targets.values(), key=lambda same: summary(row.value for row in same).mean)
    return best


def average_seeds(
    lines: Sequence[Mapping[str, Any]], by: Sequence[str], values: Sequence[str]
) -> list[dict[str, Any]]:
    """One line per combination of `by`: `values`, where a line of `ResultRow.as_line` has them, as
    mean ± standard deviation over seeds."""
    averages = []
    for key, group in grouped(lines, lambda line: tuple(line[name] for name in by)).items():
        average = dict(zip(by, key, strict=True))
        for name in values:
            average[name] = mean_and_sd(ln[name] for ln in group if ln.get(name) is not None)
        averages.append(average)
    return averages


def difference_table(
    rows: Sequence[ResultRow], first: str, metric: str = "score"
) -> list[dict[str, str]]:
    """One line per method other than `first` that has `metric`, and one column per dataset: its
    difference to `first` with the same seed, mean ± standard error over the seeds that both have;
    then the mean over datasets if both have rows of all."""
    values, tasks = _group_by_seed(rows, metric), list(dict.fromkeys(row.task for row in rows))
    lines = []
    for method in dict.fromkeys(row.method for row in rows if row.method != first):
        of_tasks = [_subtract(values[method, task], values[first, task]) for task in tasks]
        if any(of_tasks):
            texts = dict(zip(tasks, map(_format_difference, of_tasks), strict=True))
            texts[MEAN] = _format_signed(_summarise_tasks(of_tasks))
            lines.append({"method": method, **texts})
    return lines


def _group_by_seed(rows: Sequence[ResultRow], metric: str) -> Mapping[tuple[str, str], _BySeed]:
    """The metric, where a row has it, by seeds, of each method and task."""
    groups: defaultdict[tuple[str, str], _BySeed] = defaultdict(dict)
    for row in rows:
        if metric in row.metrics:
            seeds = row.log_seed, row.training_seed
            groups[row.method, row.task][seeds] = row.metrics[metric]
    return groups


def _index_by_seeds(rows: Sequence[ResultRow]) -> _BySeed:
    """What rows are about, by the seeds of the log and of the training."""
    return {(row.log_seed, row.training_seed): row.value for row in rows}


def _summarise_tasks(of_tasks: Sequence[_BySeed]) -> Summary:
    """Of the means over tasks of each seed; of one mean where tasks differ in their seeds."""
    first = of_tasks[0]
    if all(task.keys() == first.keys() for task in of_tasks):
        return summary(summary(task[seed] for task in of_tasks).mean for seed in first)
    means = [summary(task.values()) for task in of_tasks]
    return summary([summary(task.mean for task in means).mean] if all(of_tasks) else [])


def _subtract(values: _BySeed, reference: _BySeed) -> _BySeed:
    """By how much `values` exceed those of the same seeds in `reference`."""
    # A value that no log or seed changes is compared with each.
    if values.keys() == {(None, None)}:
        values = dict.fromkeys(reference, values[None, None])
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
    """Mean difference with its sign ± its standard error; a dash for none."""
    if not differences.count:
        return NONE
    error = f" ± {differences.standard_error:.2g}" if differences.count > 1 else ""
    return f"{differences.mean:+.3g}{error}"


def plot_methods(rows: Sequence[ResultRow], folder: Path, kind: str = "methods") -> list[Path]:
    """One plot per environment, called `kind`-environment: return of every method, mean and
    standard deviation over seeds."""
    return _plot_environments(kind, _draw_bars, rows, folder)


def plot_distractor(rows: Sequence[ResultRow], folder: Path) -> list[Path]:
    """One plot per environment with a distractor: returns without it, with it off, and with it on,
    of rows whose target return is the largest training return."""
    rows = [row for row in rows if row.conditions["quantiles"] == "1"]
    planted = {row.environment for row in rows if row.conditions["distractor"] is not None}
    rows = [row for row in rows if row.environment in planted]
    return _plot_environments("distractor", _draw_triples, rows, folder)


_ByMethod = Mapping[str, Sequence[ResultRow]]


def _draw_bars(axes: "Axes", by_method: _ByMethod) -> None:
    for name, group in by_method.items():
        returns, color = summary(row.value for row in group), OURS_COLOR if name == OURS else PLAIN
        axes.barh(name, returns.mean, xerr=returns.sd, color=color, height=0.7)
    axes.set_xlabel("return per session (mean ± sd over training seeds)")


def _draw_triples(axes: "Axes", by_method: _ByMethod) -> None:
    conditions = zip(DISTRACTOR_RATES, DISTRACTOR_NAMES, (PLAIN, OURS_COLOR, LIGHT), strict=True)
    for index, (rate, label, color) in enumerate(conditions):
        means = []
        for group in by_method.values():
            returns = (row.value for row in group if row.conditions["distractor"] == rate)
            means.append(summary(returns).mean)
        positions = np.arange(len(by_method)) + 0.25 * (1 - index)
        axes.barh(positions, means, height=0.25, color=color, label=label)
    axes.set_yticks(range(len(by_method)), list(by_method))
    axes.set_xlabel("return per session (mean over training seeds)")
    axes.legend()


@file_style()
def _plot_environments(
    kind: str,
    draw: Callable[["Axes", _ByMethod], None],
    rows: Sequence[ResultRow],
    folder: Path,
) -> list[Path]:
    from matplotlib.figure import Figure

    files = []
    environments = grouped(_select_checkpoint(rows), lambda row: row.environment)
    for environment, group in environments.items():
        figure, name = Figure(figsize=(5.2, 4.2)), f"{kind}-{environment}"
        axes = figure.add_subplot()
        axes.set_title(name)
        by_method = grouped(group, lambda row: row.method)
        draw(axes, dict(reversed(by_method.items())))
        files += save(figure, folder, name)
    return files
