"""`ucfrec ope`: what a policy would have earned, from logs alone."""

import argparse
from pathlib import Path

from ucfrec.commands.options import log_options, logs_given, target_given, target_options


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `ope` takes."""
    parser.add_argument("run", type=Path, metavar="RUN")
    log_options(parser)
    target_options(parser)
    parser.add_argument(
        "--greedy", action="store_true", help="judge the most probable item, not the softmax"
    )
    parser.add_argument(
        "--discount", type=float, default=1.0, help="of the returns that are estimated (default 1)"
    )
    parser.add_argument(
        "--pages",
        action="store_true",
        help="estimate the return of a page: rows of one user and time are its positions, each row "
        "a session",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the result rows here")


def run(options: argparse.Namespace) -> None:
    """`ucfrec ope`."""
    from ucfrec.files import write_json
    from ucfrec.logs.summary import format_report
    from ucfrec.off_policy.evaluate import evaluate_off_policy
    from ucfrec.off_policy.score import logged_sessions
    from ucfrec.reporting.tables import format_rows
    from ucfrec.runs.trained_policy import TrainedPolicy

    files, mapping = logs_given(options)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    with logged_sessions(options.run, trained, files, mapping, keep_unknown=True) as logged:
        print(format_report(logged.report))
        estimates = evaluate_off_policy(
            options.run,
            trained,
            logged,
            target_return=target_given(options, trained),
            greedy=options.greedy,
            seed=options.seed,
            discount=options.discount,
            pages=options.pages,
        )
    rows = [row | {"checkpoint": options.checkpoint} for row in estimates.rows]
    shown = ("estimator", "policy", "choice", "R_cum", "effective_sessions", "sessions")
    print(f"\n{format_rows(rows, shown)}")
    for warning in estimates.warnings:
        print(f"warning: {warning}")
    print(f"verdict: {estimates.verdict.headline}")
    if options.json is not None:
        write_json(options.json, rows)
