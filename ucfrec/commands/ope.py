"""`ucfrec ope`: the return of a policy, estimated from logs alone; `score`: what it needs of the
policy; `rank`: how policies rank what users were shown and clicked later."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ucfrec.commands.options import OUTPUT, POSITIVE, Group, settings_given
from ucfrec.commands.shared_options import (
    LogOptions,
    RuleOptions,
    RunArgument,
    find_runs,
    read_number,
    read_target,
)
from ucfrec.files.remote import origin

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.off_policy.evaluate import OffPolicyReport
    from ucfrec.off_policy.selection import Selection
    from ucfrec.results.rows import Ranking, ResultRow
    from ucfrec.runs.trained_policy import TrainedPolicy


_ESTIMATED = Group("what is estimated")


class Ope(RuleOptions, LogOptions):
    """`ucfrec ope`."""

    described_by = "ucfrec.off_policy.evaluate:EstimateOptions"
    usage = "%(prog)s RUN... [LOGS...] [options]"
    epilog = "Without LOGS, from the test split. Several runs, targets or rules are ranked."

    targets: Annotated[str | None, "RETURN,…"] = None
    """Compare these target returns, or quantiles of the training returns; 5,10 or q0.5,q1"""
    temperatures: Annotated[str | None, "T,…"] = None
    """Compare drawing items at these temperatures; 0 takes the best: 0,0.5,1"""
    seed: int = 0
    """Of the folds and the bootstrap."""
    json: Path | None = None
    """Write the result rows here."""
    details: bool = False
    """Also print all estimates, and what was read."""
    discount: Annotated[float | None, _ESTIMATED, "DISCOUNT"] = None
    lift: Annotated[float | None, _ESTIMATED, "LIFT"] = None
    """Return per session that a launch should gain; unset, 5% of the mean logged return"""
    guardrail: Annotated[Sequence[str], _ESTIMATED, "MEASURE"] = ()
    """Least or largest change of a measure in percent, e.g. 'dwell_seconds >= -2%', an expression
    over the columns of LOGS; repeatable; a launch needs every one"""
    by: Annotated[str | None, _ESTIMATED, "COLUMN"] = None
    estimate_propensities: Annotated[bool, _ESTIMATED] = False
    anonymous: Annotated[bool, _ESTIMATED] = False
    """Treat each session as one of another user, for logs without user ids (as in obd)"""

    def execute(self) -> None:
        """Print the estimates and the verdict of every candidate."""
        from ucfrec.logs.summary import format_summary
        from ucfrec.off_policy import evaluate
        from ucfrec.off_policy.answer import MOST_LINES
        from ucfrec.off_policy.selection import choose, names_of
        from ucfrec.reporting.measuring import TEST_SPLIT, estimate_return
        from ucfrec.results.rows import write_results

        runs, logs = find_runs(self.logs)
        settings = settings_given(self, evaluate.EstimateOptions)
        settings |= {"users_known": not self.anonymous, "guardrails": tuple(self.guardrail)}
        settings["wanted_lift"] = self.lift
        options = evaluate.EstimateOptions(**settings)
        # On the test split, the weights that have not learned from it.
        policies = [self.load(run, split=not logs) for run in runs]
        candidates = [(policy, self._make_rules(policy)) for policy in policies]
        parts = [
            {"run": str(run.folder), "target return": rule.target, "temperature": rule.temperature}
            for run, rules in candidates
            for rule in rules
        ]
        names = names_of(parts)
        reports: dict[str, OffPolicyReport] = {}
        details: list[str] = []
        for policy, rules in candidates:
            with self.read_sessions([policy], logs, self.json, True, options) as logged:
                if logs:
                    details.append(format_summary(logged.report))
                else:
                    store = logged.store
                    sizes = f"{store.n_episodes:,} sessions, {store.n_steps:,} steps"
                    details.append(f"test split of {store.path}: {sizes}")
                for rule in rules:
                    name = names[len(reports)]
                    reports[name] = estimate_return(
                        (policy, rule),
                        logged,
                        logs or [TEST_SPLIT],
                        options=options,
                        seed=self.seed,
                        checkpoint=self.checkpoint,
                    )
                    details.append(_describe(name, reports[name]))
        choice = choose(reports, self.seed) if len(reports) > 1 else None
        if choice is None:
            most = None if self.details else MOST_LINES
            print("\n".join(reports[names[0]].list_lines(most)))
        else:
            print(f"choice: {choice.headline}")
            print(
                "\n".join(f"{name}: {report.verdict.headline}" for name, report in reports.items())
            )
            details.append(_describe_choice(choice))
        if self.details:
            print("\n\n".join(["", *details]))
        rows = []
        for name, report in reports.items():
            columns = {"candidate": name} | (choice.columns(name) if choice else {})
            rows += [row.extended(columns) for row in (*report.rows, *report.step_rows)]
        if self.json is not None:
            write_results(self.json, rows)

    def _make_rules(self, trained: "TrainedPolicy") -> "list[DecisionRule]":
        """The different rules to evaluate: the run's own with the parts that the options name."""
        base = self.make_rule(trained)
        targets, temperatures = [base.target], [base.temperature]
        if self.targets is not None:
            words = map(str.strip, self.targets.split(","))
            targets = [read_target("--targets", word, trained) for word in words]
        if self.temperatures is not None:
            temperatures = [
                read_number("--temperatures", part, "0,0.5,1")
                for part in self.temperatures.split(",")
            ]
        rules = [
            replace(base, target=target, temperature=temperature)
            for target in targets
            for temperature in temperatures
        ]
        return list({rule.hash: rule for rule in rules}.values())


def _describe(name: str, report: "OffPolicyReport") -> str:
    """The estimates, the reasons against some of them, and what to know of the logs."""
    lines = [f"{name}:", _table(report.rows, ("R_cum", "effective_sessions", "sessions"))]
    if report.step_rows:
        table = _table(report.step_rows, ("R_step", "effective_steps"))
        lines += ["", table, "R_step: mean reward of a step, after histories as logged", ""]
    lines.append("R_cum: return per session, with a 95% interval; – where a reason forbids it:")
    reasons: dict[str, list[str]] = {reason: [] for reason in report.verdict.reasons}
    for row in report.rows:
        for reason in row.details.get("reasons", ()):
            reasons.setdefault(reason, []).append(row.method)
    lines += [
        f"  {', '.join(methods) or 'sessions'}: {reason}" for reason, methods in reasons.items()
    ]
    return "\n".join([*lines, f"models: {report.models}"])


def _table(rows: "Sequence[ResultRow]", columns: tuple[str, ...]) -> str:
    """The rows of estimators, with the columns and what is the same in all of them; without the
    numbers that a reason speaks against."""
    from ucfrec.reporting.tables import format_rows

    columns, lines = ("estimator", "policy", "choice", *columns), []
    for row in rows:
        numbers = ("", "_low", "_high") if row.details.get("reasons") else ()
        doubtful = {f"{row.metric}{end}": None for end in numbers}
        line = {**dict.fromkeys(columns), **row.as_line(), **doubtful}
        lines.append({**line, "estimator": row.method})
    return format_rows(lines, columns)


def _describe_choice(choice: "Selection") -> str:
    """The candidates in order, and which comes first."""
    from ucfrec.reporting.tables import text_table

    rows = [
        (
            standing.name,
            f"{standing.value:.4g} [{standing.low:.4g}, {standing.high:.4g}]",
            f"{standing.probability_best:.2f}",
            str(standing.rank),
        )
        for standing in choice.standings
    ]
    lines = [f"not ranked: {name}: {reasons}" for name, reasons in choice.excluded.items()]
    if rows:
        lines.append("value per session, with a 95% band that holds all of them at once:")
        lines.append(text_table(("candidate", "value [band]", "P(best)", "rank"), rows))
    return "\n".join(lines)


class Score(RuleOptions, LogOptions, RunArgument):
    """`ucfrec score`."""

    described_by = "ucfrec.python_api.recommender:Recommender.score"

    out: Annotated[Path, OUTPUT]
    """Parquet or CSV file to write."""

    def execute(self) -> None:
        """Write the policy's probability of every logged choice."""
        from ucfrec.files.parquet import require_table_names, write_frames
        from ucfrec.logs.summary import format_report
        from ucfrec.off_policy.score import score

        require_table_names([self.out])
        trained = self.load(self.run)
        with self.read_sessions([trained], self.logs, self.out) as logged:
            print(format_report(logged.report))
            rows = write_frames(self.out, score(trained, logged, self.make_rule(trained)))
        print(f"\n{origin(self.out)}: {rows:,} rows")


class Rank(LogOptions, RuleOptions):
    """`ucfrec rank`."""

    described_by = "ucfrec.python_api.recommender:Recommender.rank"
    usage = "%(prog)s RUN... [LOGS...] [options]"
    epilog = (
        "Without LOGS, the policies rank the test split of the store of the first run. Matrix "
        "factorisation, a baseline, needs ucfrec[rank]."
    )

    k: Annotated[int, POSITIVE] = 10
    keep_seen: bool = False
    """Also recommend items that the user has seen; (default: leave them out)"""
    seed: int = 0
    liked: Annotated[str | None, "SQL"] = None
    json: Annotated[Path | None, "FILE"] = None
    """Also write the rows, with intervals, as JSON."""

    def execute(self) -> None:
        """Print one row per policy."""
        from ucfrec.evaluation.ranking_table import require_one_catalogue
        from ucfrec.logs.summary import format_summary
        from ucfrec.provenance import shorten_paths
        from ucfrec.reporting.measuring import TEST_SPLIT, rank_policies

        runs, logs = find_runs(self.logs)
        policies = [self.load(run, split=not logs) for run in runs]
        require_one_catalogue(policies)
        with self.read_sessions(policies, logs, self.json) as logged:
            if logs:
                print(format_summary(logged.report), end="\n\n")
            ranking = rank_policies(
                [(policy, self.make_rule(policy)) for policy in policies],
                logged,
                ", ".join(map(shorten_paths, logs)) or TEST_SPLIT,
                k=self.k,
                filter_seen=not self.keep_seen,
                liked=self.liked,
                seed=self.seed,
                checkpoint=self.checkpoint,
            )
        print(_describe_ranking(ranking))
        if self.json is not None:
            ranking.save(self.json)
        print(_conclude_ranking(ranking, [str(runs[0]), *map(origin, logs)]))


def _describe_ranking(ranking: "Ranking") -> str:
    """The table, what its columns are, and what makes the numbers less reliable."""
    from ucfrec.evaluation.ranking import MEASURES
    from ucfrec.reporting.tables import format_rows

    conditions = ranking.rows[0].conditions
    columns: Sequence[str] = ranking.headings
    liked = f"{conditions['liked']}: {conditions['liked_share']:.1%}"
    if conditions["liked_share"] == 1:
        columns, liked = ("hit_rate_shown", "ndcg_shown", "coverage"), "all"
    rows = [{**dict.fromkeys(columns), "policy": row.method, **row.metrics} for row in ranking]
    lines = [format_rows(rows, ("policy", *columns)), ""]
    lines += [f"{name:<16}{MEASURES[name]}" for name in columns if name in MEASURES]
    lines += [
        f"{'liked':<16}{liked} of the steps",
        f"k is {conditions['k']}; --json has 95% intervals and paired differences by user",
    ]
    if unseen := float(conditions["items_without_rows"] or 0):
        lines.append(f"{unseen:.1%} of the steps show an item without training rows")
    if new := float(conditions["users_without_rows"] or 0):
        unknown = f"{new:.1%} of the steps are of users without training rows"
        lines.append(f"{unknown}, for whom als and bpr rank by popularity")
    if lost := float(conditions["out_of_reach"] or 0):
        lines.append(
            f"{lost:.1%} of the steps show an item that the user has seen, which is excluded: "
            f"hit_rate_shown is at most {1 - lost:.3g}; --keep-seen ranks these items too"
        )
    return "\n".join([*lines, *(f"warning: {warning}" for warning in ranking.warnings)])


def _conclude_ranking(ranking: "Ranking", measured: Sequence[str]) -> str:
    """The best by liked items, and what to do next with the run and the logs `measured`."""
    rows, name = ranking.rows, "hit_rate_liked"
    if name not in rows[0].metrics:
        return "\nno step was liked; next: name what counts as liked with --liked"
    best = max(rows, key=lambda row: row.metrics.get(name, 0.0))
    if not best.metrics[name]:
        return "\nno method lists an item that was liked; next: a larger --k, or --keep-seen"
    first = "" if best is rows[0] else f"; {rows[0].method} has {rows[0].metrics[name]:.3f}"
    value = f"{best.metrics[name]:.3f} with {best.conditions['k']} items"
    where, advice = " on liked items", f"ope {shlex.join(measured)}, the return per session"
    if best.conditions["liked_share"] == 1:
        where, advice = "", f"recommend {shlex.quote(measured[0])} LOGS --out FILE, the next items"
    return (
        f"\n{best.method} has the highest hit rate{where} ({value}){first}. Logged clicks favour "
        f"what was shown.\nnext: ucfrec {advice}"
    )
