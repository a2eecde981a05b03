"""`ucfrec benchmark`: measure every method of a benchmark suite and print its tables; and the
options of all commands that measure the cells of a benchmark."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from ucfrec.commands.options import ARGUMENT, POSITIVE, SEED, Group, Table, settings_given
from ucfrec.commands.shared_options import EnvironmentOptions
from ucfrec.errors import InputError, damage_explained
from ucfrec.plugins import load_plugin
from ucfrec.results.rows import ResultRow, benchmarking, latest, read_rows

if TYPE_CHECKING:
    from ucfrec.benchmark.suite import Benchmark as Suite

ROWS_REMEDY: Final = "measure its rows again, or name another file with --results"
_LOGS = Group("logs and seeds")


class GridOptions(Table):
    """Where result rows are, and how they are measured."""

    described_by = "ucfrec.benchmark.suite:BenchmarkRequest"

    out: Path = Path("runs/benchmark")
    results: Annotated[Path | None, "JSONL"] = None
    """File of result rows; measured cells are read from it, new ones appended to it (default:
    results.jsonl in --out)"""
    workers: Annotated[int, POSITIVE] = os.cpu_count() or 1
    again: bool = False
    show_only: bool = False
    """Print the tables from the rows in --results without measuring anything."""

    @property
    def rows_file(self) -> Path:
        """The file of result rows."""
        return self.results or self.out / "results.jsonl"

    def read_rows(self, suite: str, tables: Sequence[str] = ()) -> list[ResultRow]:
        """The last rows of each measurement in the file.

        Args:
            tables: tables of the suite; empty for all.
        """
        rows = [row for row in latest(read_rows(self.rows_file)) if row.suite == suite]
        if rows := [row for row in rows if not tables or row.table in tables]:
            return rows
        raise InputError(
            f"{self.rows_file} has no rows of {', '.join([suite, *tables])}; name a file that has "
            "them with --results"
        )


class Benchmark(EnvironmentOptions, GridOptions):
    """`ucfrec benchmark`."""

    described_by = "ucfrec.benchmark.suite:BenchmarkRequest"

    suite: Annotated[str, ARGUMENT, "SUITE"]
    """recommendation, or a suite of another installed package (entry point ucfrec.benchmarks)"""
    table: Sequence[str] = ()
    """Measure and print only this table; repeatable (default: all tables)"""
    budget: Literal["small", "full"] = "small"
    """small (for two CPU cores), full (larger logs, more seeds and training steps)"""
    task: Annotated[Sequence[str], "NAME"] = ()
    """Measure only this task; repeatable (default: all of the budget)"""
    method: Annotated[Sequence[str], "NAME"] = ()
    """Measure only this method; repeatable (default: all of the budget)"""
    env: str | None = None
    """Simulator or gymnasium:ID; its main table is measured instead of the suite's tasks, on logs
    of its mixture or, where it has none, of random actions (default: the suite's tasks)"""
    logs: Annotated[int | None, _LOGS, POSITIVE, "N"] = None
    log_seed: Annotated[int, _LOGS] = 0
    training_seeds: Annotated[int | None, _LOGS, POSITIVE, "N"] = None
    evaluation_seed: Annotated[int | None, _LOGS, SEED, "SEED"] = None

    def execute(self) -> None:
        """Measure what is missing, then print the tables."""
        from ucfrec.benchmark.grid import select_names
        from ucfrec.benchmark.suite import BenchmarkRequest, measure, show

        suite: Suite = load_plugin("benchmarks", self.suite)
        tables = select_names(suite.tables, self.table, "table")
        if self.show_only:
            with damage_explained(self.rows_file, ROWS_REMEDY):
                print(show(suite, tables, self.read_rows(self.suite, tables)))
            return
        settings = settings_given(self, BenchmarkRequest) | {"results": self.rows_file}
        if self.env:
            settings["environment"] = self.make_environment(self.env)
        request = BenchmarkRequest(tables=tables, tasks=self.task, methods=self.method, **settings)
        with benchmarking(self.rows_file):
            print(measure(suite, request))
        print(f"\nrows: {self.rows_file}")
