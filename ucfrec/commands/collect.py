"""`ucfrec collect`: simulate sessions and write them as Parquet logs."""

import argparse
from pathlib import Path

from ucfrec.commands.options import world_options
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec collect`."""
    world_options(parser)
    parser.add_argument(
        "--behavior",
        default="mixture",
        help="built-in policy that acts in the sessions (default: mixture)",
    )
    parser.add_argument(
        "--sessions", type=int, default=20_000, help="number of sessions (default: 20000)"
    )
    parser.add_argument("--out", type=Path, required=True, help="new folder for the logs")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec collect`.

    Raises:
        InputError: the simulator has no such logging policy, or --out exists.
    """
    from ucfrec.evaluation.collect import collect
    from ucfrec.evaluation.world import World

    world = World(options.env, options.env_folder)
    simulator = world.simulator()
    if options.behavior not in simulator.behaviors:
        known = ", ".join(simulator.behaviors)
        raise InputError(f"{world.name} has no behavior {options.behavior!r}; it has {known}")
    env = simulator.make(256, world.folder)
    actor = simulator.behaviors[options.behavior](env, options.seed)
    played = collect(
        simulator,
        env,
        actor,
        options.sessions,
        options.seed,
        options.out,
        env_name=options.env,
        behavior=options.behavior,
    )
    print(
        f"{options.out}: {options.sessions} sessions, {int(played.lengths.sum())} steps, mean "
        f"return {played.returns.mean():.3f}; reward column {simulator.feedback}"
    )
