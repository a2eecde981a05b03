"""`ucfrec-control collect`: datasets from a SAC learner; resumes."""

import argparse
from pathlib import Path

from ucfrec.reporting.tables import format_rows
from ucfrec_control.data.collect import SHOWN as COLLECTED
from ucfrec_control.data.collect import CollectConfig, collect


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `collect`."""
    parser.add_argument("--env", required=True, help="Gymnasium environment, e.g. Hopper-v5")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of training (1000000)")
    parser.add_argument(
        "--every", type=int, default=10_000, help="steps between evaluations (10000)"
    )
    parser.add_argument(
        "--fraction", type=float, default=1 / 3, help="of the expert's return, for medium (1/3)"
    )
    parser.add_argument(
        "--size", type=int, default=1_000_000, help="steps of medium and of expert (1000000)"
    )
    parser.add_argument("--seed", type=int, default=0)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control collect`."""
    config = CollectConfig(
        steps=options.steps, every=options.every, fraction=options.fraction, size=options.size
    )
    rows = collect(options.env, options.out, options.seed, config)
    print(format_rows(rows, COLLECTED))
    print(f"\nfiles: {options.out}")
