"""`ucfrec collect`: simulate sessions and write them as Parquet logs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ucfrec.commands.options import environment_given, environment_options, option
from ucfrec.errors import InputError

if TYPE_CHECKING:
    from gymnasium import Space


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec collect`."""
    environment_options(parser)
    text = "built-in policy that acts in the sessions (default: mixture if any, else random)"
    option(parser, "--behavior", str, text)
    option(parser, "--sessions", 20_000, "number of sessions")
    option(parser, "--out", Path, "new folder for the logs", required=True)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec collect`.

    Raises:
        InputError: the simulator has no such logging policy, or --out exists.
    """
    from ucfrec.evaluation.collect import collect

    environment = environment_given(options)
    simulator = environment.simulator()
    behavior = options.behavior or simulator.logging_behavior
    if behavior not in simulator.behaviors:
        known = ", ".join(simulator.behaviors)
        raise InputError(f"{environment.name} has no behavior {behavior!r}; it has {known}")
    env = simulator.started(256, environment.folder)
    actor = simulator.behaviors[behavior](env, options.seed)
    played = collect(
        simulator,
        env,
        actor,
        options.sessions,
        options.seed,
        options.out,
        env_name=environment.title,
        behavior=behavior,
    )
    print(
        f"{options.out}: {options.sessions} sessions of {behavior}, {int(played.lengths.sum())} "
        f"steps, mean return {played.returns.mean():.3f}; reward column {simulator.feedback}; "
        f"{_describe_observation(env.single_observation_space)}"
    )


def _describe_observation(space: "Space[Any]") -> str:
    """What the logs say about a step besides its action and reward."""
    if not space.shape or not space.shape[0]:
        return "no observation: states come from the items shown and their rewards"
    return f"observation of {space.shape[0]} numbers"
