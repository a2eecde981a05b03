"""`ucfrec benchmark`: measure every method of a benchmark suite and print its tables."""

import argparse
import os
from typing import TYPE_CHECKING

from ucfrec.benchmark.grid import chosen
from ucfrec.commands.grid_options import (
    budget_options,
    grid_options,
    results_given,
    rows_explained,
    rows_given,
)
from ucfrec.commands.options import env_options, environment_given, option
from ucfrec.plugins import load_plugin
from ucfrec.results.rows import benchmarking

if TYPE_CHECKING:
    from ucfrec.benchmark.suite import Benchmark


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec benchmark`."""
    option(
        parser,
        "suite",
        str,
        "recommendation, or a suite of another installed package (entry point ucfrec.benchmarks)",
        "SUITE",
    )
    text = "measure and print only this table; repeatable (default: all tables)"
    option(parser, "--table", str, text, action="append", default=[])
    budget_options(parser)
    logs = parser.add_argument_group("logs")
    option(
        logs,
        "--logs",
        int,
        "logs of each task; simulated with N seeds, or N parts of a given log, 1 for all "
        "of it (default: set by --budget)",
        "N",
    )
    option(logs, "--log-seed", 0, "seed of the first simulated log; the others follow it")
    env_options(
        parser,
        required=False,
        use="; its main table is measured instead of the suite's tasks, on logs of its mixture or, "
        "where it has none, of random actions (default: the suite's tasks)",
    )
    grid_options(parser, "runs/benchmark", os.cpu_count() or 1)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec benchmark`: measure what is missing, then print the tables."""
    from ucfrec.benchmark.suite import BenchmarkRequest, measure, show

    suite: Benchmark = load_plugin("benchmarks", options.suite)
    tables, results = chosen(suite.tables, options.table, "table"), results_given(options)
    if options.show_only:
        with rows_explained(options):
            print(show(suite, tables, rows_given(options, options.suite, tables)))
        return
    request = BenchmarkRequest(
        budget=options.budget,
        tables=tables,
        out=options.out,
        results=results,
        workers=options.workers,
        log_seed=options.log_seed,
        logs=options.logs,
        evaluation_seed=options.evaluation_seed,
        environment=environment_given(options) if options.env else None,
        tasks=options.tasks,
        methods=options.methods,
        training_seeds=options.training_seeds,
        again=options.again,
    )
    with benchmarking(results):
        print(measure(suite, request))
    print(f"\nrows: {results}")
