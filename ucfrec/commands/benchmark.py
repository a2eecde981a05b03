"""`ucfrec benchmark`: tables of every method."""

import argparse
import os

from ucfrec.commands.grid_options import (
    evaluation_seed_option,
    grid_options,
    results_given,
    rows_given,
)
from ucfrec.plugins import Benchmark, BenchmarkRequest, load_plugin
from ucfrec.reporting.grid import chosen


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `benchmark` takes."""
    parser.add_argument("suite", help="recommendation, or one that a package announces")
    parser.add_argument("--budget", choices=["small", "full"], default="small")
    parser.add_argument("--table", action="append", default=[], help="only this one; repeatable")
    parser.add_argument("--log-seed", type=int, default=0, help="of the logs that are simulated")
    evaluation_seed_option(parser)
    grid_options(parser, "runs/benchmark", os.cpu_count() or 1)


def run(options: argparse.Namespace) -> None:
    """`ucfrec benchmark`."""
    suite: Benchmark = load_plugin("benchmarks", options.suite)
    tables, results = chosen(suite.tables, options.table, "table"), results_given(options)
    if options.show_only:
        print(suite.show(tables, rows_given(options, options.suite, tables)))
        return
    request = BenchmarkRequest(
        budget=options.budget,
        tables=tables,
        out=options.out,
        results=results,
        workers=options.workers,
        log_seed=options.log_seed,
        evaluation_seed=options.evaluation_seed,
    )
    print(suite.run(request))
    print(f"\nrows: {results}")
