"""`ucfrec evaluate`: what policies earn in a simulated world."""

import argparse
from pathlib import Path

from ucfrec.commands.options import target_given, target_options, world_options
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `evaluate` takes."""
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN")
    world_options(parser)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument(
        "--behavior",
        action="append",
        default=[],
        help="a built-in policy to judge beside, e.g. random; repeatable",
    )
    target_options(parser)
    parser.add_argument("--json", type=Path, help="write the result rows here")


def run(options: argparse.Namespace) -> None:
    """`ucfrec evaluate`."""
    from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
    from ucfrec.evaluation.world import World
    from ucfrec.files import write_json
    from ucfrec.provenance import format_rows
    from ucfrec.runs.trained_policy import TrainedPolicy

    world = World(options.env, options.env_folder)
    if not options.runs and not options.behavior:
        raise InputError("name a run folder, or a built-in policy with --behavior")
    rows = []
    for run in options.runs:
        trained = TrainedPolicy.load(run, options.checkpoint)
        target = target_given(options, trained)
        row = evaluate_policy(world, trained, trained.name, options.episodes, options.seed, target)
        rows.append(row | {"run": str(run), "checkpoint": options.checkpoint})
    rows += [
        evaluate_behavior(world, behavior, options.episodes, options.seed)
        for behavior in options.behavior
    ]
    print(format_rows(rows))
    if options.json is not None:
        write_json(options.json, rows)
