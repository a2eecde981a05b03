"""`ucfrec demo`: every step from `collect` to `report`, on the logs of two simulated
environments."""

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.processes import pool_of_processes, without_ctrl_c
from ucfrec.progress import progress

if TYPE_CHECKING:
    from ucfrec.results.row import ResultRow

ENVIRONMENTS = ("synthetic-taobao", "synthetic-catalog")
LEARNERS: dict[str, tuple[str, ...]] = {
    "bc": ("bc",),
    "dt": ("dt",),
    "ucf-no-augmentation": ("ucf", "augment.copies=0"),
    "ucf": ("ucf",),
}
"""Name in the results to the learner and the settings that it has besides `DemoConfig.settings`."""
BEHAVIORS = {"logging": "mixture", "random": "random", "optimal": "optimal"}
"""Name in the results to the built-in policy that is evaluated for comparison."""
EVALUATION_SEED = 1_000_000
"""Added to the log seed, so that no evaluated session is one of the logged sessions."""


@dataclass(frozen=True)
class DemoConfig:
    """Sizes of the demo: minutes on two cores."""

    sessions: int = 6000
    """Logged sessions of each environment."""
    episodes: int = 1000
    """Evaluated episodes of each policy."""
    settings: Sequence[str] = (
        "train.steps=1500",
        "train.learning_rate=1e-3",
        "crm.epochs=8",
    )
    context: int = 11
    dim: int = 64


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec demo`."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("demo-out"),
        help="folder for logs, stores, runs and the report; resumed (default: demo-out)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the logs and trainings (default: 0)"
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec demo` and print its result table."""
    from ucfrec.files.locks import claimed, remove_leftovers
    from ucfrec.reporting.tables import evaluation_table

    with claimed(options.out, "filled"):
        remove_leftovers(options.out.parent)
        print(evaluation_table(demo(options.out, options.seed, DemoConfig())))
    print(f"\nreport: {options.out / 'report.html'}; its folder has results, logs and runs")


def demo(out: Path, seed: int, config: DemoConfig) -> "list[ResultRow]":
    """Run the demo in the folder `out`; an interrupted demo that is run again resumes.

    Writes `out/results.json`, `out/report.html` and, in `out/<environment>`, the logs, store and
    runs of each environment, for use with the other commands, and in `stages` what these have in
    common.

    Returns:
        The rows of `out/results.json`: one per environment and policy, environments in the order
        of `ENVIRONMENTS`.
    """
    from ucfrec.evaluation.environment import Environment
    from ucfrec.evaluation.evaluate import evaluate_behavior
    from ucfrec.evaluation.simulated_store import simulated_store
    from ucfrec.reporting.page import write_report
    from ucfrec.results.rows_file import write_results

    for environment in ENVIRONMENTS:
        simulated_store(Environment(environment), out / environment, config.sessions, seed)
    jobs = [(environment, name) for name in reversed(LEARNERS) for environment in ENVIRONMENTS]
    # One thread each: at this size two trainings side by side beat one on two threads.
    workers = min(len(jobs), os.cpu_count() or 1)
    with pool_of_processes(workers) as pool:
        with without_ctrl_c():
            started = [
                pool.submit(_learn, out / environment, name, seed, config)
                for environment, name in jobs
            ]
        with progress(len(jobs), "train and evaluate", "policies") as bar:
            for finished in as_completed(started):
                finished.result()
                bar.update()
        learned = {job: future.result() for job, future in zip(jobs, started, strict=True)}
    rows = []
    for environment in ENVIRONMENTS:
        for name, behavior in BEHAVIORS.items():
            row = evaluate_behavior(
                Environment(environment), behavior, config.episodes, EVALUATION_SEED + seed
            )
            learned[environment, name] = replace(row, method=name)
        order = ("random", "logging", *LEARNERS, "optimal")
        rows += [learned[environment, name] for name in order]
    write_results(out / "results.json", rows)
    runs = [out / environment / name for environment in ENVIRONMENTS for name in LEARNERS]
    items = out / "synthetic-catalog" / "logs" / "items.parquet"
    write_report(out / "report.html", runs, [out / "results.json"], items)
    return rows


def _learn(folder: Path, name: str, seed: int, config: DemoConfig) -> "ResultRow":
    """Train and evaluate the learner `name` in the environment `folder.name`, in a worker
    process."""
    import torch

    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.evaluation.environment import Environment
    from ucfrec.evaluation.evaluate import evaluate_policy
    from ucfrec.runs.config import resolve_config
    from ucfrec.runs.run import train_run
    from ucfrec.runs.shared_stages import SharedStages
    from ucfrec.runs.trained_policy import TrainedPolicy

    torch.set_num_threads(1)
    learner, *settings = LEARNERS[name]
    size = [f"policy.dim={config.dim}"]
    size += [] if learner == "bc" else [f"policy.context={config.context}"]
    resolved = resolve_config(learner, None, [*config.settings, *size, *settings], seed)
    shared = SharedStages(folder / "stages")
    train_run(EpisodeStore.open(folder / "store"), folder / name, resolved, shared=shared)
    trained = TrainedPolicy.load(folder / name)
    return evaluate_policy(
        Environment(folder.name),
        trained,
        name,
        config.episodes,
        EVALUATION_SEED + seed,
    )
