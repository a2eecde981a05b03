"""`ucfrec-control evaluate`: returns of trained policies, and scores where they are known."""

import sys
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from ucfrec.commands.options import ARGUMENT, POSITIVE, SEED, Table
from ucfrec.errors import InputError, InputNote
from ucfrec.reporting.tables import format_rows
from ucfrec.results.rows import ResultRow, write_results
from ucfrec_control.commands.options import finite_number
from ucfrec_control.training.evaluate import CHECKPOINTS, evaluate_run, takes_target
from ucfrec_control.training.rl_baselines import read_run
from ucfrec_control.training.video import record_episode

SHOWN = (
    *("dataset", "method", "seed", "checkpoint", "target_return", "score", "return", "episodes"),
    "validation_loss",
)


class Evaluate(Table):
    """`ucfrec-control evaluate`."""

    runs: Annotated[Sequence[Path], ARGUMENT, "RUN"]
    """Run folders."""
    env: str | None = None
    """Environment to evaluate in (default: that of the data)"""
    episodes: Annotated[int, POSITIVE] = 20
    """Episodes of each policy and target."""
    seed: Annotated[int, SEED] = 0
    """Of the episodes: environments have this seed and up to 49 more, so others begin 50 later"""
    target: Annotated[Sequence[float], finite_number] = ()
    """Target return; repeatable (default: the preset's, else the largest of the training)"""
    checkpoint: Literal["both", "best", "last", "return"] = "both"
    """Weights to evaluate."""
    distractor: Annotated[float, finite_number] = 0.0
    """Value that distractors are fixed to."""
    reference: Annotated[tuple[float, float] | None, "LOW HIGH"] = None
    """Returns that score 0 and 100 (default: D4RL's for its tasks, none for others)"""
    video: Annotated[Path | None, "MP4"] = None
    """Record an episode: FILE.mp4, or folder for frames."""
    json: Path | None = None
    """Write the result rows here."""

    def execute(self) -> None:
        """Run `ucfrec-control evaluate`. InputError if a run or its environment cannot be used, or
        no run takes the --target."""
        if self.target:
            _explain_targets(self.runs)
        if self.video is not None:
            self._record(self.video)
        rows: list[ResultRow] = []
        for run in self.runs:
            checkpoints = CHECKPOINTS if self.checkpoint == "both" else (self.checkpoint,)
            how: dict[str, Any] = {"episodes": self.episodes, "checkpoints": checkpoints}
            how["reference"] = self.reference
            rows += evaluate_run(run, targets=self.target, **how, **self._options())
        print(format_rows([_shown(row) for row in rows], SHOWN))
        mismatches: Iterable[Any] = (row.details.get("warnings", ()) for row in rows)
        for warning in dict.fromkeys(text for texts in mismatches for text in texts):
            print(f"warning: {warning}", file=sys.stderr)
        if self.json is not None:
            write_results(self.json, rows)

    def _options(self) -> dict[str, Any]:
        return {"seed": self.seed, "env_id": self.env, "distractor": self.distractor}

    def _record(self, video: Path) -> None:
        if len(self.runs) != 1:
            raise InputError(f"--video records one run; {len(self.runs)} were given")
        checkpoint = "last" if self.checkpoint == "both" else self.checkpoint
        how: dict[str, Any] = {"checkpoint": checkpoint, "target": next(iter(self.target), None)}
        episode_return = record_episode(self.runs[0], video, **how, **self._options())
        print(f"{video}: an episode of return {episode_return:.1f}\n")


def _explain_targets(runs: Sequence[Path]) -> None:
    """Note which runs --target does nothing for; refuse it if it does nothing for all."""
    records = {run: read_run(run) for run in runs}
    without = {run: record for run, record in records.items() if not takes_target(record)}
    if not without:
        return
    names = ", ".join(f"{run} ({record.config.policy_name})" for run, record in without.items())
    if len(without) == len(records):
        raise InputError(f"no target return is taken by {names}; leave --target out")
    warnings.warn(f"--target does nothing for {names}", InputNote, stacklevel=2)


def _shown(row: ResultRow) -> dict[str, Any]:
    """A row with its score or return, interval and target as text, and what was added to its
    data."""
    interval = "" if row.interval is None else " [{:.1f}, {:.1f}]".format(*row.interval)
    return {
        **dict.fromkeys(SHOWN),
        **row.as_line(),
        "dataset": row.task + " + distractor" * len(row.details.get("distractors", ())),
        "seed": row.training_seed,
        "target_return": "none" if row.target_return is None else f"{row.target_return:g}",
        "return": f"{row.metrics['return']:.1f}",
        row.metric: f"{row.value:.1f}{interval}",
    }
