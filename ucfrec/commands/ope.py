"""`ucfrec ope`: the return of a policy, estimated from logs alone."""

import argparse
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ucfrec.commands.options import (
    log_options,
    logs_given,
    memory_option,
    option,
    rule_given,
    rule_options,
    runs_given,
    table_options,
    table_values,
)
from ucfrec.errors import InputError

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.off_policy.evaluate import OffPolicyReport
    from ucfrec.off_policy.score import LoggedSessions
    from ucfrec.off_policy.selection import Choice
    from ucfrec.off_policy.verdict import Verdict
    from ucfrec.results.rows import ResultRow
    from ucfrec.runs.trained_policy import TrainedPolicy

_TABLE: Final = "ucfrec.off_policy.evaluate:EstimateOptions"
_FIELDS: Final = {
    "discount": float,
    "pages": bool,
    "reward_range": tuple,
    "wanted_lift": float,
    "item_groups": int,
    "estimate_propensities": bool,
    "filter_seen": bool,
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec ope`."""
    memory_option(log_options(parser))
    rule_options(parser)
    option(
        parser,
        "--targets",
        str,
        "compare these target returns, or quantiles of the training returns; 5,10 or q0.5,q1",
        "RETURN,…",
    )
    text = "compare drawing items at these temperatures; 0 takes the best: 0,0.5,1"
    option(parser, "--temperatures", str, text, "T,…")
    option(
        parser,
        "--scored",
        False,
        "LOGS are what `ucfrec score` wrote for RUN; with the same decision rule, of any size: "
        "one row per session is in memory, and there are no reward models (DM, FQE, DR)",
    )
    group = parser.add_argument_group("what is estimated")
    fields = {"discount": float, "pages": bool, "reward_range": tuple}
    fields |= {
        "filter_seen": bool,
        "wanted_lift": float,
        "item_groups": int,
        "estimate_propensities": bool,
    }
    table_options(group, _TABLE, fields, wanted_lift="lift")
    text = "treat each session as one of another user, for logs without user ids (as in obd)"
    option(group, "--anonymous", False, text)
    option(parser, "--seed", 0, "of folds and bootstrap")
    option(parser, "--json", Path, "write the result rows here")
    parser.usage = "%(prog)s RUN... [LOGS...] [options]"
    parser.epilog = (
        "Without LOGS, the estimate is from the test split of the run's store. Several runs, "
        "targets or rules are ranked, with a band that holds all at once."
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec ope`: print the estimates and the verdict of every candidate.

    Raises:
        InputError: no run or no log is named, or one of them cannot be used.
    """
    from ucfrec.off_policy.evaluate import EstimateOptions
    from ucfrec.off_policy.selection import choose, names_of
    from ucfrec.reporting.measuring import TEST_SPLIT, estimate_return
    from ucfrec.results.rows import write_results
    from ucfrec.runs.trained_policy import TrainedPolicy

    runs = runs_given(options)
    estimates = EstimateOptions(
        users_known=not options.anonymous, **table_values(options, "EstimateOptions")
    )
    if options.scored and not options.logs:
        raise InputError("--scored needs what ucfrec score wrote; name it after the run")
    if options.scored and estimates.filter_seen:
        raise InputError("--scored takes probabilities as they are; give --filter-seen to score")
    # On the test split, the weights that have not learned from it.
    split = not options.logs
    policies = [TrainedPolicy.load(run, options.checkpoint, split=split) for run in runs]
    rules = [_rules(options, policy) for policy in policies]
    pairs = [(policy, rule) for policy, own in zip(policies, rules, strict=True) for rule in own]
    names = iter(names_of([_distinguish(policy, rule) for policy, rule in pairs]))
    reports: dict[str, OffPolicyReport] = {}
    for policy, own in zip(policies, rules, strict=True):
        with _read_logs(options, policy) as logged:
            for rule in own:
                name = next(names)
                if len(pairs) > 1:
                    print(f"\n{name}:")
                reports[name] = estimate_return(
                    (policy, rule),
                    logged,
                    options.logs or [TEST_SPLIT],
                    options=estimates,
                    seed=options.seed,
                    checkpoint=options.checkpoint,
                )
                print(_describe(reports[name]))
    choice = choose(reports, options.seed) if len(reports) > 1 else None
    if choice is not None:
        print(_describe_choice(choice))
    if options.json is not None:
        rows = [
            row.extended({"candidate": name, **({} if choice is None else choice.columns(name))})
            for name, report in reports.items()
            for row in (*report.rows, *report.step_rows)
        ]
        write_results(options.json, rows)


def _distinguish(trained: "TrainedPolicy", rule: "DecisionRule") -> dict[str, object]:
    """What may differ from other candidates, by name."""
    return {
        "run": str(trained.folder),
        "target return": rule.target,
        "temperature": rule.temperature,
    }


def _describe(report: "OffPolicyReport") -> str:
    """The estimates, what to know of them, the verdict and what to do next."""
    lines = ["", _table(report.rows, ("R_cum", "effective_sessions", "sessions"))]
    if report.per_step is not None:
        columns = ("R_step", "effective_steps", "steps")
        table = _table(report.step_rows, columns, steps=report.per_step.steps)
        lines += ["", table, f"{report.per_step}", ""]
    lines.append("R_cum: return per session, with a 95% interval where an estimator has one")
    if report.models is not None:
        lines.append(f"models: {report.models}")
    lines += [f"warning: {warning}" for warning in report.warnings]
    lines += [f"verdict: {report.verdict.headline}", _next_step(report.verdict)]
    return "\n".join(lines)


def _table(rows: "Sequence[ResultRow]", columns: tuple[str, ...], **more: object) -> str:
    """The rows of estimators, with the columns and what is the same in all of them."""
    from ucfrec.reporting.tables import format_rows

    columns = ("estimator", "policy", "choice", *columns)
    lines = [
        {**dict.fromkeys(columns), **row.as_line(), "estimator": row.method, **more} for row in rows
    ]
    return format_rows(lines, columns)


def _describe_choice(choice: "Choice") -> str:
    """The candidates in order, and which comes first."""
    from ucfrec.reporting.tables import text_table

    lines = []
    if choice.selection is not None:
        rows = [
            (
                standing.name,
                f"{standing.value:.4g} [{standing.low:.4g}, {standing.high:.4g}]",
                f"{standing.probability_best:.2f}",
                str(standing.rank),
            )
            for standing in choice.selection.standings
        ]
        lines.append("\nvalue per session, with a 95% band that holds all of them at once:")
        lines.append(text_table(("candidate", "value [band]", "P(best)", "rank"), rows))
    lines += [f"not ranked: {name}: {reasons}" for name, reasons in choice.excluded.items()]
    return "\n".join([*lines, f"choice: {choice.headline}"])


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
def _read_logs(
    options: argparse.Namespace, trained: "TrainedPolicy"
) -> "Iterator[LoggedSessions | Sequence[Path]]":
    """What the policy is evaluated on: the logs, or else the test split of its store."""
    from ucfrec.logs.summary import format_summary
    from ucfrec.off_policy.score import held_out_sessions, read_logged_sessions

    if options.scored:
        yield options.logs
        return
    if not options.logs:
        logged = held_out_sessions([trained])
        store = logged.store
        print(f"test split of {store.path}: {store.n_episodes:,} sessions, {store.n_steps:,} steps")
        yield logged
        return
    files, mapping = logs_given(options, trained)
    limit = options.memory_limit
    with read_logged_sessions(trained, files, mapping, True, limit) as logged:
        print(format_summary(logged.report))
        yield logged


def _rules(options: argparse.Namespace, trained: "TrainedPolicy") -> "list[DecisionRule]":
    """The decision rules to evaluate: the run's own with the parts that the options name.

    Raises:
        InputError: one of `--targets` is neither a number nor a quantile, or a temperature is no
            number.
    """
    base = rule_given(options, trained)
    targets: list[float | None] = [base.target]
    if options.targets is not None:
        targets = [_read_target(part.strip(), trained) for part in options.targets.split(",")]
    temperatures = [base.temperature]
    if options.temperatures is not None:
        try:
            temperatures = [float(part) for part in options.temperatures.split(",")]
        except ValueError:
            raise InputError(
                f"--temperatures {options.temperatures} are not numbers; write e.g. 0,0.5,1"
            ) from None
    rules = [
        replace(base, target=target, temperature=temperature)
        for target in targets
        for temperature in temperatures
    ]
    return list({rule.hash: rule for rule in rules}.values())


def _read_target(part: str, trained: "TrainedPolicy") -> float:
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
