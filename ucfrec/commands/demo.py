"""`ucfrec demo`: every step from `collect` to `report`, on the logs of two simulated
environments."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import Table
from ucfrec.processes import block_ctrl_c, label_progress, pool_of_processes, progress

if TYPE_CHECKING:
    from ucfrec.results.rows import ResultRow

ENVIRONMENTS = ("synthetic-taobao", "synthetic-catalog")
SHARED = "dt+shared"
PLAIN = ("policy.exposure=false", "rule.choose=false")
"""Settings of a method as its authors describe it: the best item at the largest training return."""
METHODS: dict[str, tuple[str, ...]] = {
    "bc": ("bc", *PLAIN),
    "dt": ("dt", *PLAIN),
    SHARED: ("dt", "policy.exposure=true", "rule.choose=true"),
    "ucf-no-augmentation": ("ucf",),
    "ucf": ("ucf", "augment.copies=1"),
}
"""Name in the results to the policy and the settings that it has besides `DemoConfig.settings`."""
BEHAVIORS = {"logging": "mixture", "random": "random", "optimal": "optimal"}
"""Name in the results to the built-in policy that is evaluated for comparison."""
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
        "train.steps=300",
        "train.learning_rate=2e-3",
        "crm.epochs=4",
        "rule.sessions=50",
        "rule.evidence=0",
    )
    context: int = 11
    dim: int = 32
    methods: Sequence[str] = ("dt", SHARED, "ucf")
    """Names of `METHODS`."""

    def names(self, environment: str) -> list[str]:
        """The methods trained in an environment: the shared components choose among items."""
        vectors = environment == "synthetic-taobao"
        return [name for name in self.methods if not (vectors and name == SHARED)]


FULL = DemoConfig(
    sessions=6000,
    episodes=1000,
    settings=("train.steps=1500", "train.learning_rate=1e-3", "crm.epochs=8"),
    dim=64,
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
        print(
            f"Demo: collect {config.sessions:,} sessions in each of two simulators, train "
            f"{len(config.methods)} policies\non these logs alone, then evaluate them in the "
            f"simulators. Everything goes to {out}."
        )
        with lock_path(out, "filled"):
            remove_leftovers(out.parent)
            rows = demo(out, self.seed, config)
        print(f"\n{evaluation_table(rows)}\n")
        print("What this shows (return: sum of the rewards of a session; [95% interval]):")
        for environment in ENVIRONMENTS:
            by_method = {row.method: row for row in rows if row.environment == environment}
            print(conclusion(environment, by_method))
        print(f"Report with all curves and tables: {out / 'report.html'}")
        print("Next: ucfrec prepare --help, for your own log; docs/quickstart.md has every step.")


def conclusion(environment: str, rows: "Mapping[str, ResultRow]") -> str:
    """What the rows of an environment, by method, show, in words."""
    values = {method: _describe_value(row) for method, row in rows.items()}
    lines = [
        f"- {environment}: logged sessions have {values['logging']}, random actions "
        f"{values['random']}, the best\n  possible ones {values['optimal']}. From the log alone, "
        f"UCF reaches {values['ucf']}."
    ]
    if SHARED in rows:
        lines.append(
            "  Every method can use the shared components (exposure features, reward weight,\n"
            f"  selected decision rule). With them, DT has {values[SHARED]}: "
            f"{_compare(rows[SHARED], rows['dt'], 'DT without them')},\n"
            f"  {values['dt']}. UCF, which has them too, is "
            f"{_compare(rows['ucf'], rows[SHARED], 'DT with them')}."
        )
    else:
        lines.append(
            f"  Actions are vectors, so there are no shared components: UCF is "
            f"{_compare(rows['ucf'], rows['dt'], 'DT')}, {values['dt']}."
        )
    return "\n".join(lines)


def _describe_value(row: "ResultRow") -> str:
    return f"{row.value:.3g} [{row['R_cum_low']:.3g}, {row['R_cum_high']:.3g}]"


def _compare(row: "ResultRow", reference: "ResultRow", name: str) -> str:
    """How a return compares with another one, by 95% intervals that do not overlap."""
    if row["R_cum_low"] > reference["R_cum_high"]:
        return f"above {name}"
    below = row["R_cum_high"] < reference["R_cum_low"]
    return f"below {name}" if below else f"level with {name} (the intervals overlap)"


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
        print(f"Logs of {environment} ({number} of {len(ENVIRONMENTS)}) …")
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
            futures = {pool.submit(_learn, out / job[0], job[1], seed, config): job for job in jobs}
        print(f"Training {len(jobs)} policies, {workers} at a time …")
        with progress(len(jobs), "train and evaluate", "policies") as bar:
            for future in as_completed(futures):
                row = rows[futures[future]] = future.result()
                print(f"  {row.environment}, {row.method}: return {_describe_value(row)}")
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


def _learn(folder: Path, name: str, seed: int, config: DemoConfig) -> "ResultRow":
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
    size = [f"policy.dim={config.dim}"]
    size += [] if policy == "bc" else [f"policy.context={config.context}"]
    resolved = resolve_config(policy, None, [*config.settings, *size, *settings], seed)
    run, shared = folder / name, folder / "stages"
    with label_progress(f"{folder.name}, {name}"):
        train_run(EpisodeStore.open(folder / "store"), run, resolved, shared=shared)
        trained, environment = TrainedPolicy.load(run), Environment(folder.name)
        return evaluate_policy(environment, trained, name, config.episodes, EVALUATION_SEED + seed)
