"""`ucfrec compare`: the difference between two runs that shared the traffic."""

import argparse
from pathlib import Path

from ucfrec.commands.options import INPUT, memory_option, option
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec compare`."""
    text = "logs of `ucfrec join`, whose exposures `serve --split` wrote"
    option(parser, "logs", INPUT, text, "LOGS", nargs="+")
    option(parser, "--column", "feedback", "feedback that counts, a number of each shown item")
    text = "compare B with A (default: the two arms that there are)"
    option(parser, "--arms", str, text, "A,B")
    option(
        parser,
        "--expected",
        float,
        "difference per shown item for which the always-valid interval is shortest; fix it "
        "before the test (default: 5%% of the value of A)",
        "DIFFERENCE",
    )
    option(parser, "--json", Path, "also write the numbers as JSON", "FILE")
    memory_option(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec compare` and print both arms and their difference.

    Raises:
        InputError: a log cannot be used, or there are not two arms.
    """
    from dataclasses import asdict

    from ucfrec.files.atomic import write_json
    from ucfrec.off_policy.ab_test import compare_arms

    arms = None
    if options.arms is not None:
        first, _, second = (part.strip() for part in options.arms.partition(","))
        if not (first and second):
            raise InputError(f"--arms {options.arms}: write two names, A,B")
        arms = first, second
    if options.expected is not None and not options.expected > 0:
        raise InputError(f"--expected is {options.expected}; give a difference above 0")
    limit = options.memory_limit
    result = compare_arms(options.logs, options.column, arms, options.expected, limit)
    print(f"{result}\n\n{result.conclusion}")
    if options.json is not None:
        write_json(options.json, asdict(result))
