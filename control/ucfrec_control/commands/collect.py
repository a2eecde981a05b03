"""`ucfrec-control collect`: datasets from SAC, which resumes, or from a saved agent."""

import argparse
from pathlib import Path

from ucfrec.commands.grid_options import seed_given
from ucfrec.errors import InputError
from ucfrec.reporting.tables import format_rows
from ucfrec_control.data.collect import SHOWN as COLLECTED
from ucfrec_control.data.collect import CollectConfig, collect, collect_agent


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
    parser.add_argument("--seed", type=seed_given, default=0)
    parser.add_argument(
        "--agent",
        type=Path,
        metavar="ZIP",
        help="record this agent, saved by Stable-Baselines3, instead of training one; pickled "
        "parts of the file are not read",
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=0.0,
        help="standard deviation of the noise on the agent's actions, in halves of their range (0)",
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control collect`."""
    if options.agent is not None:
        acting = {"noise": options.noise, "size": options.size, "seed": options.seed}
        rows = [collect_agent(options.agent, options.env, options.out, **acting)]
    elif options.noise:
        raise InputError("--noise is for the actions of an --agent")
    else:
        config = CollectConfig(
            steps=options.steps, every=options.every, fraction=options.fraction, size=options.size
        )
        rows = collect(options.env, options.out, options.seed, config)
    print(format_rows(rows, COLLECTED))
    print(f"\nfiles: {options.out}")
