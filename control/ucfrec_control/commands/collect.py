"""`ucfrec-control collect`: datasets from SAC, which resumes, or from a saved agent."""

import argparse
from pathlib import Path

from ucfrec.commands.grid_options import seed_given
from ucfrec.commands.options import option
from ucfrec.errors import InputError
from ucfrec.reporting.tables import format_rows
from ucfrec_control.data.collect import SHOWN, CollectConfig, collect, collect_agent


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `collect`."""
    option(parser, "--env", str, "Gymnasium environment, e.g. Hopper-v5", required=True)
    option(parser, "--out", Path, "folder for the datasets", "FOLDER", required=True)
    option(parser, "--steps", 1_000_000, "of training")
    option(parser, "--every", 10_000, "steps between evaluations")
    option(parser, "--fraction", float, "of the expert's return, for medium (1/3)", default=1 / 3)
    option(parser, "--size", 1_000_000, "steps of medium and of expert")
    option(parser, "--seed", seed_given, "of training and episodes (default: 0)", default=0)
    text = "record this agent, saved by Stable-Baselines3, instead of training one; pickled parts"
    option(parser, "--agent", Path, f"{text} of the file are not read", "ZIP")
    text = "standard deviation of the noise on the agent's actions, in halves of their range"
    option(parser, "--noise", 0.0, text)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control collect`."""
    if options.agent is not None:
        acting = {"noise": options.noise, "size": options.size, "seed": options.seed}
        rows = [collect_agent(options.agent, options.env, options.out, **acting)]
    elif options.noise:
        raise InputError("--noise is for the actions of an --agent")
    else:
        names = ("steps", "every", "fraction", "size")
        config = CollectConfig(**{name: getattr(options, name) for name in names})
        rows = collect(options.env, options.out, options.seed, config)
    print(format_rows(rows, SHOWN))
    print(f"\nfiles: {options.out}")
