"""How far scores of equal trainings are apart: over seeds, and over the last checkpoints."""

from collections.abc import Sequence
from typing import Any, Final

from ucfrec.results.row import ResultRow
from ucfrec.results.statistics import grouped, summary

BACK: Final = "checkpoints_before_last"
"""Condition of rows of single checkpoints."""
AVERAGING: Final = "weights"
"""Condition of rows of single checkpoints: one of `WEIGHTS`."""
SHOWN: Final = ("task", "method", "weights", "seeds", "score", "sd_seeds", "checkpoints", "sd_last")
"""Columns of `spreads`."""


def spreads(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """One line per task, method and kind of weights.

    `score` is the mean over training seeds of the last checkpoint's score, `sd_seeds` their
    standard deviation. `sd_last` is the standard deviation over the last `checkpoints` of one
    training, as the root of the mean of its squares over the seeds. NaN for fewer than two values.
    """
    lines = []
    for (task, method, weights), own in grouped(rows, _line).items():
        last = summary(row.value for row in own if row.conditions[BACK] == 0)
        trainings = grouped(own, lambda row: row.training_seed).values()
        within = [summary(row.value for row in each) for each in trainings]
        variance = summary(each.sd**2 for each in within if each.count > 1).mean
        most = max(each.count for each in within)
        values = (task, method, weights, last.count, last.mean, last.sd, most, variance**0.5)
        lines.append(dict(zip(SHOWN, values, strict=True)))
    return lines


def _line(row: ResultRow) -> tuple[str, str, str]:
    return row.task, row.method, str(row.conditions[AVERAGING])
