"""What counterfactual copies are worth: state copies, action copies, both and reward weight,
against none.

    python benchmarks/counterfactual_copies.py --out runs/copies

Trains UCF on logs of the synthetic catalogue, of several sizes, without and with a hidden mood of
each session that moves both what the log shows and what is clicked (a confounder, planted in
`ucfrec_simulators.synthetic_catalog`). Every arm of a log and a training seed is evaluated in the
same episodes of the environment of its log: the evaluation seed is fixed. Policies act by argmax
at the largest training return; only `none+reward_weight` chooses, on its log, a weight of the
reward model.

Appends the rows to results.jsonl in --out, or to --results; a measured row is not measured again.
Prints each arm's return less that of `none`, paired by log and training seed: the mean, its
standard error over all pairs, that of the means of logs, which counts what logs differ by, and how
many pairs are ahead.
"""

import argparse
import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_policy
from ucfrec.evaluation.simulated_store import simulated_store
from ucfrec.evaluation.simulator import Simulator
from ucfrec.reporting.evaluation_rows import evaluation_row
from ucfrec.reporting.grid import Measurement, chosen, run_grid
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.reporting.statistics import Summary, grouped, summary
from ucfrec.reporting.tables import NONE, markdown_table
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators import synthetic_catalog

EVALUATION_SEED: Final = 1_000_000
SIZE: Final = ("policy.dim=64", "policy.context=11", "train.learning_rate=1e-3")
TILT: Final = (
    *("rule.choose=true", "rule.quantiles=[1.0]"),
    *("rule.temperatures=[0.0]", "rule.tag_windows=[0]"),
)
ARMS: Final = {
    "none": ("augment.copies=0",),
    "state": ("augment.copies=1",),
    "action": ("augment.copies=0", "augment.actions=2"),
    "both": ("augment.copies=1", "augment.actions=2"),
    "none+reward weight": ("augment.copies=0", *TILT),
}
"""Settings of each arm beside `SIZE`."""


@dataclass(frozen=True)
class Catalogue(Environment):
    """The synthetic catalogue, with or without moods."""

    mood: float = field(default=0.0, kw_only=True)
    """See `SyntheticCatalog`."""

    def simulator(self) -> Simulator:
        """The simulator with this mood."""
        return synthetic_catalog.simulator(self.mood)


@dataclass(frozen=True)
class Cell:
    """One training and its evaluation."""

    out: Path
    mood: float
    sessions: int
    log_seed: int
    training_seed: int
    arm: str
    steps: int
    episodes: int

    @property
    def environment(self) -> Catalogue:
        """The environment of the log and of the evaluation."""
        return Catalogue("synthetic-catalog", mood=self.mood)

    @property
    def folder(self) -> Path:
        """Folder of the log and its runs."""
        return self.out / f"mood-{self.mood:g}-sessions-{self.sessions}-log-{self.log_seed}"

    @property
    def config(self) -> Config:
        """Training configuration."""
        given = [*SIZE, f"train.steps={self.steps}", "rule.choose=false", *ARMS[self.arm]]
        return resolve_config("ucf", None, given, self.training_seed)


def key(cell: Cell) -> RowKey:
    modules = ("ucfrec.runs.run", "ucfrec.policies.ucf", "ucfrec.evaluation.evaluate")
    return RowKey(
        suite="counterfactual-copies",
        table="counterfactual-copies",
        task=f"{cell.sessions} sessions",
        method=cell.arm,
        policy="ucf",
        training_seed=cell.training_seed,
        log_seed=cell.log_seed,
        evaluation_seed=EVALUATION_SEED,
        conditions={"mood": cell.mood, "sessions": cell.sessions, "episodes": cell.episodes},
        code_version=code_version(Path(__file__), *modules, "ucfrec_simulators.synthetic_catalog"),
        data_fingerprint=EpisodeStore.open(cell.folder / "store").record.fingerprint,
    )


def config(cell: Cell) -> dict[str, Any]:
    return asdict(cell.config)


def measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    run = cell.folder / f"{cell.arm}-{cell.training_seed}-{cell.steps}-{row_key.code_version}"
    record = train_run(EpisodeStore.open(cell.folder / "store"), run, cell.config)
    trained = TrainedPolicy.load(run)
    found = evaluate_policy(cell.environment, trained, cell.arm, cell.episodes, EVALUATION_SEED)
    found |= {
        "train_wall_time_s": record.wall_time_s,
        "validation_loss": record.finished.best_validation,
    }
    details: dict[str, Any] = {}
    if (report := record.augmentation) is not None:
        found |= {"acceptance": report.acceptance, "delta": report.delta}
        found |= {"r2_without_z": report.reward_model.r2_without_z}
        details = {"actions": report.actions and asdict(report.actions)}
    return [evaluation_row(found, row_key, details=details, rule=str(trained.rule))]


Pair = tuple[int | None, int | None]
"""Seeds of a log and of a training on it."""


class Compared(NamedTuple):
    """Differences of one arm to `none`."""

    pairs: Summary
    """Over pairs of a log and a training seed."""
    logs: Summary
    """Over the means of logs."""
    ahead: int
    """Pairs with a difference above 0."""


Differences = dict[str, Compared]
"""By arm."""


def compared(rows: Sequence[ResultRow]) -> dict[tuple[float, int], Differences]:
    """Differences of each arm's return to that of `none`, by (mood, sessions)."""
    found = {}
    for (mood, sessions), own in grouped(rows, _case).items():
        of_arm = _by_arm(own)
        base = of_arm.get("none", {})
        found[mood, sessions] = {arm: _summaries(_less(v, base)) for arm, v in of_arm.items()}
    return found


def over_sizes(rows: Sequence[ResultRow]) -> dict[float, Differences]:
    """The same in percent of the mean return of `none` at a size, in the mean over sizes, by mood.

    Pairs that lack a size are left out, and moods with one size.
    """
    found = {}
    for mood, group in grouped(rows, lambda row: _case(row)[0]).items():
        sizes = grouped(group, lambda row: _case(row)[1])
        relative: dict[str, dict[Pair, list[float]]] = {}
        for own in sizes.values():
            of_arm = _by_arm(own)
            base = of_arm.get("none", {})
            for arm, values in of_arm.items():
                for pair, difference in _less(values, base).items():
                    share = 100 * difference / float(np.mean([*base.values()]))
                    relative.setdefault(arm, {}).setdefault(pair, []).append(share)
        if len(sizes) > 1:
            found[mood] = {
                arm: _summaries(
                    {p: float(np.mean(v)) for p, v in of.items() if len(v) == len(sizes)}
                )
                for arm, of in relative.items()
            }
    return found


def _case(row: ResultRow) -> tuple[float, int]:
    return float(str(row.conditions["mood"])), int(str(row.conditions["sessions"]))


def _by_arm(rows: Sequence[ResultRow]) -> dict[str, dict[Pair, float]]:
    return {
        arm: {(row.log_seed, row.training_seed): row.value for row in own}
        for arm, own in grouped(rows, lambda row: row.method).items()
    }


def _less(values: dict[Pair, float], base: dict[Pair, float]) -> dict[Pair, float]:
    return {pair: value - base[pair] for pair, value in values.items() if pair in base}


def _summaries(differences: dict[Pair, float]) -> Compared:
    by_log = grouped(differences.items(), lambda item: item[0][0]).values()
    over_logs = summary(float(np.mean([d for _, d in own])) for own in by_log)
    ahead = sum(difference > 0 for difference in differences.values())
    return Compared(summary(differences.values()), over_logs, ahead)


def difference_table(rows: Sequence[ResultRow]) -> str:
    """Paired differences to the arm `none`, as Markdown; over all sizes in percent."""
    cases, lines = grouped(rows, lambda row: (*_case(row), row.method)), []
    for (mood, sessions), of_arm in sorted(compared(rows).items()):
        for arm in _in_order(of_arm):
            mean = f"{summary(row.value for row in cases[mood, sessions, arm]).mean:.3f}"
            lines.append((f"{mood:g}", sessions, arm, mean, *_told(arm, of_arm, 3, "")))
    for mood, of_arm in sorted(over_sizes(rows).items()):
        arms = [name for name in _in_order(of_arm) if name != "none"]
        lines += [(f"{mood:g}", "all", arm, NONE, *_told(arm, of_arm, 1, "%")) for arm in arms]
    head = ("mood", "sessions", "arm", "R_cum", "− none", "SE over pairs", "SE over logs", "ahead")
    return markdown_table(head, lines)


def _in_order(of_arm: Differences) -> list[str]:
    return [name for name in ARMS if name in of_arm]


def _told(arm: str, of_arm: Differences, digits: int, unit: str) -> list[str]:
    """The last four columns of the table."""
    over, over_logs, ahead = of_arm[arm]
    if arm == "none" or not over.count:
        return [NONE] * 4
    errors = [
        f"{each.standard_error:.{digits}f}{unit}" if each.count > 1 else NONE
        for each in (over, over_logs)
    ]
    return [f"{over.mean:+.{digits}f}{unit}", *errors, f"{ahead} of {over.count}"]


def announcement(workers: int) -> Callable[[Sequence[Cell]], str]:
    """What a benchmark of so many processes says of the cells that are left, before it starts."""

    def said(cells: Sequence[Cell]) -> str:
        # Of one idle core: 0.05 s a step, the rest for copies and evaluation.
        hours = sum(0.05 * cell.steps + 0.01 * cell.episodes for cell in cells) / workers / 3600
        return f"about {hours:.1f} hours with --workers {workers} on two idle cores"

    return said


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the runs; resumed")
    parser.add_argument(
        "--results", type=Path, help="file of result rows (default: results.jsonl in --out)"
    )
    for name, kind, default, what in (
        ("--sessions", int, [300, 1500, 6000], "sizes of the logs"),
        ("--moods", float, [0.0, 1.5], "strengths of the hidden mood, 0 for none"),
        ("--logs", int, [0, 1, 2], "seeds of the logs"),
        ("--seeds", int, [0, 1, 2], "training seeds"),
    ):
        said = f"{what} (default: {' '.join(f'{value:g}' for value in default)})"
        parser.add_argument(name, type=kind, nargs="+", default=default, help=said)
    parser.add_argument(
        "--arms", nargs="+", default=[], help=f"of {', '.join(ARMS)} (default: all)"
    )
    parser.add_argument("--steps", type=int, default=1000, help="of a training (default: 1000)")
    parser.add_argument("--episodes", type=int, default=2000, help="evaluated (default: 2000)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: 2)")
    options = parser.parse_args()
    cells = [
        Cell(options.out, mood, sessions, log, seed, arm, options.steps, options.episodes)
        for mood, sessions, log, seed, arm in itertools.product(
            options.moods,
            options.sessions,
            options.logs,
            options.seeds,
            chosen(ARMS, options.arms, "arm"),
        )
    ]
    for cell in {cell.folder: cell for cell in cells}.values():
        simulated_store(cell.environment, cell.folder, cell.sessions, cell.log_seed)
    results = options.results or options.out / "results.jsonl"
    measurement = Measurement(key, config, measure)
    said = announcement(options.workers)
    print(difference_table(run_grid(cells, measurement, results, options.workers, "copies", said)))


if __name__ == "__main__":
    main()
