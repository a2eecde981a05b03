"""Tables of result rows: mean and standard deviation over seeds, as Markdown."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import grouped, paired_differences, summary
from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd, signed_difference

DISTRACTOR_RATES: Final = (None, 0.0, 1.0)
"""Probability that the distractor is on in an evaluation; None: an environment without a
distractor."""
OURS: Final = "ucf"
_Pair = tuple[int | None, int | None]
_SHOWN: Final = ("R_cum", "R_avg_pooled", "R_avg_episode", "length")


def method_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per environment and method, in the order of the rows (Tables 2 and 3 of the paper).

    Mean ± standard deviation over logs and training seeds. `promised` is the return that the model
    of the users, fitted to the log, gave the chosen rule. `− ucf` is the return less that of UCF
    of the same log and seed: mean ± standard error over the pairs, and in brackets over the means
    of logs, which counts what logs differ by.
    """
    columns = (*_SHOWN, "coverage", "target", "promised")
    head = ("environment", "method", "logs × seeds", *columns, f"− {OURS}")
    lines, shown = [], of_checkpoint(rows, checkpoint)
    less = difference_to_ours(shown)
    for (environment, method), group in grouped(shown, _line).items():
        spread = [mean_and_sd(numbers(group, name)) for name in (*_SHOWN, "coverage")]
        told = (_targets(group), mean_and_sd(numbers(group, "promised")))
        lines.append((environment, method, len(group), *spread, *told, less[environment, method]))
    return markdown_table(head, lines)


def difference_to_ours(rows: Sequence[ResultRow]) -> dict[tuple[str, str], str]:
    """By (environment, method): its return less that of UCF, as in `method_table`; a dash for
    UCF."""
    found: dict[tuple[str, str], str] = {}
    for environment, group in grouped(rows, lambda row: str(row.environment)).items():
        values = {
            name: {_pair(row): row.value for row in own}
            for name, own in grouped(group, lambda row: row.method).items()
        }
        ours = values.get(OURS, {})
        found |= {
            (environment, name): NONE if name == OURS else _less(own, ours)
            for name, own in values.items()
        }
    return found


def sweep_table(rows: Sequence[ResultRow], checkpoint: str = "best") -> str:
    """One line per environment and setting of UCF: return, validation loss and acceptance rate."""
    head = ("environment", "setting", "logs × seeds", "R_cum", "validation loss", "acceptance")
    lines = []
    for (environment, method), group in grouped(of_checkpoint(rows, checkpoint), _line).items():
        shown = ("R_cum", "validation_loss", "acceptance")
        spread = [mean_and_sd(numbers(group, name)) for name in shown]
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

    groups = grouped(of_checkpoint(rows, checkpoint), key)
    lines = []
    for (environment, quantile, method), group in sorted(
        groups.items(), key=lambda item: item[0][:2]
    ):
        by_pair = [
            {_pair(row): row.value for row in group if row.conditions["distractor"] == rate}
            for rate in DISTRACTOR_RATES
        ]
        pairs = [pair for pair in by_pair[0] if all(pair in other for other in by_pair)]
        if not pairs:  # an environment in which no distractor was planted
            continue
        clean, off, on = ([values[pair] for pair in pairs] for values in by_pair)
        drop = [100 * (1 - with_it / without) for with_it, without in zip(off, clean, strict=True)]
        spread = [mean_and_sd(values) for values in (clean, off, on, drop)]
        lines.append((environment, f"{-quantile:g}", method, len(pairs), *spread))
    shown = ("no distractor", "distractor off", "distractor on", "drop, %")
    return markdown_table(
        ("environment", "target quantile", "method", "logs × seeds", *shown), lines
    )


def of_checkpoint(rows: Sequence[ResultRow], checkpoint: str) -> list[ResultRow]:
    """The rows of built-in policies, and those of one checkpoint of trained ones."""
    return [row for row in rows if row.checkpoint in (None, checkpoint)]


def numbers(rows: Sequence[ResultRow], name: str) -> list[float]:
    """Values of metric `name` of the rows that have it."""
    return [row.metrics[name] for row in rows if name in row.metrics]


def _less(values: Mapping[_Pair, float], ours: Mapping[_Pair, float]) -> str:
    """By how much `values` exceed `ours`; what no log or seed changes is compared with each."""
    same = {pair: value for pair, value in values.items() if pair in ours}
    if not same and len(values) == 1:
        same = dict.fromkeys(ours, *values.values())
    differences = paired_differences(same, ours)
    if not differences:
        return NONE
    by_log = grouped(zip(same, differences, strict=True), lambda item: item[0][0])
    over_logs = summary(float(np.mean([value for _, value in own])) for own in by_log.values())
    if len(differences) == 1:
        return f"{differences[0]:+.3g}"
    said = signed_difference(summary(differences))
    return said if over_logs.count == 1 else f"{said} ({over_logs.standard_error:.2g})"


def _pair(row: ResultRow) -> _Pair:
    return row.log_seed, row.training_seed


def _line(row: ResultRow) -> tuple[str, str]:
    return str(row.environment), row.method


def _targets(rows: Sequence[ResultRow]) -> str:
    chosen = {f"{row.target_return:g}" for row in rows if row.target_return is not None}
    return ", ".join(sorted(chosen, key=float)) or NONE
