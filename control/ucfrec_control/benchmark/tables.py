"""Result rows of several seeds to the lines of a printed table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ucfrec.reporting.grid import Row

MEAN = "mean"


def score_table(rows: Sequence[Row], checkpoint: str) -> list[Row]:
    """A line a method: normalised scores as mean ± standard deviation over seeds, a column a
    dataset, and their mean over datasets where a method has rows of all (Table 1 of the paper).

    Methods without this checkpoint are judged by their last one: IQL and CQL keep no other.

    Args:
        rows: what `ucfrec_control.benchmark.plan.benchmark` returns.
        checkpoint: "last" or "best".
    """
    kept = [row for row in rows if row["checkpoint"] == checkpoint or row["best_step"] is None]
    scores = _grouped(kept, ("method", "dataset"), "score")
    datasets = list(dict.fromkeys(row["dataset"] for row in kept))
    lines = []
    for method in dict.fromkeys(row["method"] for row in kept):
        own = [scores.get((method, dataset), []) for dataset in datasets]
        line = {name: spread(values) for name, values in zip(datasets, own, strict=True)}
        mean = spread([float(np.mean([np.mean(each) for each in own]))] if all(own) else [])
        lines.append({"method": method, **line, MEAN: mean})
    return lines


def over_seeds(rows: Sequence[Row], by: Sequence[str], values: Sequence[str]) -> list[Row]:
    """A line for each combination of `by`, the `values` as mean ± standard deviation over seeds."""
    groups = {name: _grouped(rows, by, name) for name in values}
    return [
        {**dict(zip(by, key, strict=True)), **{n: spread(groups[n][key]) for n in values}}
        for key in dict.fromkeys(tuple(row[name] for name in by) for row in rows)
    ]


def against_first(rows: Sequence[Row], values: Sequence[str]) -> list[Row]:
    """A line a dataset and later method: by how much its `values` differ from the first method's of
    the same seed, mean ± standard error over the seeds that both have.

    Args:
        rows: of one checkpoint.
    """
    known = {(row["dataset"], row["method"], row["seed"]): row for row in rows}
    first = rows[0]["method"]
    lines = []
    for dataset, method in dict.fromkeys((row["dataset"], row["method"]) for row in rows):
        pairs = [
            (row, known[dataset, first, seed])
            for (own, name, seed), row in known.items()
            if (own, name) == (dataset, method) and (dataset, first, seed) in known
        ]
        if method == first or len(pairs) < 2:
            continue
        line: Row = {"dataset": dataset, "method": method}
        for name in values:
            differences = [row[name] - other[name] for row, other in pairs]
            error = np.std(differences, ddof=1) / len(pairs) ** 0.5
            line[name] = f"{np.mean(differences):+.3g} ± {error:.2g}"
        lines.append(line)
    return lines


def spread(values: Sequence[float]) -> str:
    """Mean ± standard deviation of a sample, of one value the value alone, of none a dash."""
    if not values:
        return "–"
    return f"{np.mean(values):.3g}" + (f" ± {np.std(values, ddof=1):.2g}" if values[1:] else "")


def _grouped(
    rows: Sequence[Row], by: Sequence[str], value: str
) -> dict[tuple[Any, ...], list[float]]:
    """Known values by their rows' `by`."""
    groups: dict[tuple[Any, ...], list[float]] = {}
    for row in rows:
        known = groups.setdefault(tuple(row[name] for name in by), [])
        if row[value] is not None:
            known.append(row[value])
    return groups
