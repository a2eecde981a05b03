"""`ucfrec evaluate`: measure the return of policies in a simulated environment."""

import argparse
from pathlib import Path

from ucfrec.commands.options import (
    environment_given,
    environment_options,
    option,
    rule_given,
    rule_options,
)
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec evaluate`."""
    option(parser, "runs", Path, "run folders of `ucfrec train`", "RUN", nargs="*")
    environment_options(parser)
    option(parser, "--episodes", 1000, "episodes of each policy")
    option(
        parser,
        "--behavior",
        str,
        "also evaluate this built-in policy of the simulator, e.g. random; repeatable "
        "(default: none)",
        action="append",
        default=[],
    )
    rule_options(parser)
    option(parser, "--json", Path, "also write the rows as JSON", "FILE")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec evaluate` and print one row per policy.

    Raises:
        InputError: neither a run nor a built-in policy is named, or one of them cannot be used.
    """
    from ucfrec.reporting.measuring import evaluate_in
    from ucfrec.reporting.tables import evaluation_table
    from ucfrec.runs.trained_policy import TrainedPolicy

    environment = environment_given(options)
    if not options.runs and not options.behavior:
        raise InputError("name a run folder, or a built-in policy with --behavior")
    policies = {run: TrainedPolicy.load(run, options.checkpoint) for run in options.runs}
    evaluation = evaluate_in(
        environment,
        {run: (policy, rule_given(options, policy)) for run, policy in policies.items()},
        options.behavior,
        episodes=options.episodes,
        seed=options.seed,
        checkpoint=options.checkpoint,
    )
    print(evaluation_table(list(evaluation)))
    print(
        "\nR_cum: mean return of a session, the sum of its rewards, with a 95% interval; where two "
        "overlap, the order is open.\nR_avg: reward per step, over all steps (pooled) or in the "
        "mean of sessions (episode)."
    )
    if options.json is not None:
        evaluation.save(options.json)
        runs = " ".join(map(str, options.runs)) or "RUN"
        print(f"next: ucfrec report {runs} --results {options.json} --out report.html")
