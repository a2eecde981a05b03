"""`ucfrec-control evaluate`: normalised scores of trained policies."""

import argparse
import sys
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ucfrec.commands.grid_options import seed_given
from ucfrec.commands.options import option
from ucfrec.errors import InputError, InputNote
from ucfrec.reporting.tables import format_rows
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import write_results
from ucfrec_control.commands.options import MAX_RETURN, target_given
from ucfrec_control.training.evaluate import CHECKPOINTS, NO_TARGET, evaluate_run, takes_target
from ucfrec_control.training.rl_baselines import read_run
from ucfrec_control.training.video import record_episode

SHOWN = (
    *("dataset", "method", "seed", "checkpoint", "target_return", "score", "return", "episodes"),
    "validation_loss",
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `evaluate`."""
    option(parser, "runs", Path, "run folders", "RUN", nargs="+")
    option(parser, "--env", str, "environment to evaluate in (that of the data)")
    option(parser, "--episodes", 20, "of each checkpoint and target")
    option(parser, "--seed", seed_given, "of environments and intervals (default: 0)", default=0)
    text = "target return, or max for the largest that the policy expects in each state"
    more: dict[str, Any] = {"action": "append", "default": []}
    option(parser, "--target", target_given, f"{text}; repeatable (the preset's)", **more)
    kinds = ["both", "best", "last"]
    option(parser, "--checkpoint", kinds, "of validation loss, or last step", default="both")
    option(parser, "--distractor", 0.0, "value that distractors are fixed to")
    option(parser, "--video", Path, "record an episode: FILE.mp4, or folder for frames", "MP4")
    option(parser, "--json", Path, "write the result rows here")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control evaluate`.

    Raises:
        InputError: a run or its environment cannot be used, or no run takes the --target.
    """
    if options.target:
        _explain_targets(options.runs)
    if options.video is not None:
        _record(options)
    rows: list[ResultRow] = []
    for run in options.runs:
        rows += evaluate_run(
            run,
            episodes=options.episodes,
            seed=options.seed,
            env_id=options.env,
            targets=options.target,
            checkpoints=CHECKPOINTS if options.checkpoint == "both" else (options.checkpoint,),
            distractor=options.distractor,
        )
    print(format_rows([_shown(row) for row in rows], SHOWN))
    mismatches: Iterable[Any] = (row.details.get("warnings", ()) for row in rows)
    for warning in dict.fromkeys(text for texts in mismatches for text in texts):
        print(f"warning: {warning}", file=sys.stderr)
    if options.json is not None:
        write_results(options.json, rows)


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
    """A row with its score, interval and target as text."""
    low, high = row.interval or (row.value, row.value)
    target = "none" if row.rule == NO_TARGET else MAX_RETURN
    if row.target_return is not None:
        target = f"{row.target_return:g}"
    return {
        **dict.fromkeys(SHOWN),
        **row.as_line(),
        "dataset": row.task,
        "seed": row.training_seed,
        "score": f"{row.value:.1f} [{low:.1f}, {high:.1f}]",
        "target_return": target,
        "return": f"{row.metrics['return']:.1f}",
    }


def _record(options: argparse.Namespace) -> None:
    if len(options.runs) != 1:
        raise InputError(f"--video records one run; {len(options.runs)} were given")
    episode_return = record_episode(
        options.runs[0],
        options.video,
        seed=options.seed,
        checkpoint="best" if options.checkpoint == "best" else "last",
        env_id=options.env,
        target=next(iter(options.target), None),
        distractor=options.distractor,
    )
    print(f"{options.video}: an episode of return {episode_return:.1f}\n")
