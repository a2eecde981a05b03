"""Rows to tables: mean and spread over seeds, as Markdown."""

from collections.abc import Sequence
from typing import Final

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import grouped
from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd

DISTRACTOR_RATES: Final = (None, 0.0, 1.0)
"""How a row's distractor was shown: there was none, never, always."""
_SHOWN: Final = ("R_cum", "R_avg_pooled", "R_avg_episode", "length")


def method_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line a world and method, in the order of the rows (Tables 2 and 3 of the paper)."""
    head = ("world", "method", "seeds", *_SHOWN, "coverage", "target")
    lines = []
    for (world, method), own in grouped(of_checkpoint(rows, checkpoint), _line).items():
        spread = [mean_and_sd(numbers(own, name)) for name in (*_SHOWN, "coverage")]
        lines.append((world, method, len(own), *spread, _targets(own)))
    return markdown_table(head, lines)


def sweep_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line a world and setting of UCF, with its worth on validation data beside."""
    head = ("world", "setting", "seeds", "R_cum", "validation loss", "acceptance")
    lines = []
    for (world, method), own in grouped(of_checkpoint(rows, checkpoint), _line).items():
        shown = ("R_cum", "validation_loss", "acceptance")
        spread = [mean_and_sd(numbers(own, name)) for name in shown]
        lines.append((world, method, len(own), *spread))
    return markdown_table(head, lines)


def target_table(rows: Sequence[ResultRow]) -> str:
    """What each target return earned on validation sessions, mean over seeds."""
    lines = []
    for (world, method), own in grouped(of_checkpoint(rows, "best"), _line).items():
        for target, earned in earned_by_target(own).items():
            lines.append((world, method, f"{target:g}", len(earned), mean_and_sd(earned)))
    return markdown_table(("world", "method", "target return", "seeds", "R_cum, validation"), lines)


def distractor_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """Per target and method: trained without the distractor; trained with it, played off and on."""

    def key(row: ResultRow) -> tuple[str, float, str]:
        # Worlds together, the largest target first; methods stay in their order.
        return str(row.world), -float(str(row.conditions["quantiles"])), row.method

    groups = grouped(of_checkpoint(rows, checkpoint), key)
    lines = []
    for (world, quantile, method), own in sorted(groups.items(), key=lambda group: group[0][:2]):
        by_seed = [
            {r.training_seed: r.value for r in own if r.conditions["distractor"] == rate}
            for rate in DISTRACTOR_RATES
        ]
        seeds = [s for s in by_seed[0] if all(s in other for other in by_seed)]
        if not seeds:  # a world in which no distractor was planted
            continue
        clean, off, on = ([values[seed] for seed in seeds] for values in by_seed)
        drop = [100 * (1 - there / plain) for there, plain in zip(off, clean, strict=True)]
        spread = [mean_and_sd(values) for values in (clean, off, on, drop)]
        lines.append((world, f"{-quantile:g}", method, len(seeds), *spread))
    shown = ("no distractor", "distractor off", "distractor on", "drop, %")
    return markdown_table(("world", "target quantile", "method", "seeds", *shown), lines)


def of_checkpoint(rows: Sequence[ResultRow], checkpoint: str) -> list[ResultRow]:
    """Rows of built-in policies and of one checkpoint."""
    return [row for row in rows if row.checkpoint in (None, checkpoint)]


def numbers(rows: Sequence[ResultRow], name: str) -> list[float]:
    """A metric of all rows that have it."""
    return [row.metrics[name] for row in rows if name in row.metrics]


def earned_by_target(rows: Sequence[ResultRow]) -> dict[float, list[float]]:
    """What target returns earned in validation sessions, from the lowest."""
    earned: dict[float, list[float]] = {}
    for row in rows:
        for target, value in row.details.get("validation", {}).items():
            earned.setdefault(float(target), []).append(value)
    return dict(sorted(earned.items()))


def _line(row: ResultRow) -> tuple[str | None, str]:
    return row.world, row.method


def _targets(rows: Sequence[ResultRow]) -> str:
    tried = [row for row in rows if row.details.get("validation")]
    chosen = {f"{row.target_return:g}" for row in tried if row.target_return is not None}
    return ", ".join(sorted(chosen, key=float)) or NONE
