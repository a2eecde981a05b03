"""Tables of result rows: means and spreads over logs and seeds, differences to a method."""

from collections.abc import Iterable, Mapping, Sequence

from ucfrec.benchmark.cells import PAPER_UCF, UPDATES
from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import Summary, grouped, summary

DISTRACTOR_RATES = {"no distractor": None, "distractor off": 0.0, "distractor on": 1.0}
"""Probability that the distractor is on in an evaluation; None: an environment without one."""
OURS = "ucf"
NEAR = 0.05
"""Share of the best score by which scores may be lower and still count as level with it."""
BySeed = Mapping[tuple[int | None, int | None], float]
"""Values by the seeds of the log and of the training."""


def method_table(rows: Sequence[ResultRow]) -> str:
    """One line per environment and method, in the order of the rows (Tables 2 and 3 of the paper).

    Mean ± standard deviation over logs and training seeds. `estimate` is the return of the chosen
    rule in the user model of the log. `− ucf` is the return less that of UCF of the same log and
    seed: mean ± standard error over the pairs, and in brackets over the means of logs.
    """
    names = ("R_cum", "R_avg_pooled", "R_avg_episode", "length", "coverage")
    groups, lines = _group_methods(rows), []
    for (environment, method), group in groups.items():
        targets = {row.target_return for row in group if row.target_return is not None}
        ours = index_by_seeds(groups.get((environment, OURS), ()) if method != OURS else ())
        average, estimate = _average(group, names), _average(group, ["estimated_value"])
        target = ", ".join(f"{target:g}" for target in sorted(targets)) or NONE
        more = _format_difference(subtract(index_by_seeds(group), ours))
        lines.append((environment, method, len(group), *average, target, *estimate, more))
    head = ("environment", "method", "logs × seeds", *names, "target", "estimate", f"− {OURS}")
    return markdown_table(head, lines)


def sweep_table(rows: Sequence[ResultRow]) -> str:
    """One line per environment and setting of UCF: return, validation loss and acceptance rate."""
    names = ("R_cum", "validation_loss", "acceptance")
    groups = _group_methods(rows).items()
    lines = [(*case, len(group), *_average(group, names)) for case, group in groups]
    head = ("environment", "setting", "logs × seeds", "R_cum", "validation loss", "acceptance")
    return markdown_table(head, lines)


def _group_methods(
    rows: Sequence[ResultRow],
) -> Mapping[tuple[str | None, str], Sequence[ResultRow]]:
    return grouped(_select_checkpoint(rows), lambda row: (row.environment, row.method))


def note_updates(rows: Iterable[ResultRow]) -> list[str]:
    """What rows with the paper's settings say of the length of their trainings."""
    notes = dict.fromkeys(row.details.get(UPDATES) for row in rows)
    return [f"{PAPER_UCF}…: {note}" for note in notes if note is not None]


def _average(rows: Sequence[ResultRow], metrics: Sequence[str]) -> list[str]:
    return [mean_and_sd(row.metrics[n] for row in rows if n in row.metrics) for n in metrics]


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
    by_target = sorted(groups.items(), key=lambda group: group[0][:2])
    for (environment, quantile, method), group in by_target:
        by_rate = grouped(group, lambda row: row.conditions["distractor"])
        indexed = [index_by_seeds(by_rate.get(r, ())) for r in DISTRACTOR_RATES.values()]
        pairs = [pair for pair in indexed[0] if all(pair in values for values in indexed)]
        if not pairs:  # an environment in which no distractor was planted
            continue
        clean, distracted = indexed[:2]
        indexed.append({pair: 100 * (1 - distracted[pair] / clean[pair]) for pair in pairs})
        spread = [mean_and_sd(values[pair] for pair in pairs) for values in indexed]
        lines.append((environment, f"{-quantile:g}", method, len(pairs), *spread))
    head = ("environment", "target quantile", "method", "logs × seeds")
    return markdown_table((*head, *DISTRACTOR_RATES, "drop, %"), lines)


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
    cells = {name: summarise_tasks(tasks) for name, tasks in values_by_task(rows, "score").items()}
    columns = zip(*cells.values(), strict=True)
    best = [max((cell.mean for cell in column if cell.count), default=0.0) for column in columns]
    lines = []
    for method, scores in cells.items():
        counts = [cell.count for cell in scores[:-1] if cell.count]
        seeds = "–".join(dict.fromkeys(map(str, (min(counts), max(counts)))))
        texts = map(_format_score, scores, best)
        lines.append({"method": method, "seeds": seeds, **_name_columns(rows, texts)})
    return lines


def _format_score(scores: Summary, best: float) -> str:
    text = _format(scores, ".1f")
    return f"**{text}**" if scores.mean >= best - NEAR * abs(best) else text


def _name_columns(rows: Sequence[ResultRow], texts: Iterable[str]) -> dict[str, str]:
    """Texts of all datasets of the rows, and of the mean over them, by name."""
    return dict(zip((*dict.fromkeys(row.task for row in rows), "mean"), texts, strict=True))


def difference_table(
    rows: Sequence[ResultRow], first: str, metric: str = "score"
) -> list[dict[str, str]]:
    """One line per method other than `first` that has `metric`, and one column per dataset: its
    difference to `first` with the same seed, mean ± standard error over the seeds that both have;
    then the mean over datasets if both have rows of all."""
    values, lines = values_by_task(rows, metric), []
    for method, tasks in values.items():
        of_tasks = list(map(subtract, tasks, values.get(first, [{}] * len(tasks))))
        if method != first and any(of_tasks):
            mean = _format(summarise_tasks(of_tasks)[-1], "+.3g")
            texts = _name_columns(rows, [*map(_format_difference, of_tasks), mean])
            lines.append({"method": method, **texts})
    return lines


def values_by_task(rows: Sequence[ResultRow], metric: str) -> dict[str, list[BySeed]]:
    """Of each method: the metric by seeds for every task of the rows."""
    groups = grouped(rows, lambda row: (row.method, row.task))
    methods, tasks = (dict.fromkeys(names) for names in zip(*groups, strict=True))
    return {
        method: [index_by_seeds(groups.get((method, task), ()), metric) for task in tasks]
        for method in methods
    }


def index_by_seeds(rows: Iterable[ResultRow], metric: str | None = None) -> BySeed:
    """A metric, where rows have it, by the seeds of the log and of the training; None for what the
    rows are about."""
    return {
        (row.log_seed, row.training_seed): row.metrics[metric or row.metric]
        for row in rows
        if (metric or row.metric) in row.metrics
    }


def summarise_tasks(of_tasks: Sequence[BySeed]) -> list[Summary]:
    """Of each task, then of the means over tasks of each seed: of one mean where tasks differ in
    their seeds, of none where a task has no value."""
    summaries = [summary(task.values()) for task in of_tasks]
    if all(task.keys() == of_tasks[0].keys() for task in of_tasks):
        means = [summary(task[seeds] for task in of_tasks).mean for seeds in of_tasks[0]]
    else:
        means = [summary(task.mean for task in summaries).mean] if all(of_tasks) else []
    return [*summaries, summary(means)]


def subtract(values: BySeed, reference: BySeed) -> BySeed:
    """By how much `values` exceed those of the same seeds in `reference`."""
    # A value that no log or seed changes is compared with each.
    if values.keys() == {(None, None)}:
        values = dict.fromkeys(reference, values[None, None])
    return {
        seeds: value - reference[seeds] for seeds, value in values.items() if seeds in reference
    }


def summarise_logs(differences: BySeed) -> Summary:
    """Of the means over logs."""
    of_logs = grouped(differences.items(), lambda item: item[0][0]).values()
    return summary(summary(value for _, value in log).mean for log in of_logs)


def _format_difference(differences: BySeed) -> str:
    """Mean ± standard error over all; with several logs, in brackets that over means of logs."""
    text, of_logs = _format(summary(differences.values()), "+.3g"), summarise_logs(differences)
    return text if of_logs.count < 2 else f"{text} ({of_logs.standard_error:.2g})"


def _format(sample: Summary, number: str) -> str:
    """Mean ± standard error; a dash for no values."""
    if not sample.count:
        return NONE
    error = f" ± {sample.standard_error:.2g}" if sample.count > 1 else ""
    return f"{sample.mean:{number}}{error}"
