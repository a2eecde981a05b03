"""Estimates from logs the return of a trained policy, and reports how reliable that is."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.answer import (
    DAY_MS,
    MOST_LINES,
    Traffic,
    Verdict,
    conclude,
    cut_to_steps,
)
from ucfrec.off_policy.estimators import LOGGED, SUITE, Estimate, estimate, session_terms
from ucfrec.off_policy.guardrails import Guardrail, check_guardrail, compare_groups
from ucfrec.off_policy.logged_steps import ItemGroups, LoggedSteps, Positions, merge_lists
from ucfrec.off_policy.models import (
    InputsFile,
    ModelReport,
    array_on_disk,
    fit_behavior,
    fit_models,
    group_items,
    make_inputs,
)
from ucfrec.off_policy.score import LoggedSessions, score_steps, seen_too_often, share_seen
from ucfrec.off_policy.verdict import (
    ENOUGH_USERS,
    MOST_LEFT_OUT,
    Diagnosis,
    check_catalogue_size,
    describe_rounding,
    diagnose,
)
from ucfrec.provenance import config_hash, provenance, shorten_paths
from ucfrec.results.rows import ResultRow, ResultTable, write_results
from ucfrec.runs.record import read_candidates
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import settings_table

if TYPE_CHECKING:
    import pandas as pd


@settings_table("")
class EstimateOptions:
    """How `evaluate_off_policy` estimates."""

    discount: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Discount factor γ of the estimated returns."""
    users_known: bool = True
    """Whether users are persons; if not, each session is taken to be of another user."""
    wanted_lift: Annotated[float, Field(gt=0)] | None = None
    """Return per session that a launch should gain; unset, 5% of the mean logged return."""
    estimate_propensities: bool = False
    """Estimate the propensities that the logs lack, cross-fitted and calibrated."""

    guardrails: tuple[str, ...] = ()
    """Least or largest changes of measures in percent, e.g. "dwell_seconds >= -2%", of expressions
    over the columns of the logs; a launch needs every one."""
    by: str | None = None
    """Column of users or items, of the logs or of feature tables, to show the lift by."""

    @property
    def measures(self) -> tuple[str, ...]:
        """The expressions of the guardrails."""
        return tuple(Guardrail.parse(text).measure for text in self.guardrails)

    def __post_init__(self) -> None:
        for text in self.guardrails:
            Guardrail.parse(text)


DEFAULTS = EstimateOptions()
ASSUMPTIONS: Mapping[Positions, str] = {
    "whole list": "the whole list",
    "cascade": "the item and those above it",
    "independent": "the item alone",
}
"""What the reward of an item in a list depends on, in words."""
_ENOUGH_FOR_WHOLE_LISTS = 1000
"""Effective users from which on intervals of whole lists, whose weights are the heaviest, cover
(`tests/off_policy/test_lists.py`)."""


@dataclass(frozen=True, repr=False)
class OffPolicyReport(ResultTable):
    """The estimates, and whether to believe them."""

    headings = ("choice", "R_cum", "R_cum_low", "R_cum_high", "effective_sessions", "sessions")

    rows: list[ResultRow]
    """One result row for each estimator."""
    warnings: list[str]
    """The verdict's reasons, cautions, and remarks on the logs."""
    verdict: Verdict
    models: ModelReport
    """How good the models of DM, FQE, DR and REG are."""
    returns: Float64Array
    """(S,) of the logged sessions with all their propensities; empty if none has."""
    user: IntArray | None
    """(S,) whose they are; None where each is of another user."""
    terms: Float64Array | None
    """(S,) whose mean is the estimate that the verdict is of; None where nothing can be weighed."""
    step_rows: Sequence[ResultRow] = ()
    """Result rows of the value per step, one for each estimator, if there is one."""

    def list_lines(self, most: int | None = MOST_LINES) -> list[str]:
        """The answer first, then what it rests on, and what to know of the logs."""
        lines = self.verdict.list_lines()
        lines += [f"note: {text}" for text in self.warnings if text not in self.verdict.reasons]
        if most is None or len(lines) <= most:
            return lines
        return [*lines[: most - 1], f"{len(lines) - most + 1} more lines: --details"]

    def save(self, file: Path | str) -> None:
        """Write all rows as JSON, as `ucfrec ope --json` does, for `report`."""
        write_results(Path(file), [*self.rows, *self.step_rows])

    def __repr__(self) -> str:
        return "\n".join(self.list_lines())

    def _repr_html_(self) -> str:
        answer, *lines = (f"<p>{escape(line)}</p>" for line in self.list_lines())
        table = self._table().to_html(index=False, float_format="{:.4g}".format, na_rep="–")
        return f"<strong>{answer}</strong>{''.join(lines)}{table}"

    def _table(self) -> "pd.DataFrame":
        """Estimates with a reason against them have none of the numbers."""
        frame = super()._table()
        doubtful = [bool(row.details.get("reasons")) for row in self.rows]
        numbers = [name for name in frame if str(name).startswith(("R_cum", "effective"))]
        frame.loc[doubtful, numbers] = np.nan
        return frame


@dataclass
class WeighedLogs:
    """Logged steps, and what the logs say of an estimate beside their weights."""

    steps: LoggedSteps
    logged: LoggedSessions
    columns: dict[str, Any]
    """Further columns of the result rows."""
    segment: IntArray
    """(S,) quarter of the logs, 1 to 4 by time, in which each session begins."""
    declared: str
    models: ModelReport
    traffic: Traffic
    nearby: str
    """See `name_nearby_rule`."""
    forbidden: list[str] = field(default_factory=list)
    """What forbids a conclusion."""
    remarks: list[str] = field(default_factory=list)
    """What to know of an estimate that may stand all the same."""


def evaluate_off_policy(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    *,
    rule: DecisionRule | None = None,
    seed: int,
    options: EstimateOptions = DEFAULTS,
) -> OffPolicyReport:
    """Estimate the mean return of a session under a policy, and a rule or its run's own, from logs
    alone, read with `keep_unknown`: a step of an unknown item has weight 0. InputError if
    propensities are not probabilities, or there is only one user."""
    if {*options.measures} != {*logged.measures} or (options.by and logged.groups is None):
        raise InputError("--guardrail and --by read further columns of logs: name the logs")
    rule, store = rule or trained.rule, logged.store
    steps, models, declared, concentration = collect_steps(trained, logged, rule, seed, options)
    assert steps.groups is not None
    columns = {
        "seen_in_training": share_seen(trained, store),
        "dropped": logged.report["dropped"],
        "unknown_item_rows": logged.unknown_items,
        **{f"model_{name}": value for name, value in asdict(models).items()},
    }
    times = store.column(schema.TIMESTAMP)[steps.first]
    quartiles = np.quantile(times, [0.25, 0.5, 0.75])
    n_items, in_catalogue = len(trained.items), steps.groups.number >= 0
    logs = WeighedLogs(
        steps,
        logged,
        columns,
        segment=1 + np.searchsorted(quartiles, times, side="right"),
        declared=declared,
        models=models,
        traffic=Traffic(
            days=float(np.ceil(np.ptp(times) / DAY_MS)),
            users=len(np.unique(steps.users)),
            steps=len(steps.reward),
            draws=concentration * n_items,
        ),
        nearby=name_nearby_rule(trained, rule),
    )
    _doubt_logs(logs)
    implied = None if declared else check_catalogue_size(steps, in_catalogue, n_items)
    if implied is not None and not implied.passed:
        logs.forbidden.append(
            f"the propensities imply {implied.mean * n_items:,.0f} ± "
            f"{implied.error * n_items:,.0f} items to choose from, the run knows {n_items:,}: "
            "propensities are too small"
        )
    return _make_report(trained, rule, logs, seed, options)


def name_nearby_rule(trained: TrainedPolicy, rule: DecisionRule) -> str:
    """The best rule that the validation sessions of a run support, as options; "" without one."""
    base, supported = rule.as_dict(), list[tuple[float, str]]()
    for candidate in read_candidates(trained.folder):
        support = candidate.evidence and candidate.evidence.effective_users
        parts = candidate.rule.as_dict().items() - base.items()
        if (support or 0.0) >= ENOUGH_USERS and all(part is not None for _, part in parts):
            words = (f"--{name.replace('_', '-')} {part:g}" for name, part in sorted(parts))
            supported.append((candidate.value or 0.0, " ".join(words)))
    options = max(supported, default=(0.0, ""))[1]
    return f"evaluate a rule that such logs support: {options}" if options else ""


def _make_report(
    trained: TrainedPolicy,
    rule: DecisionRule,
    logs: WeighedLogs,
    seed: int,
    options: EstimateOptions,
) -> OffPolicyReport:
    """Estimate from logged steps, judge the estimates, and make their result rows: `R_cum` is the
    mean return, as in `ucfrec.evaluation.evaluate`, and `R_step` the mean reward of a step."""
    steps, diagnosis, verdict = _conclude_lists(logs, seed, options)
    weighable = None if steps.lacking.all() else steps.weighable
    verdict, terms = _add_evidence(logs, steps, diagnosis, verdict, seed, options)
    of_steps: dict[str, Estimate] = {}
    if verdict.per_step is not None and (single := cut_to_steps(logs.steps)) is not None:
        of_steps = estimate(single, seed, verdict.per_step.reasons)
    estimates = estimate(steps, seed, verdict.reasons)
    if not logs.models.converged:
        diverged = "it diverged: its values exceed the largest possible return"
        estimates["FQE"] = replace(estimates["FQE"], reasons=(diverged,))
    if 0 < diagnosis.left_out < diagnosis.sessions:
        logs.remarks.append(
            f"{diagnosis.left_out:,} of {diagnosis.sessions:,} sessions have a step without "
            "propensity: estimates that weigh leave these sessions out"
        )
    if schema.EXCLUDES_SEEN not in logs.logged.store.record.columns and not rule.exclude_seen:
        logs.remarks.append(
            "seen items may be shown again; serve and recommend leave them out, unless --keep-seen"
        )
    warnings = [*verdict.reasons, *logs.remarks]
    judged = logs.columns | diagnosis.list_columns() | verdict.list_columns()
    judged["warnings"] = warnings
    record = trained.record
    base = ResultRow(
        suite=SUITE,
        table="estimates",
        task="logs",
        method=LOGGED,
        policy=trained.name,
        training_seed=record.seed,
        evaluation_seed=seed,
        conditions={
            "run": shorten_paths(str(trained.folder)),
            "discount": options.discount,
            "positions": steps.positions if logs.steps.place is not None else None,
            "anonymous": not options.users_known,
            "sessions": len(steps.first),
            "steps": len(steps.reward),
            "choice": "softmax" if rule.draws else "greedy",
        },
        config_hash=config_hash(record.settings),
        data_fingerprint=logs.logged.store.record.fingerprint,
        metric="R_cum",
        metrics={},
        target_return=rule.target,
        rule=rule.hash,
        **provenance(),
    )
    per_step = replace(base, table="per step", metric="R_step")
    return OffPolicyReport(
        rows=_make_rows(base, estimates, rule, judged),
        warnings=warnings,
        verdict=verdict,
        models=logs.models,
        returns=np.empty(0) if weighable is None else weighable.returns,
        user=None if weighable is None else weighable.user,
        terms=terms,
        step_rows=_make_rows(per_step, of_steps, rule, judged),
    )


def _conclude_lists(
    logs: WeighedLogs,
    seed: int,
    options: EstimateOptions,
) -> tuple[LoggedSteps, Diagnosis, Verdict]:
    """The steps, diagnosis and verdict under the weakest assumption on lists that the logs support,
    or else of a cascade; a remark shows the verdicts under the others.

    Independent positions never decide: given the items above it, the ratio of a position leaves out
    how those change what is left to show, so that its interval covers too seldom.
    """
    steps = logs.steps
    results = list[tuple[LoggedSteps, Diagnosis, Verdict]]()
    ways = [steps]
    if steps.place is not None:
        ways = [merge_lists(steps), steps, replace(steps, positions="independent")]
    for way in ways:
        diagnosis = diagnose(way, logs.segment)
        verdict = conclude(
            way,
            seed,
            diagnosis,
            wanted_lift=options.wanted_lift,
            forbidden=logs.forbidden,
            declared=logs.declared,
            days=logs.traffic.days,
        )
        results.append((way, diagnosis, verdict))
    enough = results[0][1].effective_users >= _ENOUGH_FOR_WHOLE_LISTS
    chosen = results[0 if len(results) == 1 or (enough and results[0][2].lift.is_reliable) else 1]
    if len(results) > 1:
        alternatives = "; ".join(
            f"{ASSUMPTIONS[way.positions]}: {verdict.lift.format()}"
            for way, _, verdict in results
            if way is not chosen[0]
        )
        logs.remarks.append(
            "decisions are lists, with propensities given the items above: rewards depend on "
            f"{ASSUMPTIONS[chosen[0].positions]}; if they depend on {alternatives}"
        )
    return chosen


def _add_evidence(
    logs: WeighedLogs,
    steps: LoggedSteps,
    diagnosis: Diagnosis,
    verdict: Verdict,
    seed: int,
    options: EstimateOptions,
) -> tuple[Verdict, Float64Array | None]:
    """The verdict with what else was asked for, and (S,) whose mean is the estimate that it is of;
    where that is not reliable, what single steps show, and what would let the logs say more."""
    rows, terms = replace(logs.steps, positions=steps.positions), None
    if verdict.estimator is not None:
        terms = session_terms(steps.weighable)[verdict.estimator].influences
        if (groups := logs.logged.groups) is not None:
            lifts = terms - steps.weighable.returns
            verdict = replace(verdict, groups=compare_groups(groups, rows, lifts, seed))
    guardrails = [
        check_guardrail(text, logs.logged.measures[measure], rows, verdict.reasons, seed)
        for text, measure in zip(options.guardrails, options.measures, strict=True)
    ]
    verdict = replace(verdict, guardrails=guardrails)
    if verdict.lift.is_reliable:
        return verdict, terms
    plans = [logs.traffic.plan_more(diagnosis) or logs.traffic.plan_exploration(), logs.nearby]
    verdict = replace(verdict, remedies=[] if logs.forbidden else [*filter(None, plans)])
    if (single := cut_to_steps(rows)) is not None:
        verdict = replace(verdict, per_step=conclude(single, seed, forbidden=logs.forbidden))
    return verdict, terms


def _make_rows(
    base: ResultRow,
    estimates: Mapping[str, Estimate],
    rule: DecisionRule,
    judged: dict[str, Any],
) -> list[ResultRow]:
    """A row like `base` for each estimate."""
    rows, units = [], "sessions" if base.metric == "R_cum" else "steps"
    for name, result in estimates.items():
        row = replace(base, method=name, interval=result.interval)
        if name == LOGGED:
            logged = {**base.conditions, "choice": "as logged"}
            row = replace(row, policy="behavior", conditions=logged)
        numbers = {
            base.metric: result.value,
            f"{base.metric}_error": result.error,
            f"effective_{units}": result.effective_sessions,
            "largest_weight": result.largest_weight,
            "reasons": result.reasons or None,
            "decision_rule": rule.as_dict(),
        }
        rows.append(row.extended({**numbers, **judged}))
    return rows


def _doubt_logs(logs: WeighedLogs) -> None:
    """Add what rows seen in training, of unknown items, and dropped rows say."""
    seen, logged = logs.columns["seen_in_training"], logs.logged
    logs.forbidden += seen_too_often(seen)
    if seen is None:
        logs.remarks.append(
            "the store of the run is gone or has changed: whether these logs were seen in training "
            "is not known, and users begin without a history; move the run together with its store"
        )
    if text := describe_rounding(logs.steps.propensity):
        logs.remarks.append(text)
    if logged.unknown_items:
        logs.remarks.append(
            f"{logged.unknown_items:,} rows show items that the run does not know, and so never "
            "would: they weigh 0"
        )
    if without_reward := logged.report["dropped"].get("reward_not_finite", 0):
        rows = logged.store.n_steps + without_reward
        much = without_reward > MOST_LEFT_OUT * rows
        (logs.forbidden if much else logs.remarks).append(
            f"{without_reward:,} of {rows:,} rows have no finite reward: they are left out"
            + ", and may differ from the rest" * much
        )


def collect_steps(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    rule: DecisionRule,
    seed: int,
    options: EstimateOptions = DEFAULTS,
) -> tuple[LoggedSteps, ModelReport, str, float]:
    """The logged steps, in order, with the policy's probabilities and models of its return; how
    good the models are; which propensities are estimated, "" if none is; and the mean of Σ π(a)².
    What the models see, and the probabilities of groups, lie on disk."""
    store = logged.store
    propensity = np.full(store.n_steps, np.nan)
    if schema.PROPENSITY in store.record.columns:
        propensity = store.column(schema.PROPENSITY).astype(np.float64)
    place = None
    if schema.PLACE in store.record.columns:
        place = store.column(schema.PLACE).astype(np.int64)
    # What the logs say without any policy is checked before the slow scoring.
    plain = LoggedSteps(
        session=store.all_steps()[0],
        reward=store.column(schema.REWARD).astype(np.float64),
        propensity=propensity,
        target=np.zeros(store.n_steps),
        place=place,
        user=logged.users if options.users_known else None,
        discount=options.discount,
    )
    if len(np.unique(plain.users)) < 2:
        raise InputError(
            f"{logged.report.get('files', [store.path])[0]}: the logs are of one user; each user "
            "is predicted by models of others: give logs of more users"
        )
    items = store.column(schema.ITEM).astype(np.int64)
    assert trained.item_states is not None
    group_of = group_items(trained.item_states.embeddings.numpy(), seed)
    one_hot = torch.from_numpy(np.eye(group_of.max() + 1, dtype=np.float32)[group_of])
    target, end, squares = np.empty(len(items)), 0, 0.0
    groups = ItemGroups(
        np.where(items >= 0, group_of[items], -1),
        array_on_disk((len(items), one_hot.shape[1])),
    )
    inputs = InputsFile(len(items))
    for batch in score_steps(trained, store, logged.rows, rule):
        rows = slice(end, end + len(batch.steps))
        target[rows], probabilities, batch_inputs = make_inputs(trained, batch)
        groups.target[rows] = (probabilities @ one_hot).numpy()
        inputs.append(batch_inputs)
        squares += float(probabilities.square().sum())
        end = rows.stop
    columns: dict[str, Any] = {}
    declared, unknown = "", int(np.isnan(propensity).sum())
    if options.estimate_propensities and unknown:
        group = np.maximum(groups.number, 0)
        owner = plain.users[plain.session]
        behavior = fit_behavior(inputs.states, items, group, owner, seed)
        declared = f"with the propensities of {unknown:,} steps estimated ({behavior})"
        columns["propensity"] = np.where(np.isnan(propensity), behavior.item, propensity)
    modelled, models = fit_models(inputs.chunks, plain, seed)
    steps = replace(plain, target=target, model=modelled, groups=groups, **columns)
    return steps, models, declared, squares / len(items)
