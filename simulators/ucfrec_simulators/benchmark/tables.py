"""Rows to tables: mean and spread over seeds, as Markdown."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from ucfrec.reporting.grid import Row

DISTRACTOR_RATES: Final = (None, 0.0, 1.0)
"""How a row's distractor was shown: there was none, never, always."""
_SHOWN: Final = ("R_cum", "R_avg_pooled", "R_avg_episode", "length")


def method_table(rows: Sequence[Row], checkpoint: str = "best") -> str:
    """One line a world and method, in the order of the rows (Tables 2 and 3 of the paper)."""
    head = ("env", "method", "seeds", *_SHOWN, "coverage", "target")
    lines = []
    for (env, method), own in grouped(rows, checkpoint, lambda row: (row["env"], row["method"])):
        spread = [_spread(own, name) for name in _SHOWN]
        lines.append((env, method, len(own), *spread, _spread(own, "coverage"), _targets(own)))
    return markdown(head, lines)


def sweep_table(rows: Sequence[Row], checkpoint: str = "best") -> str:
    """One line a world and setting of UCF, with its worth on validation data beside."""
    head = ("env", "setting", "seeds", "R_cum", "validation loss", "acceptance")
    lines = []
    for (env, method), own in grouped(rows, checkpoint, lambda row: (row["env"], row["method"])):
        spread = [_spread(own, name) for name in ("R_cum", "validation_loss", "acceptance")]
        lines.append((env, method, len(own), *spread))
    return markdown(head, lines)


def target_table(rows: Sequence[Row]) -> str:
    """What each target return earned on validation sessions, mean over seeds."""
    asked = [row for row in rows if row.get("validation") and row["checkpoint"] == "best"]
    lines = []
    for (env, method), own in grouped(asked, "best", lambda row: (row["env"], row["method"])):
        targets = sorted({float(t) for row in own for t in row["validation"]})
        for target in targets:
            earned = [
                row["validation"][f"{target:g}"]
                for row in own
                if f"{target:g}" in row["validation"]
            ]
            lines.append((env, method, f"{target:g}", len(earned), _mean(earned)))
    return markdown(("env", "method", "target return", "seeds", "R_cum, validation"), lines)


def distractor_table(rows: Sequence[Row], checkpoint: str = "best") -> str:
    """Per target and method: trained without the distractor; trained with it, played off and on."""
    lines = []

    def key(row: Row) -> tuple[str, float, str]:
        return row["env"], row["quantiles"][0], row["method"]

    for (env, asked, method), own in sorted(grouped(rows, checkpoint, key), key=_by_target):
        of = {
            rate: {r["seed"]: r["R_cum"] for r in own if r["distractor"] == rate}
            for rate in DISTRACTOR_RATES
        }
        paired = sorted(set.intersection(*(set(values) for values in of.values())))
        if not paired:  # a world in which no distractor was planted
            continue
        clean, off, on = (
            np.array([of[rate][seed] for seed in paired]) for rate in DISTRACTOR_RATES
        )
        drop = 100 * (1 - off / clean)
        spread = [_mean(values) for values in (clean, off, on, drop)]
        lines.append((env, f"{asked:g}", method, len(paired), *spread))
    shown = ("no distractor", "distractor off", "distractor on", "drop, %")
    return markdown(("env", "target quantile", "method", "seeds", *shown), lines)


def _by_target(group: tuple[tuple[str, float, str], list[Row]]) -> tuple[str, float]:
    """Worlds together, the largest target first; methods stay in their order."""
    env, asked, _ = group[0]
    return env, -asked


def markdown(head: Sequence[str], lines: Sequence[Sequence[object]]) -> str:
    """A table of GitHub's Markdown."""
    body = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in body)


def grouped(
    rows: Sequence[Row], checkpoint: str, key: Callable[[Row], Any]
) -> list[tuple[Any, list[Row]]]:
    """Rows of built-in policies and of one checkpoint, by key, in the order of the rows."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        if row["checkpoint"] in (None, checkpoint):
            groups.setdefault(key(row), []).append(row)
    return list(groups.items())


def _spread(rows: Sequence[Row], name: str) -> str:
    known = [row[name] for row in rows if row.get(name) is not None]
    return _mean(known) if known else "–"


def _mean(values: Sequence[float] | np.ndarray[Any, Any]) -> str:
    spread = f" ± {np.std(values, ddof=1):.3g}" if len(values) > 1 else ""
    return f"{np.mean(values):.4g}{spread}"


def _targets(rows: Sequence[Row]) -> str:
    asked = {f"{row['target_return']:g}" for row in rows if row.get("validation")}
    return ", ".join(sorted(asked, key=float)) or "–"
