"""Rows of several target returns and training seeds, as one."""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting.tables import mean_and_sd
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import grouped, summary


def select_best_target(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Rows of the target return with the highest mean over seeds, for each dataset, method and
    checkpoint."""
    best: list[ResultRow] = []
    for group in grouped(rows, lambda row: (row.task, row.method, row.checkpoint)).values():
        targets = grouped(group, lambda row: row.target_return).values()
        best += max(targets, key=lambda same: summary(row.value for row in same).mean)
    return best


def average_seeds(
    lines: Sequence[Mapping[str, Any]], by: Sequence[str], values: Sequence[str]
) -> list[dict[str, Any]]:
    """One line per combination of `by`: `values`, where a line of `ResultRow.as_line` has them, as
    mean ± standard deviation over seeds."""
    return [
        dict(zip(by, key, strict=True))
        | {n: mean_and_sd(ln[n] for ln in group if ln.get(n) is not None) for n in values}
        for key, group in grouped(lines, lambda line: tuple(line[name] for name in by)).items()
    ]
