"""`ucfrec rank`: how policies rank what users were shown and clicked later."""

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import (
    keep_seen_option,
    log_options,
    logs_given,
    option,
    rule_given,
    rule_options,
    runs_given,
)
from ucfrec.errors import InputError

if TYPE_CHECKING:
    from ucfrec.results.rows import Ranking


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec rank`."""
    log_options(parser)
    option(parser, "--k", 10, "items recommended at each step")
    keep_seen_option(parser)
    rule_options(parser)
    option(parser, "--seed", 0, "seed of the bootstrap over users and of the random baseline")
    option(
        parser,
        "--liked",
        str,
        "what counts as liked, a truth value over the column reward, e.g. 'reward >= 4'; "
        "(default: at least 60%% of the way from the lowest training reward to the highest, or to "
        "two standard deviations above the mean, if that is less)",
        "SQL",
    )
    option(parser, "--json", Path, "also write the rows, with intervals, as JSON", "FILE")
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
    from ucfrec.evaluation.ranking_table import require_one_catalogue
    from ucfrec.logs.summary import format_summary
    from ucfrec.off_policy.score import held_out_sessions, read_logged_sessions
    from ucfrec.provenance import shorten_paths
    from ucfrec.reporting.measuring import TEST_SPLIT, rank_policies
    from ucfrec.runs.trained_policy import TrainedPolicy

    runs = runs_given(options)
    if options.k < 1:
        raise InputError(f"--k is {options.k}; recommend at least 1 item")
    policies = [TrainedPolicy.load(run, options.checkpoint, split=not options.logs) for run in runs]
    require_one_catalogue(policies)
    with ExitStack() as stack:
        if options.logs:
            files, mapping = logs_given(options, policies[0])
            logged = stack.enter_context(read_logged_sessions(policies[0], files, mapping))
            print(format_summary(logged.report), end="\n\n")
        else:
            logged = held_out_sessions(policies)
        ranking = rank_policies(
            [(policy, rule_given(options, policy)) for policy in policies],
            logged,
            ", ".join(map(shorten_paths, options.logs)) or TEST_SPLIT,
            k=options.k,
            filter_seen=not options.keep_seen,
            liked=options.liked,
            seed=options.seed,
            checkpoint=options.checkpoint,
        )
    print(_describe(ranking))
    if options.json is not None:
        ranking.save(options.json)
    print(_conclude(ranking, runs[0]))


def _describe(ranking: "Ranking") -> str:
    """The table, what its columns are, and what makes the numbers less reliable."""
    from ucfrec.evaluation.ranking import MEASURES
    from ucfrec.reporting.tables import format_rows

    columns = ranking.shown
    rows = [{**dict.fromkeys(columns), "policy": row.method, **row.metrics} for row in ranking]
    conditions = ranking.rows[0].conditions
    lines = [format_rows(rows, ("policy", *columns)), ""]
    lines += [f"{name:<16}{MEASURES[name]}" for name in columns if name in MEASURES]
    lines += [
        f"{'liked':<16}{conditions['liked']}: {conditions['liked_share']:.1%} of the steps",
        f"k is {conditions['k']}; --json has 95% intervals and paired differences by user",
    ]
    if lost := float(conditions["out_of_reach"] or 0):
        lines.append(
            f"{lost:.1%} of the steps show an item that the user has seen, which is excluded: "
            f"hit_rate_shown is at most {1 - lost:.3g}; --keep-seen ranks these items too"
        )
    return "\n".join([*lines, *(f"warning: {warning}" for warning in ranking.warnings)])


def _conclude(ranking: "Ranking", run: Path) -> str:
    """What the rows show, in two lines: the best by liked items, and what to do next."""
    rows, metric = ranking.rows, "hit_rate_liked"
    rates = {
        n: rate
        for n, row in enumerate(rows)
        if (rate := row.metrics.get(metric)) is not None and rate == rate
    }
    if 0 not in rates:
        return "\nno step was liked; next: name what counts as liked with --liked"
    best = max(rates, key=lambda n: rates[n])
    if not rates[best]:
        return "\nno method lists an item that was liked; next: a larger --k, or --keep-seen"
    first = f"; {rows[0].method} has {rates[0]:.3f}" if best else ""
    return (
        f"\n{rows[best].method} has the highest hit rate on liked items ({rates[best]:.3f} with "
        f"{rows[best].conditions['k']} items){first}. Logged clicks favour what was shown:\n"
        f"next: ucfrec ope {run}, the return per session that it would bring"
    )
