"""What policies earned, as the report shows it."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ucfrec.errors import InputError
from ucfrec.evaluation.diversity_columns import COLUMNS
from ucfrec.reporting import charts
from ucfrec.reporting.evaluation_rows import read_evaluations
from ucfrec.reporting.tables import Table, shown

Row = dict[str, Any]

_INTERVAL = ("R_cum", "R_cum_low", "R_cum_high")
_METRICS = ("R_avg_pooled", "R_avg_episode", "length", *COLUMNS, "target_return", "episodes")
_SEEDS = ("seed", "train_seed")


def read_results(path: Path) -> list[Row]:
    """Result rows, each with its world, policy and R_cum; JSON lines if the name ends in `.jsonl`.

    Raises:
        InputError: the file is missing or holds something else.
    """
    rows = read_evaluations(path)
    for number, row in enumerate(rows, start=1):
        known = row if isinstance(row, dict) else {}
        lacking = [name for name in ("world", "policy") if not isinstance(known.get(name), str)]
        lacking += [name for name in _INTERVAL if not _finite(known.get(name))]
        if lacking:
            raise InputError(
                f"{path}, row {number}, has no usable {', '.join(lacking)}; give rows that "
                "`ucfrec evaluate --json` or `ucfrec demo` wrote"
            )
    return rows


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def worlds(rows: Sequence[Row]) -> list[tuple[charts.BarChart, Table]]:
    """Bars and table of every world's rows."""
    drawn = []
    for world in dict.fromkeys(row["world"] for row in rows):
        there = [row for row in rows if row["world"] == world]
        names = _row_names(there)
        bars = [
            (name, float(row["R_cum"]), float(row["R_cum_low"]), float(row["R_cum_high"]))
            for name, row in zip(names, there, strict=True)
        ]
        columns = [c for c in (*_METRICS, *_SEEDS) if any(row.get(c) is not None for row in there)]
        body = []
        for row, (name, value, low, high) in zip(there, bars, strict=True):
            r_cum = f"{shown(value)} [{shown(low)}, {shown(high)}]"
            body.append((name, [r_cum, *(_cell(row, column) for column in columns)]))
        table = Table(f"{world}: means of episodes", "policy", ["R_cum", *columns], body)
        drawn.append((charts.bar_chart(f"R_cum in {world}, with 95% intervals", bars), table))
    return drawn


def _row_names(rows: Sequence[Row]) -> list[str]:
    """The policies; where one comes twice, with what tells its rows apart."""
    names = []
    for row in rows:
        same = [other for other in rows if other["policy"] == row["policy"]]
        telling = ("run", "checkpoint", *_SEEDS)
        apart = [key for key in telling if any(o.get(key) != row.get(key) for o in same)]
        names.append(", ".join([row["policy"], *(f"{key} {_cell(row, key)}" for key in apart)]))
    return names


def _cell(row: Row, column: str) -> str:
    value = row.get(column)
    return str(value) if column in _SEEDS and value is not None else shown(value)
