"""Tables of result rows: mean and standard deviation over seeds, as Markdown."""

from collections.abc import Sequence
from typing import Final

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import grouped
from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd

DISTRACTOR_RATES: Final = (None, 0.0, 1.0)
"""Probability that the distractor is on in an evaluation; None: a world without a distractor."""
_SHOWN: Final = ("R_cum", "R_avg_pooled", "R_avg_episode", "length")


def method_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per world and method, in the order of the rows (Tables 2 and 3 of the paper)."""
    head = ("world", "method", "seeds", *_SHOWN, "coverage", "target")
    lines = []
    for (world, method), group in grouped(of_checkpoint(rows, checkpoint), _line).items():
        spread = [mean_and_sd(numbers(group, name)) for name in (*_SHOWN, "coverage")]
        lines.append((world, method, len(group), *spread, _targets(group)))
    return markdown_table(head, lines)


def sweep_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per world and setting of UCF: return, validation loss and acceptance rate."""
    head = ("world", "setting", "seeds", "R_cum", "validation loss", "acceptance")
    lines = []
    for (world, method), group in grouped(of_checkpoint(rows, checkpoint), _line).items():
        shown = ("R_cum", "validation_loss", "acceptance")
        spread = [mean_and_sd(numbers(group, name)) for name in shown]
        lines.append((world, method, len(group), *spread))
    return markdown_table(head, lines)


def distractor_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per world, target and method: returns without, with it off, and with it on.

    "off" and "on" are of policies trained with the distractor. `drop` is by how many percent the
    return with the distractor off is below that of the policy trained without a distractor.
    """

    def key(row: ResultRow) -> tuple[str, float, str]:
        # Worlds together, the largest target first; methods stay in their order.
        return str(row.world), -float(str(row.conditions["quantiles"])), row.method

    groups = grouped(of_checkpoint(rows, checkpoint), key)
    lines = []
    for (world, quantile, method), group in sorted(groups.items(), key=lambda item: item[0][:2]):
        by_seed = [
            {r.training_seed: r.value for r in group if r.conditions["distractor"] == rate}
            for rate in DISTRACTOR_RATES
        ]
        seeds = [s for s in by_seed[0] if all(s in other for other in by_seed)]
        if not seeds:  # a world in which no distractor was planted
            continue
        clean, off, on = ([values[seed] for seed in seeds] for values in by_seed)
        drop = [100 * (1 - with_it / without) for with_it, without in zip(off, clean, strict=True)]
        spread = [mean_and_sd(values) for values in (clean, off, on, drop)]
        lines.append((world, f"{-quantile:g}", method, len(seeds), *spread))
    shown = ("no distractor", "distractor off", "distractor on", "drop, %")
    return markdown_table(("world", "target quantile", "method", "seeds", *shown), lines)


def of_checkpoint(rows: Sequence[ResultRow], checkpoint: str) -> list[ResultRow]:
    """The rows of built-in policies, and those of one checkpoint of trained ones."""
    return [row for row in rows if row.checkpoint in (None, checkpoint)]


def numbers(rows: Sequence[ResultRow], name: str) -> list[float]:
    """Values of metric `name` of the rows that have it."""
    return [row.metrics[name] for row in rows if name in row.metrics]


def _line(row: ResultRow) -> tuple[str | None, str]:
    return row.world, row.method


def _targets(rows: Sequence[ResultRow]) -> str:
    chosen = {f"{row.target_return:g}" for row in rows if row.target_return is not None}
    return ", ".join(sorted(chosen, key=float)) or NONE
