"""Validation loss of recommenders with and without an average of their weights (train.average).

    python benchmarks/averaged_weights.py --out runs/averaged --seeds 2

One training of each policy, at the small budget's width and learning rate, is averaged with every
decay as it goes on: averaging does not change it. Appends rows to results.jsonl in --out, and
prints, for each decay, the lowest and the last validation loss less those of the raw weights of the
same training, in percent.
"""

import argparse
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.benchmark.cells import Task
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.fitting.loop import Callbacks
from ucfrec.policies.base import SequencePolicy
from ucfrec.provenance import provenance
from ucfrec.reporting.tables import markdown_table, signed_difference
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import append_rows, read_rows
from ucfrec.results.statistics import grouped, summary
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.start import new_policy, training_views
from ucfrec_simulators.benchmark import tasks

DECAYS = (0.0, 0.99, 0.999)
TASKS = ("synthetic-catalog", "kuairand", "sardine-boredinf")
WARMUP = 40
SETTINGS = ("policy.dim=64", "train.learning_rate=1e-3", f"train.warmup_steps={WARMUP}")
SUITE, DECAY = "averaged-weights", "decay"


@dataclass
class Averages:
    """Averages of a policy's weights with several decays, and their validation losses."""

    policy: SequencePolicy
    windows: list[Windows]
    losses: dict[float, list[float]] = field(default_factory=lambda: {d: [] for d in DECAYS})

    def __post_init__(self) -> None:
        self._weights: list[Tensor] = [each.detach() for each in self.policy.parameters()]
        self._means = {d: [each.clone() for each in self._weights] for d in DECAYS}

    def step(self, step: int) -> None:
        """Average the weights of a step, by the formula of `ucfrec.fitting.average`."""
        t = max(0, step - WARMUP)
        for decay, means in self._means.items():
            torch._foreach_lerp_(means, self._weights, 1 - min(decay, t / (9 + t)))

    @torch.no_grad()
    def validate(self) -> None:
        """Add the validation loss of every average."""
        kept = [each.clone() for each in self._weights]
        self.policy.eval()
        for decay, means in self._means.items():
            torch._foreach_copy_(self._weights, means)
            found = torch.stack([self.policy.action_loss(each) for each in self.windows])
            self.losses[decay].append(float(found.mean()))
        torch._foreach_copy_(self._weights, kept)
        self.policy.train()


def task_of(name: str, out: Path, sessions: int) -> Task:
    """The log of a task."""
    return tasks.TASKS[name](out / "logs" / name, tasks.Log(sessions, seed=0))


def losses_of(store: EpisodeStore, config: Config, run: Path) -> dict[float, list[float]]:
    """Validation losses in the course of a training, by the decay of the average."""
    train, validation = training_views(store)
    torch.manual_seed(config.seed)
    policy = new_policy(train, config)
    generator = np.random.default_rng([config.seed, 0])
    windows = [
        validation.windows(*validation.draw_steps(generator, 256), config.policy.context)
        for _ in range(8)
    ]
    averages = Averages(policy, windows)
    callbacks = Callbacks(
        on_step=lambda step, logged: averages.step(step),
        on_validation=lambda step, logged: averages.validate(),
    )
    fit_policy(policy, train, validation, run, config, callbacks=callbacks)
    return averages.losses


def measure(task: Task, policy: str, seed: int, options: argparse.Namespace) -> list[ResultRow]:
    """A row for each decay."""
    settings = (*SETTINGS, f"train.steps={options.steps}", "augment.copies=0")
    config = resolve_config(policy, None, settings, seed)
    run = options.out / "runs" / f"{task.name}-{policy}-{options.steps}-{seed}"
    shutil.rmtree(run, ignore_errors=True)  # an interrupted training has lost its averages
    return [
        ResultRow(
            suite=SUITE,
            table=SUITE,
            task=task.name,
            method=policy,
            policy=policy,
            training_seed=seed,
            conditions={DECAY: decay, "steps": options.steps},
            metric="lowest",
            metrics={"lowest": min(found), "last": found[-1]},
            **provenance(),
        )
        for decay, found in losses_of(EpisodeStore.open(task.store), config, run).items()
    ]


def table(rows: list[ResultRow]) -> str:
    """One line per task, policy and decay but 0: losses less those of raw weights, in percent."""
    raw = {_training(row): row.metrics for row in rows if row.conditions[DECAY] == 0}
    lines = []
    for key, own in grouped(rows, lambda row: (*_training(row)[:3], row.conditions[DECAY])).items():
        if key[-1] == 0:
            continue
        relative = [
            summary(100 * (row.metrics[name] / raw[_training(row)][name] - 1) for row in own)
            for name in ("lowest", "last")
        ]
        less = [signed_difference(s) if s.count > 1 else f"{s.mean:+.3g}" for s in relative]
        loss = f"{summary(row.value for row in own).mean:.4f}"
        lines.append((*map(str, key), loss, *less))
    head = ("task", "policy", "steps", "decay", "lowest loss", "lowest less raw, %")
    return markdown_table((*head, "last less raw, %"), lines)


def _training(row: ResultRow) -> tuple[str, str, object, int | None]:
    return row.task, row.method, row.conditions["steps"], row.training_seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of logs, runs and rows")
    parser.add_argument("--task", action="append", choices=TASKS, help="repeatable (all)")
    parser.add_argument("--policy", action="append", help="repeatable (ucf, dt, sasrec)")
    parser.add_argument("--seeds", type=int, default=2, help="training seeds (default: 2)")
    parser.add_argument("--steps", type=int, default=3000, help="updates (default: 3000)")
    parser.add_argument("--sessions", type=int, default=6000, help="simulated (default: 6000)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = options.out / "results.jsonl"
    done = {_training(row) for row in read_rows(results)}
    for seed in range(options.seeds):
        for name in options.task or TASKS:
            task = task_of(name, options.out, options.sessions)
            for policy in options.policy or ("ucf", "dt", "sasrec"):
                if (task.name, policy, options.steps, seed) not in done:
                    append_rows(results, measure(task, policy, seed, options))
    print(table(read_rows(results)))


if __name__ == "__main__":
    main()
