"""`ucfrec evaluate`, `collect` and `benchmark`: policies in simulated environments, logs of them,
and the tables of a benchmark suite; and the options of all commands that measure its cells."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ucfrec.commands.options import ARGUMENT, POSITIVE, SEED, Group, Table, settings_given
from ucfrec.commands.shared_options import RuleOptions
from ucfrec.errors import InputError, damage_explained
from ucfrec.plugins import load_plugin
from ucfrec.results.rows import ResultRow, benchmarking, latest, read_rows

if TYPE_CHECKING:
    from ucfrec.benchmark.suite import Benchmark as Suite
    from ucfrec.evaluation.simulator import Environment

ROWS_REMEDY = "measure its rows again, or name another file with --results"
_LOGS = Group("logs and seeds")


class EnvironmentOptions(Table):
    """The parts of an environment."""

    title = "the environment"

    env_folder: Path | None = None
    """Folder with the simulator's files, e.g. its weights (default: none)"""
    observe: Annotated[str, "KEY[,KEY…]"] = ""
    """Of gymnasium:ID with a dict observation: entries that are observed, as one vector (default:
    none, states come from the items shown and their rewards)"""
    item_features: str | None = None
    """Of gymnasium:ID with items: their features, from an attribute of the environment or a file
    .npy (a row for each item) or .parquet (with a column item_id from 0) (default: none)"""

    def make_environment(self, name: str) -> "Environment":
        """The environment of that name with these parts."""
        from ucfrec.evaluation.simulator import Environment

        observe = tuple(key for key in self.observe.split(",") if key)
        return Environment(name, self.env_folder, observe=observe, item_features=self.item_features)


class SimulationOptions(EnvironmentOptions):
    """Sessions in an environment."""

    env: Annotated[str, Group("")]
    """Simulator, e.g. synthetic-taobao, or gymnasium:ID, any Gymnasium environment
    (gymnasium:MODULE:ID imports MODULE first)"""
    seed: Annotated[int, Group("")] = 0
    """Seed of the sessions."""


class Evaluate(SimulationOptions, RuleOptions):
    """`ucfrec evaluate`."""

    described_by = "ucfrec.python_api.recommender:Recommender.evaluate"

    runs: Annotated[Sequence[Path], ARGUMENT, "RUN"] = ()
    """Run folders of `ucfrec train`."""
    episodes: int = 1000
    behavior: Sequence[str] = ()
    """Also evaluate this policy of the simulator, e.g. random; repeatable (default: none)"""
    json: Path | None = None
    """Also write the rows as JSON."""

    def execute(self) -> None:
        """Print one row per policy."""
        from ucfrec.reporting.measuring import evaluate_in
        from ucfrec.reporting.tables import evaluation_table

        environment = self.make_environment(self.env)
        if not self.runs and not self.behavior:
            raise InputError("name a run folder, or a built-in policy with --behavior")
        policies = [self.load(run) for run in dict.fromkeys(self.runs)]
        evaluation = evaluate_in(
            environment,
            [(policy, self.make_rule(policy)) for policy in policies],
            self.behavior,
            episodes=self.episodes,
            seed=self.seed,
            checkpoint=self.checkpoint,
        )
        print(evaluation_table(list(evaluation)))
        print(
            "\nR_cum: mean return of a session, the sum of its rewards, with a 95% interval; where "
            "two overlap, the order is unclear.\nR_avg: reward per step, over all steps (pooled) "
            "or in the mean of sessions (episode)."
        )
        if self.json:
            evaluation.save(self.json)
            runs = shlex.join(map(str, self.runs)) or "RUN"
            file = shlex.quote(str(self.json))
            print(f"next: ucfrec report {runs} --results {file} --out report.html")


class Collect(SimulationOptions):
    """`ucfrec collect`."""

    behavior: str | None = None
    """Built-in policy that acts in the sessions (default: mixture if any, else random)"""
    sessions: int = 20_000
    """Number of sessions."""
    out: Path
    """New folder for the logs."""

    def execute(self) -> None:
        """Simulate sessions and write them as Parquet logs."""
        from ucfrec.evaluation.collect import collect

        environment = self.make_environment(self.env)
        simulator = environment.simulator()
        behavior = self.behavior or simulator.logging_behavior
        env, actor = environment.start(256, behavior, self.seed)
        details = {"env_name": environment.title, "behavior": behavior}
        played = collect(simulator, env, actor, self.sessions, self.seed, self.out, **details)
        size = (env.single_observation_space.shape or (0,))[0]
        observation = f"observation of {size} numbers"
        if not size:
            observation = "no observation: states come from the items shown and their rewards"
        print(
            f"{self.out}: {self.sessions} sessions of {behavior}, {int(played.lengths.sum())} "
            f"steps, mean return {played.returns.mean():.3f}; reward column {simulator.feedback}; "
            f"{observation}"
        )


class GridOptions(Table):
    """Where result rows are, and how they are measured."""

    described_by = "ucfrec.benchmark.suite:BenchmarkRequest"

    out: Path = Path("runs/benchmark")
    results: Path | None = None
    """JSON lines of result rows; measured cells are read from it, new ones appended to it (default:
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

    suite: Annotated[str, ARGUMENT]
    """recommendation, or a suite of another installed package (entry point ucfrec.benchmarks)"""
    table: Sequence[str] = ()
    """Measure and print only this table; repeatable (default: all tables)"""
    budget: Literal["small", "full"] = "small"
    """small (for two CPU cores), full (larger logs, more seeds and training steps)"""
    task: Sequence[str] = ()
    """Measure only this task; repeatable (default: all of the budget)"""
    method: Sequence[str] = ()
    """Measure only this method; repeatable (default: all of the budget)"""
    env: str | None = None
    """Simulator or gymnasium:ID; its main table is measured instead of the suite's tasks, on logs
    of its mixture or, where it has none, of random actions (default: the suite's tasks)"""
    logs: Annotated[int | None, _LOGS, POSITIVE] = None
    log_seed: Annotated[int, _LOGS] = 0
    training_seeds: Annotated[int | None, _LOGS, POSITIVE] = None
    evaluation_seed: Annotated[int | None, _LOGS, SEED] = None

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
