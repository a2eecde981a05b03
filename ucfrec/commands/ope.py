"""`ucfrec ope`: what a policy would have earned, from logs alone."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import log_options, logs_given, target_given, target_options

if TYPE_CHECKING:
    from ucfrec.off_policy.options import EstimateOptions


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `ope` takes."""
    parser.add_argument("run", type=Path, metavar="RUN")
    log_options(parser)
    target_options(parser)
    parser.add_argument(
        "--greedy", action="store_true", help="judge the most probable item, not the softmax"
    )
    estimate_options(parser)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the result rows here")


def estimate_options(parser: argparse.ArgumentParser) -> None:
    """Add what `estimates_asked` reads."""
    parser.add_argument(
        "--discount", type=float, default=1.0, help="of the returns that are estimated (default 1)"
    )
    parser.add_argument(
        "--pages",
        action="store_true",
        help="estimate the return of a page: rows of one user and time are its positions, each row "
        "a session",
    )
    parser.add_argument(
        "--anonymous",
        action="store_true",
        help="the logs' users are no persons (as in obd): take each session for somebody else's",
    )
    parser.add_argument(
        "--reward-range",
        type=float,
        nargs=2,
        metavar=("LEAST", "MOST"),
        help="what a step can earn, to bound what unsupported choices could (default: as observed)",
    )
    parser.add_argument(
        "--lift",
        type=float,
        metavar="RETURN",
        help="return a session that a launch should gain; the verdict says how many sessions would "
        "show it (default: 5%% of the mean logged return)",
    )
    parser.add_argument(
        "--item-groups",
        type=int,
        default=0,
        metavar="N",
        help="groups of items, by their embeddings, for MIPS and the tests by group; 1 for neither "
        "(default: the root of the number of items, up to 32)",
    )
    parser.add_argument(
        "--estimate-propensities",
        action="store_true",
        help="estimate the propensities that the logs lack; the verdict says so",
    )


def estimates_asked(options: argparse.Namespace) -> "EstimateOptions":
    """What `estimate_options` were given.

    Raises:
        InputError: a value is out of its range.
    """
    from ucfrec.off_policy.options import EstimateOptions

    return EstimateOptions(
        discount=options.discount,
        pages=options.pages,
        users_known=not options.anonymous,
        reward_range=None if options.reward_range is None else tuple(options.reward_range),
        wanted_lift=options.lift,
        item_clusters=options.item_groups,
        estimate_propensities=options.estimate_propensities,
    )


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
            options=estimates_asked(options),
        )
    rows = [row | {"checkpoint": options.checkpoint} for row in estimates.rows]
    shown = ("estimator", "policy", "choice", "R_cum", "effective_sessions", "sessions")
    print(f"\n{format_rows(rows, shown)}")
    for warning in estimates.warnings:
        print(f"warning: {warning}")
    print(f"verdict: {estimates.verdict.headline}")
    if options.json is not None:
        write_json(options.json, rows)
