"""Estimates from logs the return of a trained policy, and reports how reliable that is."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.estimators import (
    LOGGED,
    SUITE,
    Estimate,
    Terms,
    estimate,
    session_terms,
    summarise,
)
from ucfrec.off_policy.logged_steps import ItemGroups, LoggedSteps, as_pages, number_pages
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
    FAR_OFF,
    MOST_LEFT_OUT,
    Verdict,
    check_catalogue_size,
    check_mean_weight,
    conclude,
    diagnose,
    list_cautions,
)
from ucfrec.provenance import config_hash, provenance, shorten_paths
from ucfrec.results.rows import ResultRow, ResultTable
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import require, settings_table


@settings_table("")
class EstimateOptions:
    """How `evaluate_off_policy` estimates."""

    discount: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Discount factor γ of the estimated returns."""
    pages: bool = False
    """Estimate the return of a page: its positions are sessions of one step, within 10 ms."""
    users_known: bool = True
    """Whether users are persons; if not, each session is taken to be of another user."""
    reward_range: tuple[float, float] | None = None
    """Least and greatest reward of a step, for bounds of the value; unset, those observed."""
    wanted_lift: Annotated[float, Field(gt=0)] | None = None
    """Return per session that a launch should gain; unset, 5% of the mean logged return."""
    item_groups: Annotated[int, Field(ge=0)] = 0
    """Clusters of items for MIPS; 0 chooses by the size of the catalogue, 1 omits MIPS."""
    estimate_propensities: bool = False
    """Estimate the propensities that the logs lack, cross-fitted and calibrated."""

    def __post_init__(self) -> None:
        low, high = self.reward_range or (0.0, 0.0)
        require(low <= high, f"the reward range is {low} to {high}; name the least one first")


DEFAULTS = EstimateOptions()


@dataclass(frozen=True)
class StepValue:
    """What N' logged steps with a propensity say of the evaluated policy: the mean reward of a step
    (Dudík, Langford & Li, ICML 2011), had it chosen the item after a history as the logging policy
    makes them. It says nothing of the return of sessions that the policy itself would make.
    """

    estimates: dict[str, Estimate]
    """Mean reward of a step as logged, and by IPS, SNIPS and DR under the evaluated policy."""
    lift: Estimate
    """Of DR over the steps as logged."""
    steps: int
    """N'."""
    of: int
    """All logged steps."""
    doubt: str | None
    """Why not to believe the estimates; None if nothing is found."""

    def __str__(self) -> str:
        ends = ""
        if self.lift.interval is not None:
            low, high = self.lift.interval
            ends = f" [{low:+.4g}, {high:+.4g}]"
        return (
            f"per step, on the {self.steps:,} of {self.of:,} steps with a propensity, under the "
            f"logging policy's distribution of histories: {self.lift.value:+.4g}{ends} per step by "
            "DR; not an estimate of the session return"
        )


def step_value(steps: LoggedSteps, seed: int) -> StepValue | None:
    """The value per step; None where all steps have propensities, too few, or no weight."""
    weighable = ~np.isnan(steps.propensity)
    if steps.model is None or weighable.all() or weighable.sum() < 2:
        return None
    reward, weight = steps.reward[weighable], (steps.target / steps.propensity)[weighable]
    if not weight.any():
        return None
    user = steps.users[steps.session[weighable]]
    ones = np.ones(len(reward))
    left = reward - steps.model.logged_reward[weighable]
    doubly_robust = steps.model.reward[weighable] + weight * left
    terms = {
        LOGGED: Terms(reward, ones, ones),
        "IPS": Terms(weight * reward, ones, weight),
        "SNIPS": Terms(weight * reward, weight, weight),
        "DR": Terms(doubly_robust, ones, weight),
        "lift": Terms(doubly_robust - reward, ones, weight),
    }
    estimates = summarise(terms, user, seed)
    lift, test = estimates.pop("lift"), check_mean_weight("per step", weight, user)
    doubt = (
        f"{test} where 1 is expected: propensities are wrong, or those steps lack choices that the "
        "policy makes"
    )
    return StepValue(estimates, lift, len(reward), len(weighable), None if test.passed else doubt)


@dataclass(frozen=True, repr=False)
class OffPolicyReport(ResultTable):
    """The estimates, and whether to believe them."""

    headings = ("choice", "R_cum", "R_cum_low", "R_cum_high", "effective_sessions", "sessions")

    rows: list[ResultRow]
    """One result row for each estimator."""
    warnings: list[str]
    """The verdict's reasons, cautions, and remarks on the logs."""
    verdict: Verdict
    models: ModelReport | None
    """How good the models of DM, FQE and DR are; None from scored rows."""
    returns: Float64Array
    """(S,) of the logged sessions, or pages, with all their propensities; empty if none has."""
    user: IntArray | None
    """(S,) whose they are; None where each is of another user."""
    terms: Float64Array | None
    """(S,) whose mean is the estimate that the verdict is of; None where nothing can be weighed."""
    per_step: StepValue | None = None
    """The value per step, where only some steps have propensities."""
    step_rows: Sequence[ResultRow] = ()
    """Its result rows, one for each estimator."""

    def _said(self) -> list[str]:
        warnings = [f"warning: {text}" for text in self.warnings]
        return [*warnings, f"verdict: {self.verdict.headline}"]


@dataclass
class Evidence:
    """Logged steps, and what the logs say of an estimate beside their weights."""

    steps: LoggedSteps
    rows: int
    columns: dict[str, Any]
    """Further columns of the result rows."""
    segment: IntArray | None = None
    declared: str = ""
    fingerprint: str | None = None
    models: ModelReport | None = None
    per_step: StepValue | None = None
    excludes_seen: bool = False
    """Whether logs say where items that users had seen were excluded."""
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
    alone, read with `keep_unknown`: a step of an unknown item has weight 0.

    Raises:
        InputError: propensities are not probabilities, there is only one user, or a page would have
            a session of several steps.
    """
    rule, store = rule or trained.rule, logged.store
    steps, models, declared = collect_steps(trained, logged, rule, seed, options)
    assert steps.groups is not None
    columns = {
        "seen_in_training": share_seen(trained, store),
        "dropped": logged.report["dropped"],
        "unknown_item_rows": logged.unknown_items,
        **{f"model_{name}": value for name, value in asdict(models).items()},
    }
    evidence = Evidence(
        steps, len(steps.reward), columns, None, declared, store.record.fingerprint, models
    )
    evidence.excludes_seen = schema.EXCLUDES_SEEN in store.record.columns
    _doubt_logs(evidence, logged, options.pages)
    items, in_catalogue = len(trained.items), steps.groups.number >= 0
    implied = None if declared else check_catalogue_size(steps, in_catalogue, items)
    if implied is not None and not implied.passed:
        evidence.forbidden.append(
            f"the propensities imply {implied.mean * items:,.0f} ± {implied.error * items:,.0f} "
            f"items to choose from, the run knows {items:,}: propensities are too small"
        )
    if options.pages:
        page, position = _find_pages(logged)
        steps = as_pages(steps, page, position)
    else:
        # The quarter of the logs, 1 to 4 by time, in which each session begins.
        times = store.column(schema.TIMESTAMP)[steps.first]
        quartiles = np.quantile(times, [0.25, 0.5, 0.75])
        evidence.segment = 1 + np.searchsorted(quartiles, times, side="right")
        evidence.per_step = step_value(steps, seed)
    clusters = steps.cluster_weights
    if clusters is not None and abs((mean := float(clusters[steps.last].mean())) - 1) > FAR_OFF:
        # The estimated probabilities of groups are not good enough for sessions of this length.
        steps = replace(steps, cluster_propensity=None, cluster_target=None)
        evidence.remarks.append(
            f"MIPS is excluded: its session weights have mean {mean:.3g} where 1 is expected"
        )
    if not models.converged:
        evidence.remarks.append(
            "fitted Q evaluation diverged (its values exceed the largest possible return) and was "
            "stopped: ignore FQE"
        )
    if evidence.per_step is not None and evidence.per_step.doubt:
        evidence.remarks.append(evidence.per_step.doubt)
    evidence.steps = steps
    return make_report(trained, rule, evidence, seed, options)


def make_report(
    trained: TrainedPolicy,
    rule: DecisionRule,
    evidence: Evidence,
    seed: int,
    options: EstimateOptions,
) -> OffPolicyReport:
    """Estimate from logged steps, judge the estimates, and make their result rows: `R_cum` is the
    mean return, as in `ucfrec.evaluation.evaluate`, and `R_step` the mean reward of a step.
    """
    steps, per_step = evidence.steps, evidence.per_step
    estimates = estimate(steps, seed)
    diagnosis = diagnose(steps, options.reward_range, evidence.segment)
    verdict = conclude(
        steps,
        seed,
        diagnosis,
        wanted_lift=options.wanted_lift,
        forbidden=evidence.forbidden,
        declared=evidence.declared,
        filter_seen=evidence.excludes_seen,
    )
    warnings = [*verdict.reasons, *list_cautions(diagnosis, estimates), *evidence.remarks]
    judged = evidence.columns | asdict(verdict) | diagnosis.list_columns()
    judged |= {"warnings": warnings, "verdict": str(verdict), "verdict_of": verdict.estimator}
    del judged["estimator"], judged["reasons"]
    record, of_steps = trained.record, {} if per_step is None else per_step.estimates
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
            "pages": options.pages,
            "anonymous": not options.users_known,
            "sessions": len(steps.first),
            "steps": evidence.rows,
            "choice": "softmax" if rule.draws else "greedy",
        },
        config_hash=config_hash(record.settings),
        data_fingerprint=evidence.fingerprint,
        metric="R_cum",
        metrics={},
        target_return=rule.target,
        rule=rule.hash,
        **provenance(),
    )
    weighable = None if steps.lacking.all() else steps.weighable
    terms = None
    if weighable is not None and verdict.estimator is not None:
        terms = session_terms(weighable)[verdict.estimator].influences
    return OffPolicyReport(
        rows=_make_rows(base, estimates, rule, judged),
        warnings=warnings,
        verdict=verdict,
        models=evidence.models,
        returns=np.empty(0) if weighable is None else weighable.returns,
        user=None if weighable is None else weighable.user,
        terms=terms,
        per_step=per_step,
        step_rows=_make_rows(
            replace(base, table="per step", metric="R_step"), of_steps, rule, judged
        ),
    )


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
            "parameter": result.parameter,
            "decision_rule": rule.as_dict(),
        }
        rows.append(row.extended({**numbers, **judged}))
    return rows


def _doubt_logs(evidence: Evidence, logged: LoggedSessions, pages: bool) -> None:
    """Add what rows seen in training, of unknown items, and dropped rows say."""
    seen, dropped = evidence.columns["seen_in_training"], logged.report["dropped"]
    evidence.forbidden += seen_too_often(seen)
    if seen is None:
        evidence.remarks.append(
            "the store that the run was trained on is gone or has changed: whether these logs were "
            "seen in training is not known, and users begin without a history; move the run "
            "together with its store"
        )
    if logged.unknown_items:
        evidence.remarks.append(
            f"{logged.unknown_items:,} rows show items that the run does not know, and so never "
            "would: they weigh 0"
        )
    if without_reward := dropped.get("reward_not_finite", 0):
        rows = logged.store.n_steps + without_reward
        much = without_reward > MOST_LEFT_OUT * rows
        (evidence.forbidden if much else evidence.remarks).append(
            f"{without_reward:,} of {rows:,} rows have no finite reward: they are left out"
            + ", and may differ from the rest" * much
        )
    if pages and (repeated := dropped.get("duplicate", 0)):
        evidence.remarks.append(
            f"{repeated:,} rows repeat the user, item and time of another and are left out: if a "
            "page can show an item twice, log its positions a millisecond apart"
        )


def _find_pages(logged: LoggedSessions) -> tuple[IntArray, IntArray | None]:
    """(N,) page of each step, and its position there where the observation is one-hot."""
    store = logged.store
    users = np.unique(logged.users, return_inverse=True)[1][store.all_steps()[0]]
    page = number_pages(users, store.column(schema.TIMESTAMP).astype(np.int64))
    if store.observation_size < 2:
        return page, None
    observations = store.column(schema.OBSERVATION)
    one_hot = np.isin(observations, (0, 1)).all() and (observations.sum(axis=1) == 1).all()
    return page, observations.argmax(axis=1) if one_hot else None


def collect_steps(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    rule: DecisionRule,
    seed: int,
    options: EstimateOptions = DEFAULTS,
) -> tuple[LoggedSteps, ModelReport, str]:
    """The logged steps, in order, with the policy's probabilities and models of its return; how
    good the models are; and which propensities are estimated, "" if none is. What the models see,
    and the probabilities of groups, lie on disk."""
    store = logged.store
    propensity = np.full(store.n_steps, np.nan)
    if schema.PROPENSITY in store.record.columns:
        propensity = store.column(schema.PROPENSITY).astype(np.float64)
    # What the logs say without any policy is checked before the slow scoring.
    plain = LoggedSteps(
        session=store.all_steps()[0],
        reward=store.column(schema.REWARD).astype(np.float64),
        propensity=propensity,
        target=np.zeros(store.n_steps),
        user=np.unique(logged.users, return_inverse=True)[1] if options.users_known else None,
        discount=options.discount,
    )
    if len(np.unique(plain.users)) < 2:
        sessions = len(plain.first)
        raise InputError(
            f"{logged.report.get('files', [store.path])[0]}: the logs have {sessions:,} "
            f"session{'s' * (sessions > 1)} of one user; each user is predicted by models of "
            "others: give logs of more users"
        )
    items = store.column(schema.ITEM).astype(np.int64)
    assert trained.item_states is not None
    group_of = group_items(trained.item_states.embeddings.numpy(), options.item_groups, seed)
    one_hot = torch.from_numpy(np.eye(group_of.max() + 1, dtype=np.float32)[group_of])
    target, end = np.empty(len(items)), 0
    groups = ItemGroups(
        np.where(
            items >= 0,
            group_of[items],
            -1,
        ),
        array_on_disk((len(items), one_hot.shape[1])),
    )
    inputs = InputsFile(len(items))
    for batch in score_steps(trained, store, logged.rows, rule):
        rows = slice(end, end + len(batch.steps))
        target[rows], probabilities, batch_inputs = make_inputs(trained, batch)
        groups.target[rows] = (probabilities @ one_hot).numpy()
        inputs.append(batch_inputs)
        end = rows.stop
    columns: dict[str, Any] = {}
    declared, unknown = "", int(np.isnan(propensity).sum())
    if options.estimate_propensities or (one_hot.shape[1] > 1 and unknown < len(items)):
        group = np.maximum(groups.number, 0)
        owner = plain.users[plain.session]
        behavior = fit_behavior(inputs.states, items, group, owner, seed)
        of_group = np.take_along_axis(groups.target, group[:, None], axis=1)[:, 0]
        columns["cluster_propensity"] = behavior.group
        columns["cluster_target"] = np.where(groups.number < 0, 0.0, of_group).clip(0, 1)
        if options.estimate_propensities and unknown:
            declared = f"with the propensities of {unknown:,} steps estimated ({behavior})"
            columns["propensity"] = np.where(np.isnan(propensity), behavior.item, propensity)
    modelled, models = fit_models(inputs.chunks, plain, seed)
    return replace(plain, target=target, model=modelled, groups=groups, **columns), models, declared
