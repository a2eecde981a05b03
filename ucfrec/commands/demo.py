"""`ucfrec demo`: every step from `collect` to `report`, on the logs of two simulated
environments."""

import argparse
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import option
from ucfrec.processes import block_ctrl_c, pool_of_processes
from ucfrec.progress import label_progress, progress

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


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec demo`."""
    option(
        parser,
        "--out",
        Path,
        "folder for logs, stores, runs and the report; resumed (default: demo-out, or "
        "demo-out-full with --full)",
    )
    option(parser, "--seed", 0, "seed of the logs and trainings")
    text = "four times the sessions, five times the training steps and all methods"
    option(parser, "--full", False, f"{text} (default: two minutes of one core)")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec demo`; print its result table and what it shows."""
    config = FULL if options.full else DemoConfig()
    out = options.out or Path("demo-out-full" if options.full else "demo-out")
    _say(
        f"Demo: collect {config.sessions:,} sessions in each of two simulators, train "
        f"{len(config.methods)} policies\non these logs alone, then evaluate them in the "
        f"simulators. Everything goes to {out}."
    )
    from ucfrec.files.locks import lock_path, remove_leftovers
    from ucfrec.reporting.tables import evaluation_table

    with lock_path(out, "filled"):
        remove_leftovers(out.parent)
        rows = demo(out, options.seed, config)
    _say(f"\n{evaluation_table(rows)}\n")
    _say("What this shows (return: sum of the rewards of a session; [95% interval]):")
    for environment in ENVIRONMENTS:
        _say(conclusion(environment, {r.method: r for r in rows if r.environment == environment}))
    _say(f"Report with all curves and tables: {out / 'report.html'}")
    _say("Next: ucfrec prepare --help, for a log of your own; docs/quickstart.md has every step.")


def _say(text: str) -> None:
    """Print at once, so that a pipe shows each line when it is due."""
    print(text, flush=True)


def conclusion(environment: str, rows: "Mapping[str, ResultRow]") -> str:
    """What the rows of an environment, by method, show, in words."""
    lines = [
        f"- {environment}: logged sessions have {_value(rows['logging'])}, random actions "
        f"{_value(rows['random'])}, the best",
        f"  possible ones {_value(rows['optimal'])}. From the log alone, UCF reaches "
        f"{_value(rows['ucf'])}.",
    ]
    if SHARED in rows:
        lines += [
            "  Every method can use the shared components (exposure features, reward weight,",
            f"  selected decision rule). With them, DT has {_value(rows[SHARED])}: "
            f"{_compared(rows[SHARED], rows['dt'], 'DT without them')},",
            f"  {_value(rows['dt'])}. UCF, which has them too, is "
            f"{_compared(rows['ucf'], rows[SHARED], 'DT with them')}.",
        ]
    else:
        lines.append(
            f"  Actions are vectors, so there are no shared components: UCF is "
            f"{_compared(rows['ucf'], rows['dt'], 'DT')}, {_value(rows['dt'])}."
        )
    return "\n".join(lines)


def _value(row: "ResultRow") -> str:
    low, high = row.interval or (row.value, row.value)
    return f"{row.value:.3g} [{low:.3g}, {high:.3g}]"


def _compared(one: "ResultRow", other: "ResultRow", name: str) -> str:
    """How a return compares with another one, by 95% intervals that do not overlap."""
    (low, high), (other_low, other_high) = (
        row.interval or (row.value, row.value) for row in (one, other)
    )
    if low > other_high:
        return f"above {name}"
    return f"below {name}" if high < other_low else f"level with {name} (the intervals overlap)"


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
        (environment, name)
        for name in reversed(config.methods)
        for environment in ENVIRONMENTS
        if name in config.names(environment)
    ]
    # One thread each: at this size two trainings side by side beat one on two threads.
    workers = min(len(jobs), os.cpu_count() or 1)
    with pool_of_processes(workers) as pool:
        with block_ctrl_c():
            started = [
                pool.submit(_learn, out / environment, name, seed, config)
                for environment, name in jobs
            ]
        _say(f"Training {len(jobs)} policies, {workers} at a time …")
        with progress(len(jobs), "train and evaluate", "policies") as bar:
            for finished in as_completed(started):
                row = finished.result()
                _say(f"  {row.environment}, {row.method}: return {_value(row)}")
                bar.update()
        learned = {job: future.result() for job, future in zip(jobs, started, strict=True)}
    rows = []
    for environment in ENVIRONMENTS:
        for name, behavior in BEHAVIORS.items():
            row = evaluate_behavior(
                Environment(environment), behavior, config.episodes, EVALUATION_SEED + seed
            )
            learned[environment, name] = replace(row, method=name)
        order = ("random", "logging", *config.names(environment), "optimal")
        rows += [learned[environment, name] for name in order]
    write_results(out / "results.json", rows)
    runs = [
        out / environment / name
        for environment in ENVIRONMENTS
        for name in config.names(environment)
    ]
    items = out / "synthetic-catalog" / "logs" / "items.parquet"
    write_report(out / "report.html", runs, [out / "results.json"], items)
    return rows


def _learn(folder: Path, name: str, seed: int, config: DemoConfig) -> "ResultRow":
    """Train and evaluate the method `name` in the environment `folder.name`, in a worker
    process."""
    import torch

    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.evaluation.evaluate import evaluate_policy
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.runs.config import resolve_config
    from ucfrec.runs.run import train_run
    from ucfrec.runs.shared_stages import SharedStages
    from ucfrec.runs.trained_policy import TrainedPolicy

    torch.set_num_threads(1)
    policy, *settings = METHODS[name]
    size = [f"policy.dim={config.dim}"]
    size += [] if policy == "bc" else [f"policy.context={config.context}"]
    resolved = resolve_config(policy, None, [*config.settings, *size, *settings], seed)
    shared = SharedStages(folder / "stages")
    with label_progress(f"{folder.name}, {name}"):
        train_run(EpisodeStore.open(folder / "store"), folder / name, resolved, shared=shared)
        trained = TrainedPolicy.load(folder / name)
        return evaluate_policy(
            Environment(folder.name),
            trained,
            name,
            config.episodes,
            EVALUATION_SEED + seed,
        )
