"""`ucfrec demo`: every step from `collect` to `report`, on the logs of two simulators."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import Table
from ucfrec.plugins import load_plugin

if TYPE_CHECKING:
    from ucfrec.benchmark.suite import Benchmark
    from ucfrec.results.rows import ResultRow

ENVIRONMENTS = ("synthetic-taobao", "synthetic-catalog")
SHARED = "dt+shared"
BEHAVIORS = ("optimal", "mixture", "random")
"""Built-in policies that are evaluated for comparison; the mixture made the logs."""
EVALUATION_SEED = 1_000_000
"""Added to the log seed, so that no evaluated session is one of the logged sessions."""


@dataclass(frozen=True)
class DemoConfig:
    """Sizes of the demo: by default at most two minutes of one core."""

    sessions: int = 1500
    """Logged sessions of each environment."""
    episodes: int = 500
    """Evaluated episodes of each policy."""
    settings: Sequence[str] = (
        *("policy.dim=32", "policy.context=11", "train.steps=300", "train.learning_rate=2e-3"),
        *("crm.epochs=4", "rule.sessions=50", "rule.evidence=0"),
    )
    """Of all methods."""
    methods: Sequence[str] = ("ucf", SHARED, "dt")
    """Names of the recommendation benchmark's methods; the longest training first."""


FULL = DemoConfig(
    sessions=6000,
    episodes=1000,
    settings=(
        *("policy.dim=64", "policy.context=11", "train.steps=1500", "train.learning_rate=1e-3"),
        "crm.epochs=8",
    ),
    methods=("ucf", "ucf-wo-count", SHARED, "dt", "sasrec"),
)
"""Sizes at which the methods differ as in the documentation: a quarter of an hour on two cores."""


class Demo(Table):
    """`ucfrec demo`."""

    out: Path | None = None
    """Folder for logs, stores, runs and the report; resumed (default: demo-out, or demo-out-full
    with --full)"""
    seed: int = 0
    """Seed of the logs and trainings."""
    full: bool = False
    """Four times the sessions, five times the training steps and all methods (default: two minutes
    of one core)"""

    def execute(self) -> None:
        """Print the result table and what it shows."""
        from ucfrec.reporting.tables import evaluation_table

        config = FULL if self.full else DemoConfig()
        out = self.out or Path("demo-out-full" if self.full else "demo-out")
        print(
            f"Demo: collect {config.sessions:,} sessions in each of two simulators, train "
            f"{len(config.methods)} policies\non these logs alone, then evaluate them in the "
            f"simulators. Everything goes to {out}.",
            flush=True,
        )
        rows = demo(out, self.seed, config)
        print(f"\n{evaluation_table(rows)}\n")
        print("What this shows (return: sum of the rewards of a session; [95% interval]):")
        for environment in ENVIRONMENTS:
            by_method = {row.method: row for row in rows if row.task == environment}
            print(conclusion(environment, by_method))
        print(f"Report with all curves and tables: {out / 'report.html'}")
        print("Next: ucfrec prepare --help, for your own log; docs/quickstart.md has every step.")


def conclusion(environment: str, rows: "Mapping[str, ResultRow]") -> str:
    """What the rows of an environment, by method, show, in words."""
    values = {
        method: f"{row.value:.3g} [{row['R_cum_low']:.3g}, {row['R_cum_high']:.3g}]"
        for method, row in rows.items()
    }
    if SHARED in rows:
        shared = f"with the shared components, which any method can use, DT has {values[SHARED]}"
    else:
        shared = "there are no shared components, as actions are vectors"
    return (
        f"- {environment}: logged sessions have {values['mixture']}, random actions "
        f"{values['random']}, the best\n  possible ones {values['optimal']}. From the log alone, "
        f"UCF reaches {values['ucf']}, DT {values['dt']};\n  {shared}.\n"
        "  Where two intervals overlap, the order is unclear."
    )


def demo(out: Path, seed: int, config: DemoConfig) -> "list[ResultRow]":
    """Run the demo in the folder `out`; an interrupted demo that is run again resumes.

    Writes `out/results.jsonl`, `out/report.html` and, in `out/<environment>`, the logs, store and
    runs of each environment, for use with the other commands, and in `stages` what these have in
    common.

    Returns:
        One row per environment and policy, environments in the order of `ENVIRONMENTS`.
    """
    from ucfrec.benchmark.cells import Cell, Evaluation
    from ucfrec.benchmark.grid import run_grid
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.evaluation.collect import collect_store
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.reporting.page import write_report
    from ucfrec.results.rows import benchmarking

    suite: Benchmark = load_plugin("benchmarks", "recommendation")
    results, cells = out / "results.jsonl", []
    evaluation = Evaluation(config.episodes, EVALUATION_SEED + seed)
    with benchmarking(results):
        for name in ENVIRONMENTS:
            environment, folder = Environment(name), out / name
            store = EpisodeStore.open(collect_store(environment, folder, config.sessions, seed))
            cell = partial(
                Cell, "demo", "demo", name, evaluation=evaluation, environments=(environment,)
            )
            cells += [cell(behavior, behavior) for behavior in BEHAVIORS]
            cells += [
                cell(
                    name,
                    method.policy,
                    training_seed=seed,
                    store=store.path,
                    run=folder / name,
                    shared=folder / "stages",
                    settings=(*config.settings, *method.settings),
                    conditioned=method.conditioned,
                )
                for name in config.methods
                if (method := suite.methods[name]).supports(store)
            ]
        # One thread each: at this size two trainings side by side beat one on two threads.
        rows = run_grid(cells, suite.how, results, os.cpu_count() or 1, "train and evaluate")
        runs = [cell.run for cell in cells if cell.run is not None]
        items = out / "synthetic-catalog" / "logs" / "items.parquet"
        write_report(out / "report.html", runs, [results], items)
    return rows
