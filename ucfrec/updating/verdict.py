"""Whether an updated run is better than the one before, on rows that neither was trained on."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.episodes.states import liked_rewards
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.off_policy.estimators import FEWEST_USERS, cluster_intervals
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.score import score_steps
from ucfrec.off_policy.verdict import diagnose, list_reasons
from ucfrec.results.evidence import Evidence
from ucfrec.runs.record import UpdateVerdict
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.reward_report import (
    RewardRows,
    calibration_error,
    draw_episodes,
    draw_steps,
    fit_line,
    score_rows,
)

RANKING = "ndcg_liked"
VALUE = "reward per step"
_K = 10


def compare_runs(
    new: TrainedPolicy,
    old: TrainedPolicy,
    newest: UserRows,
    seed: int,
) -> UpdateVerdict:
    """Compare two runs, each under its own rule.

    Where steps have propensities, the difference in reward per step decides, under the logging
    policy's distribution of histories; else that in nDCG of liked items. With propensities nDCG
    weights clicks as if items were shown uniformly, as they favour the run that showed them.

    Args:
        new: trained on a store that was grown from that of `old`.
        newest: episodes of the grown store that neither was trained on, and the earlier rows of
            their users.
    """
    rows = newest.later
    user = rows.episode_values(schema.USER)[rows.all_steps()[0]]
    reward = rows.column(schema.REWARD)
    liked = liked_rewards(rows, reward)
    new_probability, new_gain = _judge_items(new, rows, newest)
    old_probability, old_gain = _judge_items(old, restrict_to_run(rows, old), newest)
    propensity = np.full(len(reward), np.nan)
    if schema.PROPENSITY in rows.record.columns:
        propensity = rows.column(schema.PROPENSITY).astype(np.float64)
    weighed = np.flatnonzero(propensity > 0)
    # Clicks favour the run that showed the items: they are weighted as if shown uniformly.
    shares = np.ones(len(reward))
    if len(weighed):
        shares = np.where(propensity > 0, propensity, np.inf)
    likes = liked / shares
    counted, faults = np.flatnonzero(likes), list[str]()
    if len(counted):
        target = np.full(len(counted), 1 / np.mean(1 / shares[counted]))
        faults = list_reasons(
            diagnose(_cut_rows(likes[counted], shares[counted], target, user[counted]))
        )
    differences = {RANKING: _compare((new_gain - old_gain) * likes, likes, user, seed, faults)}
    if len(weighed):
        returns, owner = reward[weighed].astype(np.float64), user[weighed]
        new_steps, old_steps = (
            _cut_rows(returns, propensity[weighed], probability[weighed].clip(0, 1), owner)
            for probability in (new_probability, old_probability)
        )
        faults = [f"the new run: {reason}" for reason in list_reasons(diagnose(new_steps))]
        faults += [f"the old run: {reason}" for reason in list_reasons(diagnose(old_steps))]
        # The mean reward is a control variate: weights of both policies have mean 1.
        lift = (new_steps.weights - old_steps.weights) * (returns - returns.mean())
        differences[VALUE] = _compare(lift, np.ones(len(lift)), owner, seed, faults)
    return UpdateVerdict(
        decided_by=[*differences][-1],
        differences=differences,
        steps=rows.n_steps,
        users=len(np.unique(user)),
    )


def _cut_rows(
    reward: Float64Array, propensity: Float64Array, target: Float64Array, user: IntArray
) -> LoggedSteps:
    """Rows (N,), each a session of its own."""
    return LoggedSteps(np.arange(len(reward)), reward, propensity, target, user=user)


def describe(verdict: UpdateVerdict) -> str:
    """The verdict with the evidence for and against, a line each."""
    lines = [
        f"verdict       {verdict.result}, by {verdict.decided_by} on the newest {verdict.steps:,} "
        f"rows of {verdict.users:,} users"
    ]
    for measure, evidence in verdict.differences.items():
        reasons = f" ({evidence.reasons[0]})" if evidence.reasons else ""
        lines.append(f"  {evidence.standing():<11} {measure} {evidence.format('+.4g')}{reasons}")
    return "\n".join(lines)


def _judge_items(
    trained: TrainedPolicy, view: EpisodeStore, rows: UserRows
) -> tuple[Float64Array, Float64Array]:
    """Of N logged items, (N,) probability under a run's rule, and (N,) 1 / log2(1 + rank) among the
    first ten; 0 of others, and of items that it does not know, which are −1."""
    probabilities, gains = [], []
    for batch in score_steps(trained, view, rows):
        column, unknown = batch.items.clamp(min=0).unsqueeze(1), batch.items < 0
        probability = batch.log_probabilities.gather(1, column)[:, 0].double().exp()
        # From 1; items of equal scores share the mean rank.
        score = batch.scores.gather(1, column)
        above = (batch.scores > score).sum(1)
        equal = (batch.scores == score).sum(1)
        rank = 1 + above.double() + (equal - 1).double() / 2
        gain = torch.where(rank <= _K, 1 / torch.log2(1 + rank), 0.0)
        probabilities.append(probability.masked_fill(unknown, 0.0).numpy())
        gains.append(gain.masked_fill(unknown, 0.0).numpy())
    return np.concatenate(probabilities), np.concatenate(gains)


def _compare(
    above: Float64Array,
    below: Float64Array,
    user: IntArray,
    seed: int,
    reasons: Sequence[str] = (),
) -> Evidence:
    """The ratio of sums over steps (N,), with its interval over users."""
    low = high = value = float(above.sum() / (below.sum() or 1))
    users = len(np.unique(user[below > 0]))
    if users < FEWEST_USERS:
        fault = f"{users} user{'s' * (users != 1)}, fewer than {FEWEST_USERS}, have such rows"
        reasons = [fault, *reasons]
    (interval,) = cluster_intervals(above[:, None], below[:, None], user, seed)
    if interval is not None and np.isfinite([interval.low, interval.high]).all():
        low, high = interval.low, interval.high
    elif above.any() and not reasons:
        reasons = ["the users do not differ enough"]
    return Evidence(value, low, high, tuple(reasons))


_GROUPS = 10
_PRIOR = 0.5
"""Added to every count, so that no group is empty."""
_MOST_STEPS = 100_000
LARGE = 0.25
"""Population stability index from which on a distribution counts as another one; below 0.1 it
counts as the same (Siddiqi, Credit Risk Scorecards, 2006)."""


def stability_index(old: Array, new: Array) -> float:
    """Population stability index of counts (G,) in the same groups: Σ (q − p) ln(q / p).

    Example: shares of 50% and 50% that become 60% and 40% have 0.041.
    """
    p, q = ((counts + _PRIOR) / (counts + _PRIOR).sum() for counts in (old, new))
    return float(((q - p) * np.log(q / p)).sum())


def popularity_index(old: Array, new: Array) -> float:
    """`stability_index` of steps per item (n_items,), in groups of about equal old popularity."""
    order = np.argsort(-old, kind="stable")
    more_popular = np.cumsum(old[order]) - old[order]
    group = _GROUPS * more_popular // max(old.sum(), 1)
    group = np.minimum(group, _GROUPS - 1).astype(np.int64)
    counts = [np.bincount(group, items[order], _GROUPS) for items in (old, new)]
    return stability_index(counts[0], counts[1])


def reward_index(old: Float64Array, new: Float64Array) -> float:
    """`stability_index` of rewards in groups between deciles of the old ones."""
    deciles = np.linspace(0, 1, _GROUPS + 1)[1:-1]
    edges = np.unique(np.quantile(old, deciles, method="lower"))
    groups = [np.searchsorted(edges, rewards) for rewards in (old, new)]
    counts = [np.bincount(group, minlength=len(edges) + 1) for group in groups]
    return stability_index(counts[0], counts[1])


def measure_drift(
    old: TrainedPolicy,
    training: EpisodeStore,
    added: EpisodeStore,
    counts: dict[str, Any],
    seed: int,
) -> dict[str, Any]:
    """What is different in the rows `added` to the `training` episodes of a run.

    Args:
        counts: of `ucfrec.logs.append.append_logs`.
        seed: of the rows that are drawn from many.

    Returns:
        `unknown_items`, `unknown_users`: share of the new rows. `item_popularity`, `rewards`:
        population stability indices, the first of known items. `predicted`, `observed`,
        `calibration_error`, `slope`: of the run's reward model on new rows of known items, absent
        without a reward model.
    """
    sample = restrict_to_run(added.select(np.sort(draw_episodes(added, _MOST_STEPS, seed))), old)
    items = sample.column(schema.ITEM)
    assert old.counts is not None
    times_shown = old.counts.shown.numpy()
    times_shown_now = np.bincount(items[items >= 0], None, len(times_shown))
    episodes, steps = draw_steps(training, _MOST_STEPS, seed)
    rewards = training.step_values(schema.REWARD, episodes, steps).astype(np.float64)
    measures = {
        "unknown_items": counts["new_item_steps"] / max(counts["steps"], 1),
        "unknown_users": counts["new_user_steps"] / max(counts["steps"], 1),
        "item_popularity": popularity_index(times_shown, times_shown_now),
        "rewards": reward_index(rewards, sample.column(schema.REWARD).astype(np.float64)),
    }
    model, (episodes, steps) = old.reward_model, draw_steps(sample, _MOST_STEPS, seed)
    in_catalogue = sample.step_values(schema.ITEM, episodes, steps) >= 0
    if model is None or not in_catalogue.any():
        return measures
    reward_rows = RewardRows.at(sample, episodes[in_catalogue], steps[in_catalogue], model.reach)
    scores = score_rows(model, reward_rows)
    predicted = model.expect(scores).double().numpy()
    observed = reward_rows.rewards.double().numpy()
    slope, _ = fit_line(scores, model.target(reward_rows.rewards), bool(model.binary))
    return measures | {
        "predicted": float(predicted.mean()),
        "observed": float(observed.mean()),
        "calibration_error": calibration_error(predicted, observed),
        "slope": slope,
    }


def describe_drift(drift: dict[str, Any]) -> str:
    """The drift in a few lines."""
    lines = [
        f"drift         {drift['unknown_items']:.1%} of the new rows have new items, "
        f"{drift['unknown_users']:.1%} new users",
        "              population stability index: item popularity "
        f"{drift['item_popularity']:.3f}, rewards {drift['rewards']:.3f} (above {LARGE:g}: large)",
    ]
    if "predicted" in drift:
        lines.append(
            f"              the old run's reward model predicts {drift['predicted']:.4g}, observed "
            f"{drift['observed']:.4g}; calibration slope {drift['slope']:.3g}"
        )
    return "\n".join(lines)


def restrict_to_run(view: EpisodeStore, trained: TrainedPolicy) -> EpisodeStore:
    """The episodes of a view of a store that was grown from a run's, in memory.

    They have the run's item states; users and items that it does not know become −1.
    """
    assert trained.item_states is not None
    steps = {name: view.column(name) for name in view.record.columns}
    items = steps[schema.ITEM]
    steps[schema.ITEM] = np.where(items < len(trained.items), items, -1)
    users = view.episode_values(schema.USER)
    episodes = {
        schema.USER: np.where(users < len(trained.user_ids), users, -1),
        schema.SPLIT: np.zeros(view.n_episodes, dtype=np.uint8),
        schema.TERMINATED: view.episode_values(schema.TERMINATED),
    }
    return EpisodeStore.from_arrays(steps, view.lengths, episodes, trained.item_states)
