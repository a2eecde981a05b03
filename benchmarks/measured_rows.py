"""What benchmark scripts share: the option for their file of result rows, and the rows."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ucfrec.provenance import provenance
from ucfrec.results.rows import ResultRow, append_rows


def make_parser(about: str | None, suite: str) -> argparse.ArgumentParser:
    """A parser that is described by the first line of `about`, with --results."""
    parser = argparse.ArgumentParser(description=(about or "").partition("\n")[0])
    results = Path("runs", suite.replace("-", "_"), "results.jsonl")
    parser.add_argument(
        "--results", type=Path, default=results, help=f"file of result rows (default: {results})"
    )
    return parser


def append_row(
    results: Path, suite: str, task: str, method: str, metrics: Mapping[str, float], **fields: Any
) -> None:
    """Append a row to `results`, whose metric is the first of `metrics`."""
    named = {"suite": suite, "table": suite, "task": task, "method": method, "policy": method}
    metric = next(iter(metrics))
    row = ResultRow(**{**named, **fields, **provenance()}, metric=metric, metrics=metrics)
    append_rows(results, [row])
