"""`ucfrec rank`: how policies rank what users were shown and clicked later."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import (
    keep_seen_option,
    log_options,
    logs_given,
    rule_given,
    rule_options,
    runs_given,
)
from ucfrec.errors import InputError

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.evaluation.liked import LikedExpression
    from ucfrec.off_policy.score import LoggedSessions
    from ucfrec.results.row import ResultRow
    from ucfrec.runs.trained_policy import TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec rank`."""
    log_options(parser)
    parser.add_argument(
        "--k", type=int, default=10, help="items recommended at each step (default: 10)"
    )
    keep_seen_option(parser)
    rule_options(parser)
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the bootstrap over users and of the random baseline (default: 0)",
    )
    parser.add_argument(
        "--liked",
        metavar="SQL",
        help="what counts as liked, a truth value over the column reward, e.g. 'reward >= 4' "
        "(default: at least 60%% of the way from the lowest training reward to the highest, or to "
        "two standard deviations above the mean, if that is less)",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the rows, with intervals, as JSON"
    )
    parser.usage = "%(prog)s RUN... [LOGS...] [options]"
    parser.epilog = (
        "Without LOGS, the policies rank the test split of the store of the first run. Matrix "
        "factorisation, a baseline, needs ucfrec[rank]."
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec rank` and print one row per policy.

    Raises:
        InputError: a run or log cannot be used, the runs have different stores, or there is no
            test split to rank that none of the runs was trained on.
    """
    from ucfrec.evaluation.ranking import MEASURES
    from ucfrec.evaluation.ranking_table import require_one_catalogue
    from ucfrec.logs.summary import format_summary
    from ucfrec.off_policy.score import (
        held_out_sessions,
        logged_sessions,
        seen_too_often,
        share_seen,
    )
    from ucfrec.provenance import shorten_paths
    from ucfrec.reporting.model_card import add_ranking
    from ucfrec.reporting.tables import format_rows
    from ucfrec.results.rows_file import write_results
    from ucfrec.results.table import Ranking
    from ucfrec.runs.trained_policy import TrainedPolicy

    runs = runs_given(options)
    if options.k < 1:
        raise InputError(f"--k is {options.k}; recommend at least 1 item")
    trained = [TrainedPolicy.load(run, options.checkpoint, split=not options.logs) for run in runs]
    require_one_catalogue(trained)
    train, liked = trained[0].training_store(), _liked(options, trained[0])
    if options.logs:
        files, mapping = logs_given(options, trained[0])
        with logged_sessions(trained[0], files, mapping) as logged:
            print(format_summary(logged.report), end="\n\n")
            warnings = [seen_too_often(share_seen(policy, logged.store)) for policy in trained]
            warnings[0] += [logged.history_lacking] if logged.history_lacking else []
            rows = _rows(options, trained, train, logged, liked)
    else:
        warnings = [[] for _ in trained]
        rows = _rows(options, trained, train, held_out_sessions(trained), liked)
    lines = [{**dict.fromkeys(Ranking.shown), "policy": row.method, **row.metrics} for row in rows]
    print(format_rows(lines, ("policy", *Ranking.shown)))
    described = [name for name in Ranking.shown if name in MEASURES]
    print("\n" + "\n".join(f"{name:<16}{MEASURES[name]}" for name in described))
    about = rows[0].conditions
    print(f"{'liked':<16}{about['liked']}: {about['liked_share']:.1%} of the steps")
    print(f"k is {about['k']}; --json has 95% intervals and paired differences by user")
    if lost := float(about["out_of_reach"] or 0):
        print(
            f"{lost:.1%} of the steps show an item that the user has seen, which is excluded: "
            f"hit_rate_shown is at most {1 - lost:.3g}; --keep-seen ranks these items too"
        )
    on = ", ".join(map(shorten_paths, options.logs)) or "the test split"
    for policy, row, said in zip(trained, rows, warnings, strict=False):
        for warning in said:
            print(f"warning: {policy.folder}: {warning}")
        add_ranking(policy.folder, row, on, said)
    if options.json is not None:
        write_results(options.json, rows)
    print(_conclusion(rows, trained))


def _conclusion(rows: "list[ResultRow]", trained: "list[TrainedPolicy]") -> str:
    """What the rows show, in two lines: the best by liked items, and what to do next."""
    found = [row.metrics.get("hit_rate_liked") for row in rows]
    rated = {n: value for n, value in enumerate(found) if value is not None and value == value}
    if 0 not in rated:
        return "\nno step was liked; next: name what counts as liked with --liked"
    best = max(rated, key=lambda n: rated[n])
    if not rated[best]:
        return "\nno method lists an item that was liked; next: a larger --k, or --keep-seen"
    own = f"; {trained[0].name} has {rated[0]:.3f}" if best else ""
    return (
        f"\n{rows[best].method} has the highest hit rate on liked items ({rated[best]:.3f} with "
        f"{rows[best].conditions['k']} items){own}. Logged clicks favour what was shown:\n"
        f"next: ucfrec ope {trained[0].folder}, the return per session that it would bring"
    )


def _liked(options: argparse.Namespace, trained: "TrainedPolicy") -> "LikedExpression | None":
    """What `--liked` says; None without it."""
    if options.liked is None:
        return None
    from ucfrec.evaluation.liked import LikedExpression
    from ucfrec.logs.expressions import Expression

    return LikedExpression(Expression(options.liked, "--liked"), trained.record.reward)


def _rows(
    options: argparse.Namespace,
    trained: "list[TrainedPolicy]",
    train: "EpisodeStore | None",
    later: "LoggedSessions",
    liked: "LikedExpression | None",
) -> "list[ResultRow]":
    from ucfrec.evaluation.ranking import Later
    from ucfrec.evaluation.ranking_baselines import PolicyRanker
    from ucfrec.evaluation.ranking_table import ranking_rows

    policies = [PolicyRanker(policy, rule_given(options, policy)) for policy in trained]
    steps = Later(later.store, later.rows, not options.keep_seen)
    about = steps, later.users, options.k, options.seed
    rows = ranking_rows(policies, trained[0], train, *about, liked)
    return [replace(row, checkpoint=options.checkpoint) for row in rows]
