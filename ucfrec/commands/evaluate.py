"""`ucfrec evaluate`: measure the return of policies in a simulated environment."""

import argparse
from dataclasses import replace
from pathlib import Path

from ucfrec.commands.options import environment_given, environment_options, rule_given, rule_options
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec evaluate`."""
    parser.add_argument(
        "runs", nargs="*", type=Path, metavar="RUN", help="run folders of `ucfrec train`"
    )
    environment_options(parser)
    parser.add_argument(
        "--episodes", type=int, default=1000, help="episodes of each policy (default: 1000)"
    )
    parser.add_argument(
        "--behavior",
        action="append",
        default=[],
        help="also evaluate this built-in policy of the simulator, e.g. random; repeatable "
        "(default: none)",
    )
    rule_options(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows as JSON")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec evaluate` and print one row per policy.

    Raises:
        InputError: neither a run nor a built-in policy is named, or one of them cannot be used.
    """
    from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
    from ucfrec.provenance import shorten_paths
    from ucfrec.reporting.model_card import add_evaluation
    from ucfrec.reporting.tables import evaluation_table
    from ucfrec.results.rows_file import write_results
    from ucfrec.runs.trained_policy import TrainedPolicy

    environment = environment_given(options)
    if not options.runs and not options.behavior:
        raise InputError("name a run folder, or a built-in policy with --behavior")
    rows = []
    for run in options.runs:
        trained = TrainedPolicy.load(run, options.checkpoint)
        rule = rule_given(options, trained)
        row = evaluate_policy(
            environment, trained, trained.name, options.episodes, options.seed, rule
        )
        conditions = {**row.conditions, "run": shorten_paths(str(run))}
        rows.append(replace(row, conditions=conditions, checkpoint=options.checkpoint))
        add_evaluation(run, rows[-1])
    rows += [
        evaluate_behavior(environment, behavior, options.episodes, options.seed)
        for behavior in options.behavior
    ]
    print(evaluation_table(rows))
    print(
        "\nR_cum: mean return of a session, the sum of its rewards, with a 95% interval; where two "
        "overlap, the order is open.\nR_avg: reward per step, over all steps (pooled) or in the "
        "mean of sessions (episode)."
    )
    if options.json is not None:
        write_results(options.json, rows)
        runs = " ".join(map(str, options.runs)) or "RUN"
        print(f"next: ucfrec report {runs} --results {options.json} --out report.html")
