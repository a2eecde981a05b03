"""`ucfrec demo`: every step from `collect` to `report`, on the logs of two simulated
environments."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import Table
from ucfrec.processes import block_ctrl_c, label_progress, pool_of_processes, progress

if TYPE_CHECKING:
    from ucfrec.results.rows import ResultRow

ENVIRONMENTS = ("synthetic-taobao", "synthetic-catalog")
SHARED = "dt+shared"
CONTEXT = "policy.context=11"
PLAIN = ("policy.exposure=false", "rule.choose=false")
"""Settings of a method as its authors describe it: the best item at the largest training return."""
METHODS: dict[str, tuple[str, ...]] = {
    "bc": ("bc", *PLAIN),
    "dt": ("dt", CONTEXT, *PLAIN),
    SHARED: ("dt", CONTEXT, "policy.exposure=true", "rule.choose=true"),
    "ucf-no-augmentation": ("ucf", CONTEXT),
    "ucf": ("ucf", CONTEXT, "augment.copies=1"),
}
"""Name in the results to the policy and the settings that it has besides `DemoConfig.settings`."""
BEHAVIORS = {"logging": "mixture", "random": "random", "optimal": "optimal"}
"""Name in the results to the built-in policy that is evaluated for comparison."""
_say = partial(print, flush=True)
"""Print at once, so that a pipe shows each line when it is due."""
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
        "policy.dim=32",
        "train.steps=300",
        "train.learning_rate=2e-3",
        "crm.epochs=4",
        "rule.sessions=50",
        "rule.evidence=0",
    )
    methods: Sequence[str] = ("dt", SHARED, "ucf")
    """Names of `METHODS`."""

    def names(self, environment: str) -> list[str]:
        """The methods trained in an environment: the shared components choose among items."""
        vectors = environment == "synthetic-taobao"
        return [name for name in self.methods if not (vectors and name == SHARED)]


FULL = DemoConfig(
    sessions=6000,
    episodes=1000,
    settings=("policy.dim=64", "train.steps=1500", "train.learning_rate=1e-3", "crm.epochs=8"),
    methods=tuple(METHODS),
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
        from ucfrec.files.atomic import lock_path, remove_leftovers
        from ucfrec.reporting.tables import evaluation_table

        config = FULL if self.full else DemoConfig()
        out = self.out or Path("demo-out-full" if self.full else "demo-out")
        _say(
            f"Demo: collect {config.sessions:,} sessions in each of two simulators, train "
            f"{len(config.methods)} policies\non these logs alone, then evaluate them in the "
            f"simulators. Everything goes to {out}."
        )
        with lock_path(out, "filled"):
            remove_leftovers(out.parent)
            rows = demo(out, self.seed, config)
        _say(f"\n{evaluation_table(rows)}\n")
        _say("What this shows (return: sum of the rewards of a session; [95% interval]):")
        for environment in ENVIRONMENTS:
            by_method = {row.method: row for row in rows if row.environment == environment}
            _say(conclusion(environment, by_method))
        _say(f"Report with all curves and tables: {out / 'report.html'}")
        _say("Next: ucfrec prepare --help, for your own log; docs/quickstart.md has every step.")


def conclusion(environment: str, rows: "Mapping[str, ResultRow]") -> str:
    """What the rows of an environment, by method, show, in words."""
    values = {method: _describe_value(row) for method, row in rows.items()}
    shared = "there are no shared components, as actions are vectors"
    if SHARED in rows:
        shared = (
            f"with the shared components, which UCF has too and any method can use, DT has\n"
            f"  {values[SHARED]} (exposure features, reward weight, selected decision rule)"
        )
    return (
        f"- {environment}: logged sessions have {values['logging']}, random actions "
        f"{values['random']}, the best\n  possible ones {values['optimal']}. From the log alone, "
        f"UCF reaches {values['ucf']}, DT {values['dt']};\n  {shared}.\n"
        "  Where two intervals overlap, the order is unclear."
    )


def _describe_value(row: "ResultRow") -> str:
    return f"{row.value:.3g} [{row['R_cum_low']:.3g}, {row['R_cum_high']:.3g}]"


def demo(out: Path, seed: int, config: DemoConfig) -> "list[ResultRow]":
    """Run the demo in the folder `out`; an interrupted demo that is run again resumes.

    Writes `out/results.json`, `out/report.html` and, in `out/<environment>`, the logs, store and
    runs of each environment, for use with the other commands, and in `stages` what these have in
    common.

    Returns:
        The rows of `out/results.json`: one per environment and policy, environments in the order
        of `ENVIRONMENTS`.
    """
    from ucfrec.evaluation.collect import collect_store
    from ucfrec.evaluation.evaluate import evaluate_behavior
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.reporting.page import write_report
    from ucfrec.results.rows import write_results

    for number, environment in enumerate(ENVIRONMENTS, 1):
        _say(f"Logs of {environment} ({number} of {len(ENVIRONMENTS)}) …")
        collect_store(Environment(environment), out / environment, config.sessions, seed)
    jobs = [
        (environment, name) for environment in ENVIRONMENTS for name in config.names(environment)
    ]
    # The longest ones first. One thread each: at this size two trainings side by side beat one on
    # two threads.
    jobs.sort(key=lambda job: -config.methods.index(job[1]))
    workers = min(len(jobs), os.cpu_count() or 1)
    rows: dict[tuple[str, str], ResultRow] = {}
    with pool_of_processes(workers) as pool:
        with block_ctrl_c():
            futures = {
                pool.submit(
                    _learn,
                    out / job[0],
                    job[1],
                    seed,
                    config,
                ): job
                for job in jobs
            }
        _say(f"Training {len(jobs)} policies, {workers} at a time …")
        with progress(len(jobs), "train and evaluate", "policies") as bar:
            for future in as_completed(futures):
                row = rows[futures[future]] = future.result()
                _say(f"  {row.environment}, {row.method}: return {_describe_value(row)}")
                bar.update()
    ordered, runs = [], []
    for environment in ENVIRONMENTS:
        for name, behavior in BEHAVIORS.items():
            row = evaluate_behavior(
                Environment(environment), behavior, config.episodes, EVALUATION_SEED + seed
            )
            rows[environment, name] = replace(row, method=name)
        names = config.names(environment)
        ordered += [rows[environment, name] for name in ("random", "logging", *names, "optimal")]
        runs += [out / environment / name for name in names]
    write_results(out / "results.json", ordered)
    items = out / "synthetic-catalog" / "logs" / "items.parquet"
    write_report(out / "report.html", runs, [out / "results.json"], items)
    return ordered


def _learn(
    folder: Path,
    name: str,
    seed: int,
    config: DemoConfig,
) -> "ResultRow":
    """Train and evaluate a method in the environment `folder.name`, in a worker process."""
    import torch

    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.evaluation.evaluate import evaluate_policy
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.runs.config import resolve_config
    from ucfrec.runs.run import train_run
    from ucfrec.runs.trained_policy import TrainedPolicy

    torch.set_num_threads(1)
    policy, *settings = METHODS[name]
    resolved = resolve_config(policy, None, [*config.settings, *settings], seed)
    run, shared = folder / name, folder / "stages"
    with label_progress(f"{folder.name}, {name}"):
        train_run(EpisodeStore.open(folder / "store"), run, resolved, shared=shared)
        trained, environment = TrainedPolicy.load(run), Environment(folder.name)
        return evaluate_policy(environment, trained, name, config.episodes, EVALUATION_SEED + seed)
