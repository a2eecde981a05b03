"""What `rank`, `ope` and `evaluate` do, as commands and as methods of `Recommender`: measure, and
add each result to the model card of its run. Each imports only what it needs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ucfrec.acting.decision import DecisionRule
from ucfrec.provenance import shorten_paths
from ucfrec.reporting.model_card import add_estimates, add_evaluation, add_ranking
from ucfrec.results.rows import Evaluation, Ranking
from ucfrec.runs.trained_policy import TrainedPolicy

if TYPE_CHECKING:
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.off_policy.evaluate import EstimateOptions, OffPolicyReport
    from ucfrec.off_policy.score import LoggedSessions

Candidate = tuple[TrainedPolicy, DecisionRule]
"""A policy with the decision rule that is measured."""
TEST_SPLIT = "the test split"
"""Name of the logs where none are given."""


def rank_policies(
    candidates: Sequence[Candidate],
    logged: "LoggedSessions",
    logs: str,
    *,
    k: int,
    filter_seen: bool,
    liked: str | None,
    seed: int,
    checkpoint: str = "best",
) -> Ranking:
    """Rank what users were shown later, by policies of one store and by baselines. InputError if
    `liked` cannot be used.

    Args:
        logs: their name in model cards; `TEST_SPLIT` for that of the store.
        liked: condition on the reward; None for the run's own.
        seed: of the bootstrap over users and of the random baseline.
        checkpoint: name of the policies' weights, here and below.
    """
    from ucfrec.evaluation.ranking import Later, LikedExpression
    from ucfrec.evaluation.ranking_table import PolicyRanker, ranking_rows
    from ucfrec.logs.expressions import Expression
    from ucfrec.off_policy.score import HISTORY_LACKING, seen_too_often, share_seen

    trained, later = candidates[0][0], Later(logged.store, logged.rows, filter_seen)
    condition = None
    if liked is not None:
        condition = LikedExpression(Expression(liked, "--liked"), trained.record.reward)
    rows = ranking_rows(
        [PolicyRanker(policy, rule) for policy, rule in candidates],
        trained,
        trained.training_store(),
        later,
        logged.users,
        k,
        seed,
        condition,
    )
    rows = [replace(row, checkpoint=checkpoint) for row in rows]
    warnings = []
    for (policy, _), row in zip(candidates, rows, strict=False):
        doubts = [] if logs == TEST_SPLIT else seen_too_often(share_seen(policy, logged.store))
        if logged.rows.earlier is None and policy is trained:
            doubts.append(HISTORY_LACKING)
        add_ranking(policy.folder, row, logs, doubts)
        where = "" if len(candidates) == 1 else f"{policy.folder}: "
        warnings += [f"{where}{doubt}" for doubt in doubts]
    return Ranking(rows, warnings)


def estimate_return(
    candidate: Candidate,
    logged: "LoggedSessions",
    logs: Sequence[str],
    *,
    options: "EstimateOptions",
    seed: int,
    checkpoint: str = "best",
) -> "OffPolicyReport":
    """Estimate the return of a session from logs. InputError if the logs cannot be used.

    Args:
        logs: their names in the model card.
        seed: of the folds and the bootstrap.
    """
    from ucfrec.off_policy.evaluate import evaluate_off_policy

    trained, rule = candidate
    report = evaluate_off_policy(trained, logged, rule=rule, seed=seed, options=options)
    report = replace(
        report,
        rows=[replace(row, checkpoint=checkpoint) for row in report.rows],
        step_rows=[replace(row, checkpoint=checkpoint) for row in report.step_rows],
    )
    add_estimates(trained.folder, logs, report)
    return report


def evaluate_in(
    environment: "Environment",
    candidates: Sequence[Candidate],
    behaviors: Sequence[str],
    *,
    episodes: int,
    seed: int,
    checkpoint: str = "best",
) -> Evaluation:
    """Measure the return of policies and of built-in policies in a simulator. InputError if a
    policy does not fit the environment, or it has no such behavior."""
    from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy

    rows = []
    for trained, rule in candidates:
        row = evaluate_policy(environment, trained, trained.name, episodes, seed, rule)
        conditions = {**row.conditions, "run": shorten_paths(str(trained.folder))}
        rows.append(replace(row, conditions=conditions, checkpoint=checkpoint))
        add_evaluation(trained.folder, rows[-1])
    rows += [evaluate_behavior(environment, name, episodes, seed) for name in behaviors]
    return Evaluation(rows, ())
