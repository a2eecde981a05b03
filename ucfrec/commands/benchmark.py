"""`ucfrec benchmark`: tables of every method."""

import argparse
import os
from pathlib import Path

from ucfrec.plugins import Benchmark, load_plugin


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `benchmark` takes."""
    parser.add_argument("suite", help="recommendation, or one that a package announces")
    parser.add_argument("--budget", choices=["small", "full"], default="small")
    parser.add_argument("--table", action="append", default=[], help="only this one; repeatable")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"), help="logs and runs")
    parser.add_argument(
        "--results", type=Path, help="JSON lines (benchmarks/results/SUITE.jsonl); appended to"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")


def run(options: argparse.Namespace) -> None:
    """`ucfrec benchmark`."""
    suite: Benchmark = load_plugin("benchmarks", options.suite)
    results = options.results or Path("benchmarks/results") / f"{options.suite}.jsonl"
    tables = options.table or suite.tables
    print(suite.run(options.budget, tables, options.out, results, options.workers))
    print(f"\nrows: {results}")
