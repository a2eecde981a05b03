"""Scores lost by methods that were trained with a distractor (Figures 3 and 4, Appendix G.4).

Every method is trained on the clean data and on the same data with a distractor in the states, and
evaluated with the distractor fixed to 0. Two trainings also differ randomly. Evaluating the same
policy with the distractor fixed to 1 instead isolates the effect of the distractor.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting.statistics import grouped, summary
from ucfrec.results.row import ResultRow
from ucfrec_control.data.distractor import CLEAN

SHOWN = ("clean", "score", "drop", "score_at_one", "drop_at_one")
SHOWN_LARGEST = ("method", "at 0", "at 1")
SHOWN_LOSSES = ("loss", "loss_at_zero", "rise")


def drops(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """The score that each method lost to each distractor, where there is a clean row too.

    `clean` and `score` are the normalised scores of the policies trained without and with the
    distractor, which is fixed to 0. `drop` is the loss in percent of `clean`: negative for a gain,
    NaN if `clean` is not above 0. `score_at_one` and `drop_at_one` are of the second policy, from
    the same initial states, with the distractor fixed to 1. The last of several equal keys counts.

    Args:
        rows: of one budget.

    Returns:
        One mapping per dataset, method, seed and distractor, with these and the values of `SHOWN`.
    """
    last = {(_pair(row), row.conditions["distractor"]): row.metrics for row in rows}
    lines = []
    for (pair, distractor), metrics in last.items():
        clean_metrics = last.get((pair, CLEAN))
        if distractor == CLEAN or clean_metrics is None:
            continue
        clean, score = clean_metrics["score"], metrics["score"]
        at_one = metrics.get("score_at_one", float("nan"))
        values = (clean, score, _lost(clean, score), at_one, _lost(clean, at_one))
        names = ("task", "method", "training_seed", "distractor")
        lines.append(dict(zip((*names, *SHOWN), (*pair, distractor, *values), strict=True)))
    return lines


def _lost(clean: float, score: float) -> float:
    return 100 * (clean - score) / clean if clean > 0 else float("nan")


def largest_drops(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """The largest of each method's drops, in percent, with the distractor fixed to 0 and to 1: over
    datasets and distractors, each in the mean over seeds."""
    lines = []
    for method, own in grouped(drops(rows), lambda line: line["method"]).items():
        cases = grouped(own, lambda line: (line["task"], line["distractor"])).values()
        largest = [
            max(summary(line[name] for line in case).mean for case in cases)
            for name in ("drop", "drop_at_one")
        ]
        lines.append(dict(zip(SHOWN_LARGEST, (method, *largest), strict=True)))
    return lines


def loss_rises(rows: Sequence[ResultRow]) -> list[Mapping[str, Any]]:
    """Lines of rows with a distractor, and `rise`: by how many percent the held-out action loss
    rises when the distractor is fixed to 0."""
    return [
        {**row.as_line(), "rise": 100 * (row.metrics["loss_at_zero"] / row.metrics["loss"] - 1)}
        for row in rows
        if row.conditions["distractor"] != CLEAN and row.metrics.get("loss")
    ]


def _pair(row: ResultRow) -> tuple[str, str, int | None]:
    """Dataset, method and seed, which are equal for a row with and one without a distractor."""
    return row.task, row.method, row.training_seed
