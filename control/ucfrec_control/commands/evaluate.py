"""`ucfrec-control evaluate`: normalised scores of trained policies."""

import argparse
import sys
from pathlib import Path
from typing import Any

from ucfrec.commands.grid_options import seed_given
from ucfrec.errors import InputError
from ucfrec.files.atomic import write_json
from ucfrec.provenance import provenance
from ucfrec.reporting.tables import format_rows
from ucfrec_control.commands.options import shown_score, target_given
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.training.evaluate import CHECKPOINTS, SHOWN, evaluate_run
from ucfrec_control.training.video import record_episode


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `evaluate`."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--env", help="environment to play (that of the data)")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=seed_given, default=0)
    parser.add_argument(
        "--target",
        type=target_given,
        action="append",
        default=[],
        help="target return, or max for the largest that the policy expects in each state; "
        "repeatable (the preset's)",
    )
    parser.add_argument("--checkpoint", choices=["both", "best", "last"], default="both")
    parser.add_argument(
        "--distractor", type=float, default=0.0, help="value that distractors are fixed to (0)"
    )
    parser.add_argument(
        "--video",
        type=Path,
        metavar="MP4",
        help="record an episode: FILE.mp4, or folder for frames",
    )
    parser.add_argument("--json", type=Path, help="write the result rows here")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control evaluate`."""
    if options.video is not None:
        _record(options)
    rows: list[dict[str, Any]] = []
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
    print(format_rows([shown_score(row) for row in rows], SHOWN))
    for warning in dict.fromkeys(text for row in rows for text in row["warnings"]):
        print(f"warning: {warning}", file=sys.stderr)
    if options.json is not None:
        write_json(options.json, [row | provenance(PACKAGES) for row in rows])


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
