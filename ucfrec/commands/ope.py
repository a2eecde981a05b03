"""`ucfrec ope`: the return of a policy, estimated from logs alone."""

import argparse
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ucfrec.commands.options import (
    filter_seen_option,
    log_options,
    logs_given,
    memory_option,
    rule_given,
    rule_options,
    runs_given,
)
from ucfrec.errors import InputError

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.off_policy.evaluate import EstimateOptions, OffPolicyReport
    from ucfrec.off_policy.score import LoggedSessions
    from ucfrec.off_policy.verdict import Verdict
    from ucfrec.results.row import ResultRow
    from ucfrec.runs.trained_policy import TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec ope`."""
    log_options(parser)
    memory_option(parser)
    rule_options(parser)
    filter_seen_option(parser)
    parser.add_argument(
        "--targets",
        metavar="RETURN,…",
        help="compare these target returns, or quantiles of the training returns: 5,10 or q0.5,q1",
    )
    parser.add_argument(
        "--temperatures",
        metavar="T,…",
        help="compare drawing items at these temperatures; 0 takes the best: 0,0.5,1",
    )
    parser.add_argument(
        "--scored",
        action="store_true",
        help="LOGS are what `ucfrec score` wrote for RUN with the same decision rule, of any size: "
        "one row per session is in memory, and there are no reward models (DM, FQE, DR)",
    )
    parser.usage = "%(prog)s RUN... [LOGS...] [options]"
    parser.epilog = (
        "Without LOGS, the estimate is from the test split of the run's store. Several runs, "
        "targets or rules are ranked, with a band that holds all at once."
    )
    _estimate_options(parser)
    parser.add_argument("--seed", type=int, default=0, help="of folds and bootstrap (default: 0)")
    parser.add_argument("--json", type=Path, help="write the result rows here")


def _estimate_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--discount", type=float, default=1.0, help="of the returns that are estimated (default: 1)"
    )
    parser.add_argument(
        "--pages",
        action="store_true",
        help="estimate the return of a page: rows of one user within 10 ms are its positions, each "
        "row a session",
    )
    parser.add_argument(
        "--anonymous",
        action="store_true",
        help="treat each session as one of another user, for logs without user ids (as in obd)",
    )
    parser.add_argument(
        "--reward-range",
        type=float,
        nargs=2,
        metavar=("LEAST", "MOST"),
        help="lowest and highest reward of a step, to bound the value of choices that the log "
        "lacks (default: as observed)",
    )
    parser.add_argument(
        "--lift",
        type=float,
        metavar="RETURN",
        help="return per session that a launch should gain; the verdict says how many "
        "sessions would show it (default: 5%% of the mean logged return)",
    )
    parser.add_argument(
        "--item-groups",
        type=int,
        default=0,
        metavar="N",
        help="number of item groups (k-means of embeddings), for MIPS and the tests by group; 1 "
        "for neither (default: square root of the number of items, up to 32)",
    )
    parser.add_argument(
        "--estimate-propensities",
        action="store_true",
        help="estimate the propensities that the logs lack; the verdict says so",
    )


def _estimates_given(options: argparse.Namespace) -> "EstimateOptions":
    from ucfrec.off_policy.evaluate import EstimateOptions

    return EstimateOptions(
        discount=options.discount,
        pages=options.pages,
        users_known=not options.anonymous,
        reward_range=None if options.reward_range is None else tuple(options.reward_range),
        wanted_lift=options.lift,
        item_groups=options.item_groups,
        estimate_propensities=options.estimate_propensities,
        filter_seen=options.filter_seen,
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec ope`: print the estimates and the verdict of every candidate.

    Raises:
        InputError: no run or no log is named, or one of them cannot be used.
    """
    from ucfrec.off_policy.selection import choose, names_of
    from ucfrec.reporting.tables import text_table
    from ucfrec.runs.trained_policy import TrainedPolicy

    runs = dict.fromkeys(runs_given(options))
    if options.scored and not options.logs:
        raise InputError("--scored needs what ucfrec score wrote; name it after the run")
    if options.scored and options.filter_seen:
        raise InputError("--scored takes probabilities as they are; give --filter-seen to score")
    given = _estimates_given(options)
    # On the test split, the weights that have not learned from it.
    split = not options.logs
    policies = [TrainedPolicy.load(run, options.checkpoint, split=split) for run in runs]
    candidates = [
        _Candidate(trained, rule) for trained in policies for rule in _rules(options, trained)
    ]
    reports = {}
    names = names_of([one.parts for one in candidates])
    for name, candidate in zip(names, candidates, strict=True):
        if len(candidates) > 1:
            print(f"\n{name}:")
        reports[name] = _evaluated(options, candidate, given)
    if len(candidates) == 1:
        _write(options, reports, {})
        return
    choice = choose(reports, options.seed)
    if choice.selection is not None:
        print("\nvalue per session, with a 95% band that holds all of them at once:")
        head = ("candidate", "value [band]", "P(best)", "rank")
        body = [
            (one.name, f"{one.value:.4g} [{one.low:.4g}, {one.high:.4g}]",
             f"{one.probability_best:.2f}", str(one.rank))
            for one in choice.selection.standings
        ]  # fmt: skip
        print(text_table(head, body))
    for name, reasons in choice.excluded.items():
        print(f"not ranked: {name}: {reasons}")
    print(f"choice: {choice.headline}")
    _write(options, reports, {name: choice.columns(name) for name in reports})


@dataclass(frozen=True)
class _Candidate:
    """One run under one decision rule."""

    trained: "TrainedPolicy"
    rule: "DecisionRule"

    @property
    def parts(self) -> dict[str, object]:
        """What may differ from other candidates, by name."""
        return {
            "run": str(self.trained.folder),
            "target return": self.rule.target,
            "temperature": self.rule.temperature,
        }


def _evaluated(
    options: argparse.Namespace, candidate: _Candidate, given: "EstimateOptions"
) -> "OffPolicyReport":
    """Print and return what the logs say of one candidate."""
    from ucfrec.off_policy.evaluate import evaluate_off_policy
    from ucfrec.off_policy.scored import evaluate_scored
    from ucfrec.reporting.model_card import add_estimates

    trained = candidate.trained
    arguments = {"rule": candidate.rule, "seed": options.seed, "options": given}
    if options.scored:
        found = evaluate_scored(trained, options.logs, **arguments)
    else:
        with _logged(options, trained) as logged:
            found = evaluate_off_policy(trained, logged, **arguments)
    print(f"\n{_table(found.rows, ('R_cum', 'effective_sessions', 'sessions'))}")
    if found.per_step is not None:
        columns = ("R_step", "effective_steps", "steps")
        table = _table(found.step_rows, columns, steps=found.per_step.steps)
        print(f"\n{table}\n{found.per_step}\n")
    print("R_cum: return per session, with a 95% interval where an estimator has one")
    if found.models is not None:
        print(f"models: {found.models}")
    for warning in found.warnings:
        print(f"warning: {warning}")
    print(f"verdict: {found.verdict.headline}")
    print(_next_step(found.verdict))
    add_estimates(trained.folder, options.logs or ["the test split"], found)
    return found


def _table(rows: "Sequence[ResultRow]", columns: tuple[str, ...], **more: object) -> str:
    """The rows of estimators, with the columns and what is the same in all of them."""
    from ucfrec.reporting.tables import format_rows

    shown = ("estimator", "policy", "choice", *columns)
    lines = [
        {**dict.fromkeys(shown), **row.as_line(), "estimator": row.method, **more} for row in rows
    ]
    return format_rows(lines, shown)


def _next_step(verdict: "Verdict") -> str:
    """What to do about a verdict, in a line."""
    if not verdict.reliable or verdict.lift_low is None or verdict.lift_high is None:
        return "next: do not launch on this; remedy the warnings, or log more sessions at random"
    if verdict.lift_low > 0:
        return "next: test the policy on a share of the users, then compare with this estimate"
    if verdict.lift_high < 0:
        return "next: do not launch this policy; compare other ones, or other --targets"
    return "next: log more sessions, or compare other policies, --targets or --temperatures"


@contextmanager
def _logged(options: argparse.Namespace, trained: "TrainedPolicy") -> "Iterator[LoggedSessions]":
    """What the policy is evaluated on: the logs, or else the test split of its store."""
    from ucfrec.logs.summary import format_summary
    from ucfrec.off_policy.score import held_out_sessions, logged_sessions

    if not options.logs:
        logged = held_out_sessions([trained])
        store = logged.store
        print(f"test split of {store.path}: {store.n_episodes:,} sessions, {store.n_steps:,} steps")
        yield logged
        return
    files, mapping = logs_given(options, trained)
    limit = options.memory_limit
    with logged_sessions(trained, files, mapping, True, limit) as logged:
        print(format_summary(logged.report))
        yield logged


def _rules(options: argparse.Namespace, trained: "TrainedPolicy") -> "list[DecisionRule]":
    """The decision rules to evaluate: the run's own with the parts that the options name.

    Raises:
        InputError: one of `--targets` is neither a number nor a quantile, or a temperature is no
            number.
    """
    own = rule_given(options, trained)
    targets: list[float | None] = [own.target]
    if options.targets is not None:
        targets = [_target(part.strip(), trained) for part in options.targets.split(",")]
    temperatures = [own.temperature]
    if options.temperatures is not None:
        try:
            temperatures = [float(part) for part in options.temperatures.split(",")]
        except ValueError:
            raise InputError(
                f"--temperatures {options.temperatures} are not numbers; write e.g. 0,0.5,1"
            ) from None
    rules = [
        replace(own, target=target, temperature=temperature)
        for target in targets
        for temperature in temperatures
    ]
    return list({rule.hash: rule for rule in rules}.values())


def _target(part: str, trained: "TrainedPolicy") -> float:
    """A target return: a number in units of the reward, or `q` and a quantile."""
    quantile = part.startswith("q")
    try:
        value = float(part.removeprefix("q"))
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (quantile and not 0 <= value <= 1):
        raise InputError(
            f"--targets: {part!r} is neither a return nor a quantile of the training returns; "
            "write e.g. 5,10 or q0.5,q0.9"
        )
    return trained.target_return(value) if quantile else value


def _write(
    options: argparse.Namespace,
    reports: "dict[str, OffPolicyReport]",
    more: "dict[str, dict[str, Any]]",
) -> None:
    """Write the rows of all candidates, if asked to."""
    if options.json is None:
        return
    from ucfrec.results.rows_file import write_results

    rows = [
        row.extended({"candidate": name, **more.get(name, {})}, checkpoint=options.checkpoint)
        for name, report in reports.items()
        for row in (*report.rows, *report.step_rows)
    ]
    write_results(options.json, rows)
