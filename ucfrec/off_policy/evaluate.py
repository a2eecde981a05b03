"""Estimates from logs the return of a trained policy, and reports how reliable that is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.off_policy.behavior_model import (
    BehaviorModel,
    default_groups,
    fit_behavior,
    group_items,
)
from ucfrec.off_policy.columns import Subject, diagnosis_columns, verdict_columns
from ucfrec.off_policy.diagnostics import Diagnosis, diagnose, implied_items
from ucfrec.off_policy.estimators import StepValue, estimate, session_terms, step_value
from ucfrec.off_policy.features import (
    InputsFile,
    StepInputs,
    array_on_disk,
    context_of,
    scores_of,
)
from ucfrec.off_policy.fqe import ModelReport, fit_models
from ucfrec.off_policy.logged_steps import ItemGroups, LoggedSteps
from ucfrec.off_policy.pages import as_pages, pages_of
from ucfrec.off_policy.score import LoggedSessions, ScoredSteps, scored_steps
from ucfrec.off_policy.training_rows import seen_too_often, share_seen
from ucfrec.off_policy.verdict import (
    FAR_OFF,
    MOST_LEFT_OUT,
    Verdict,
    cautions,
    conclude,
    influences,
)
from ucfrec.provenance import shorten_paths
from ucfrec.results.row import ResultRow, Scalar
from ucfrec.results.table import ResultTable
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import require, settings_table


@settings_table("")
class EstimateOptions:
    """How `evaluate_off_policy` estimates."""

    discount: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Discount factor γ of the estimated returns."""
    pages: bool = False
    """Estimate the return of a page: sessions of one step, of one user within 10 ms, are the
    positions of a page (`ucfrec.off_policy.pages`)."""
    users_known: bool = True
    """Whether the logs' users are persons, whose sessions are resampled together; if not, each
    session is taken to be of another user."""
    reward_range: tuple[float, float] | None = None
    """Least and greatest reward of a step, for the bounds of the value of unsupported choices;
    unset, those observed."""
    wanted_lift: Annotated[float, Field(gt=0)] | None = None
    """Return per session that a launch should gain over the logged policy; unset, 5% of the mean
    logged return."""
    item_groups: Annotated[int, Field(ge=0)] = 0
    """Clusters of items for MIPS; 0 chooses by the size of the catalogue, 1 omits MIPS."""
    estimate_propensities: bool = False
    """Estimate the propensities that the logs lack, cross-fitted and calibrated."""

    filter_seen: bool = False
    """Exclude items that the user was shown before a step, in earlier rows too, as `recommend` and
    `serve` do by default; then their logs have to be evaluated so."""

    def __post_init__(self) -> None:
        """Check that the range is in order."""
        low, high = self.reward_range or (0.0, 0.0)
        require(low <= high, f"the reward range is {low} to {high}; name the least one first")


DEFAULTS = EstimateOptions()


@dataclass(frozen=True, repr=False)
class OffPolicyReport(ResultTable):
    """The estimates, and whether to believe them."""

    shown = ("choice", "R_cum", "R_cum_low", "R_cum_high", "effective_sessions", "sessions")

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
        said = [f"warning: {text}" for text in self.warnings]
        return [*said, f"verdict: {self.verdict.headline}"]


@dataclass(frozen=True)
class EvaluatedSteps:
    """Logged steps with the evaluated policy's probabilities, and the models fitted on them."""

    steps: LoggedSteps
    models: ModelReport
    behavior: BehaviorModel | None
    """None where neither MIPS nor a lacking propensity needs it."""
    estimated: int
    """Number of steps whose propensity is estimated."""


def evaluate_off_policy(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    *,
    rule: DecisionRule | None = None,
    seed: int,
    options: EstimateOptions = DEFAULTS,
) -> OffPolicyReport:
    """Estimate the mean return of a session under a policy, from logs alone.

    Models of future reward are fitted on these logs; each user's sessions are predicted by models
    fitted on other users.

    Args:
        trained: its run's folder is named in the rows.
        logged: logs read with `keep_unknown`. The policy would never show an item that it does not
            know, so such a step has weight 0.
        rule: the decision rule to evaluate; None for the run's own.
        seed: seed of the folds and of the bootstrap.

    Raises:
        InputError: propensities are not probabilities, there is only one user, or a page would have
            a session of several steps.
    """
    rule = rule or trained.rule
    evaluated = logged_steps(trained, logged, rule, seed, options)
    steps = as_pages(evaluated.steps, *_pages(logged)) if options.pages else evaluated.steps
    steps, of_groups = _without_far_off_groups(steps)
    segment = None if options.pages else _quarters(logged.store, steps)
    found, diagnosis = estimate(steps, seed), diagnose(steps, options.reward_range, segment)
    value = None if options.pages else step_value(evaluated.steps, seed)
    seen = share_seen(trained, logged.store)
    lacking, notes = _of_dropped_rows(logged, options.pages)
    forbidden = [*seen_too_often(seen), *_too_many_items(trained, evaluated), *lacking]
    verdict = conclude(
        *(steps, seed, diagnosis, options.wanted_lift, forbidden, _declared(evaluated)),
        filter_seen=options.filter_seen,
    )
    warnings = [*verdict.reasons, *cautions(diagnosis, found), *_of_the_logs(seen, logged)]
    warnings += [*notes, *of_groups, *_of_the_models(evaluated)]
    warnings += [value.doubt] if value is not None and value.doubt else []
    about = {
        "seen_in_training": seen,
        "warnings": warnings,
        "dropped": logged.report["dropped"],
        "unknown_item_rows": logged.unknown_items,
        **verdict_columns(verdict),
        **diagnosis_columns(diagnosis),
        **evaluated.models.columns(),
    }
    fingerprint = logged.store.record.fingerprint
    read = conditions(trained.folder, len(steps.first), len(steps.reward), options)
    subject = Subject(trained, rule, seed, fingerprint, read, about)
    return OffPolicyReport(
        subject.rows(found),
        warnings,
        verdict,
        evaluated.models,
        *of_sessions(steps, diagnosis, verdict),
        value,
        [] if value is None else subject.rows(value.estimates, per_step=True),
    )


def conditions(run: Path, sessions: int, steps: int, options: EstimateOptions) -> dict[str, Scalar]:
    """How the logs were read, and their size."""
    return {
        "run": shorten_paths(str(run)),
        "discount": options.discount,
        "pages": options.pages,
        "anonymous": not options.users_known,
        "filter_seen": options.filter_seen,
        "sessions": sessions,
        "steps": steps,
    }


def of_sessions(
    steps: LoggedSteps, diagnosis: Diagnosis, verdict: Verdict
) -> tuple[Float64Array, IntArray | None, Float64Array | None]:
    """`returns`, `user` and `terms` of the report."""
    if diagnosis.left_out == diagnosis.sessions:
        return np.empty(0), None, None
    known = steps.known()
    terms = {} if verdict.estimator is None else session_terms(known)
    weighed = influences(terms[verdict.estimator]) if verdict.estimator in terms else None
    return known.returns, known.user, weighed


def _pages(logged: LoggedSessions) -> tuple[IntArray, IntArray | None]:
    """(N,) page of each step, and its position there where the observation is one-hot."""
    store = logged.store
    users = np.unique(logged.users, return_inverse=True)[1][store.all_steps()[0]]
    page = pages_of(users, store.column(schema.TIMESTAMP).astype(np.int64))
    if store.observation_size < 2:
        return page, None
    seen = store.column(schema.OBSERVATION)
    one_hot = np.isin(seen, (0, 1)).all() and (seen.sum(axis=1) == 1).all()
    return page, seen.argmax(axis=1) if one_hot else None


def _without_far_off_groups(steps: LoggedSteps) -> tuple[LoggedSteps, list[str]]:
    """The steps without weights of item groups, and why, where their mean is not 1: the estimated
    probabilities of groups are not good enough for sessions of this length."""
    weights = steps.cluster_weights
    if weights is None or abs((mean := float(weights[steps.last].mean())) - 1) <= FAR_OFF:
        return steps, []
    said = f"MIPS is excluded: its session weights have mean {mean:.3g} where 1 is expected"
    return replace(steps, cluster_propensity=None, cluster_target=None), [said]


def _quarters(store: EpisodeStore, steps: LoggedSteps) -> IntArray:
    """(S,) quarter of the logs, 1 to 4 by time, in which each session begins."""
    times = store.column(schema.TIMESTAMP)[steps.first]
    quarters = np.searchsorted(np.quantile(times, [0.25, 0.5, 0.75]), times, side="right")
    return np.asarray(1 + quarters)


def _declared(evaluated: EvaluatedSteps) -> str:
    if not evaluated.estimated:
        return ""
    return (
        f"with the propensities of {evaluated.estimated:,} steps estimated ({evaluated.behavior})"
    )


def _of_the_models(evaluated: EvaluatedSteps) -> list[str]:
    if evaluated.models.converged:
        return []
    return [
        "fitted Q evaluation diverged (its values exceed the largest possible return) and was "
        "stopped: ignore FQE"
    ]


def _too_many_items(trained: TrainedPolicy, evaluated: EvaluatedSteps) -> list[str]:
    steps = evaluated.steps
    assert steps.groups is not None
    items = len(trained.items)
    found = None if evaluated.estimated else implied_items(steps, steps.groups.number >= 0, items)
    if found is None or found.passed:
        return []
    return [
        f"the propensities imply {found.mean * items:,.0f} ± {found.error * items:,.0f} items to "
        f"choose from, the run knows {items:,}: propensities are too small"
    ]


def _of_the_logs(seen: float | None, logged: LoggedSessions) -> list[str]:
    said = []
    if seen is None:
        said.append(
            "the store that the run was trained on is gone or has changed: whether these logs were "
            "seen in training is not known, and users begin without a history; move the run "
            "together with its store"
        )
    if unknown := logged.unknown_items:
        said.append(
            f"{unknown:,} rows show items that the run does not know, and so never would: they "
            "weigh 0"
        )
    return said


def _of_dropped_rows(logged: LoggedSessions, pages: bool) -> tuple[list[str], list[str]]:
    """What dropped rows forbid, and what to know of them."""
    dropped, forbidden, notes = logged.report["dropped"], [], []
    if lacking := dropped.get("reward_not_finite", 0):
        rows = logged.store.n_steps + lacking
        said = f"{lacking:,} of {rows:,} rows have no finite reward: they are left out"
        if lacking > MOST_LEFT_OUT * rows:
            forbidden.append(f"{said}, and may differ from the rest")
        else:
            notes.append(said)
    if pages and (repeated := dropped.get("duplicate", 0)):
        notes.append(
            f"{repeated:,} rows repeat the user, item and time of another and are left out: if a "
            "page can show an item twice, log its positions a millisecond apart"
        )
    return forbidden, notes


def logged_steps(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    rule: DecisionRule,
    seed: int,
    options: EstimateOptions = DEFAULTS,
) -> EvaluatedSteps:
    """Collect the logged steps, the policy's probabilities and models of its return.

    In memory are some ten numbers a step; what the models see of it, and the probabilities of item
    groups, lie on disk.

    Args:
        logged: logs read with `keep_unknown`.
        seed: seed of the folds, item groups and samples.

    Returns:
        The N logged steps, in order.

    Raises:
        InputError: propensities are not probabilities, or there is only one user.
    """
    store, plain = logged.store, _logged_only(logged, options)
    _require_two_users(logged, plain)
    items = store.column(schema.ITEM).astype(np.int64)
    group_of = _item_groups(trained, options, seed)
    group = np.where(items >= 0, group_of[items], -1)
    one_hot = torch.from_numpy(np.eye(group_of.max() + 1, dtype=np.float32)[group_of])
    target, shown = np.empty(len(items)), array_on_disk((len(items), one_hot.shape[1]))
    done, behavior = 0, None
    with InputsFile() as inputs:
        shown_before = logged.rows if options.filter_seen else None
        for batch in scored_steps(trained, store, rule, shown_before):
            rows = slice(done, done + len(batch.steps))
            target[rows], probabilities, seen = step_features(trained, batch)
            shown[rows] = (probabilities @ one_hot).numpy()
            inputs.append(seen)
            done = rows.stop
        grouped = shown.shape[1] > 1 and plain.unknown_propensities < len(items)
        if grouped or options.estimate_propensities:
            known = np.maximum(group, 0)
            behavior = fit_behavior(inputs.states, items, known, plain.session, seed, plain.user)
        modelled, models = fit_models(
            inputs.chunks, plain.reward, plain.session, seed, plain.user, plain.discount
        )
    groups = ItemGroups(group, shown)
    steps = replace(plain, target=target, model=modelled, groups=groups)
    estimated = 0
    if behavior is not None:
        estimated = plain.unknown_propensities if options.estimate_propensities else 0
        steps = _weighed_by_model(steps, groups, behavior, options.estimate_propensities)
    return EvaluatedSteps(steps, models, behavior, estimated)


def _logged_only(logged: LoggedSessions, options: EstimateOptions) -> LoggedSteps:
    """What the logs say, without any policy. Checks the propensities before the slow scoring."""
    store = logged.store
    propensity = np.full(store.n_steps, np.nan)
    if schema.PROPENSITY in store.record.columns:
        propensity = store.column(schema.PROPENSITY).astype(np.float64)
    return LoggedSteps(
        session=store.all_steps()[0],
        reward=store.column(schema.REWARD).astype(np.float64),
        propensity=propensity,
        target=np.zeros(store.n_steps),
        user=np.unique(logged.users, return_inverse=True)[1] if options.users_known else None,
        discount=options.discount,
    )


def _require_two_users(logged: LoggedSessions, plain: LoggedSteps) -> None:
    """Check, before the slow scoring, that a model of other users can predict each user.

    Raises:
        InputError: there is only one user.
    """
    sessions = len(plain.first)
    users = sessions if plain.user is None else len(np.unique(plain.user))
    if users < 2:
        name = logged.report.get("files", [logged.store.path])[0]
        raise InputError(
            f"{name}: the logs have {sessions:,} session{'s' * (sessions > 1)} of one user; at "
            "least two users are needed, as each is predicted by models of the others; give logs "
            "of more users"
        )


def _weighed_by_model(
    steps: LoggedSteps, groups: ItemGroups, behavior: BehaviorModel, fill: bool
) -> LoggedSteps:
    """The steps with the probabilities of their items' groups, for MIPS, and with `fill` the
    estimated propensities where the logs lack them."""
    lacking = np.isnan(steps.propensity) & fill
    of_group = np.take_along_axis(groups.target, np.maximum(groups.number, 0)[:, None], axis=1)
    return replace(
        steps,
        propensity=np.where(lacking, behavior.item, steps.propensity),
        cluster_propensity=behavior.group,
        cluster_target=np.where(groups.number < 0, 0.0, of_group[:, 0]).clip(0, 1),
    )


def _item_groups(trained: TrainedPolicy, options: EstimateOptions, seed: int) -> IntArray:
    """(n_items,) group of every item."""
    assert trained.item_states is not None
    embeddings = trained.item_states.embeddings.numpy()
    wanted = options.item_groups or default_groups(len(embeddings))
    if wanted == 1:
        return np.zeros(len(embeddings), dtype=np.int64)
    return group_items(embeddings, wanted, seed)


def step_features(trained: TrainedPolicy, batch: ScoredSteps) -> tuple[Array, Tensor, StepInputs]:
    """Compute the policy's probability and the models' inputs for B logged steps.

    An item that the run does not know (−1) has probability 0 and an embedding of zeros.

    Returns:
        The evaluated policy's probability (B,) of the logged item, and (B, n_items) of all items;
        and what the models see.
    """
    assert trained.item_states is not None
    embeddings = trained.item_states.embeddings
    items = batch.items
    known = items >= 0
    probabilities = batch.log_probabilities.exp()
    target = probabilities.gather(1, items[:, None].clamp(min=0))[:, 0].double() * known
    # What the policy thinks of an item counts for the models also where the rule takes the best.
    of_chosen, of_shown = scores_of(batch.scores.log_softmax(-1), items, probabilities)
    seen = StepInputs(
        context=context_of(batch),
        state_size=batch.states.shape[1],
        chosen=embeddings[items] * known[:, None],
        shown=probabilities @ embeddings,
        scores=torch.stack([of_chosen, of_shown], dim=1),
    )
    return target.clamp(0, 1).numpy(), probabilities, seen
