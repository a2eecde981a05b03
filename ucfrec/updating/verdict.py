"""Whether an updated run is better than the one before, on rows that neither was trained on."""

from typing import Final, Literal

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.states import liked_rewards
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.off_policy.estimators import FEWEST_USERS, cluster_intervals
from ucfrec.off_policy.score import score_steps
from ucfrec.off_policy.verdict import OTHERS_REMOVED, check_mean_weight
from ucfrec.results.statistics import effective_number
from ucfrec.runs.record import Difference, UpdateVerdict
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.drift import restrict_to_run

RANKING: Final = "ndcg_liked"
VALUE: Final = "reward per step"
_K: Final = 10
_LEAST_STEPS: Final = 30
"""Effective steps below which weights say nothing."""
_SEEN_REMOVED: Final = "as where it was served without seen items: update with --filter-seen"


def compare_runs(
    new: TrainedPolicy,
    old: TrainedPolicy,
    rows: EpisodeStore,
    seed: int,
    seen: UserRows | None = None,
) -> UpdateVerdict:
    """Compare two runs, each under its own rule.

    Where steps have propensities, the difference in reward per step decides, under the logging
    policy's distribution of histories, and nothing if that is not reliable: rankings of logged
    clicks favour whoever showed them. Else the difference in nDCG of liked items decides.

    Args:
        new: trained on a store that was grown from that of `old`.
        rows: newest episodes of the grown store, which neither was trained on.
        seen: rows of the users of the grown store, if items that a user was shown before are
            excluded.
    """
    user = rows.episode_values(schema.USER).astype(np.int64)[rows.all_steps()[0]]
    reward = rows.column(schema.REWARD)
    liked = liked_rewards(rows, reward)
    new_probability, new_gain = _judge_items(new, rows, seen)
    old_probability, old_gain = _judge_items(old, restrict_to_run(rows, old), seen)
    if liked.any():
        gained = (new_gain - old_gain) * liked
        differences = [_compare(RANKING, gained, liked.astype(np.float64), user, seed)]
    else:
        differences = [
            Difference(measure=RANKING, value=0, low=0, high=0, doubt="no step was liked")
        ]
    if schema.PROPENSITY in rows.record.columns:
        propensity = rows.column(schema.PROPENSITY).astype(np.float64)
        if (weighed := propensity > 0).any():
            probabilities = np.stack([new_probability, old_probability], axis=1)
            weights = probabilities[weighed] / propensity[weighed, None]
            earned, owner = reward[weighed].astype(np.float64), user[weighed]
            # The mean reward is a control variate: weights of both policies have mean 1.
            lift = (weights[:, 0] - weights[:, 1]) * (earned - earned.mean())
            doubt = _doubt(weights, owner, seen is not None)
            differences.append(_compare(VALUE, lift, np.ones(len(lift)), owner, seed, doubt))
    decisive = differences[-1]
    results: dict[int, Literal["better", "no significant difference", "worse"]] = {
        1: "better", 0: "no significant difference", -1: "worse"
    }  # fmt: skip
    return UpdateVerdict(
        result=results[decisive.sign],
        decided_by=decisive.measure,
        differences=tuple(differences),
        steps=rows.n_steps,
        users=len(np.unique(user)),
    )


def describe(verdict: UpdateVerdict) -> str:
    """The verdict with the evidence for and against, a line each."""
    lines = [
        f"verdict       {verdict.result}, by {verdict.decided_by} on the newest {verdict.steps:,} "
        f"rows of {verdict.users:,} users"
    ]
    for row in verdict.differences:
        side = {1: "for", 0: "open", -1: "against"}[row.sign]
        doubt = f"; not reliable: {row.doubt}" if row.doubt else ""
        interval = f"{row.value:+.4g} [{row.low:+.4g}, {row.high:+.4g}]"
        lines.append(f"  {side:<11} {row.measure} {interval}{doubt}")
    return "\n".join(lines)


def _judge_items(
    trained: TrainedPolicy, view: EpisodeStore, seen: UserRows | None
) -> tuple[Float64Array, Float64Array]:
    """What a run makes of N logged items, in one pass over a view whose unknown items are −1.

    Returns:
        (N,) probability under the run's rule, and (N,) 1 / log2(1 + rank), 0 of items that are not
        among the first ten; both 0 of items that it does not know.
    """
    probabilities, gains = [], []
    for batch in score_steps(trained, view, None, seen):
        column, unknown = batch.items.clamp(min=0).unsqueeze(1), batch.items < 0
        probability = batch.log_probabilities.gather(1, column)[:, 0].double().exp()
        # From 1; items of equal scores share the mean rank.
        score = batch.scores.gather(1, column)
        above, equal = (batch.scores > score).sum(1), (batch.scores == score).sum(1)
        rank = 1 + above.double() + (equal - 1).double() / 2
        gain = torch.where(rank <= _K, 1 / torch.log2(1 + rank), 0.0)
        probabilities.append(probability.masked_fill(unknown, 0.0).numpy())
        gains.append(gain.masked_fill(unknown, 0.0).numpy())
    return np.concatenate(probabilities), np.concatenate(gains)


def _compare(
    measure: str,
    above: Float64Array,
    below: Float64Array,
    user: IntArray,
    seed: int,
    doubt: str = "",
) -> Difference:
    """The ratio of sums over steps (N,), with its interval over users."""
    low = high = value = float(above.sum() / below.sum())
    users = len(np.unique(user[below > 0]))
    if users < FEWEST_USERS:
        doubt = f"{users} user{'s' * (users != 1)}, fewer than {FEWEST_USERS}, have such rows"
    (interval,) = cluster_intervals(above[:, None], below[:, None], user, seed)
    if interval is not None and np.isfinite([interval.low, interval.high]).all():
        low, high = interval.low, interval.high
    elif value and not doubt:
        doubt = "the users do not differ enough"
    return Difference(measure=measure, value=value, low=low, high=high, doubt=doubt)


def _doubt(weights: Float64Array, user: IntArray, filter_seen: bool) -> str:
    """Why not to rely on weights (N, 2) of the new and the old run; empty if nothing is found."""
    for name, column in zip(("new", "old"), weights.T, strict=True):
        test = check_mean_weight(f"the {name} run", column, user)
        if not test.passed:
            cause = OTHERS_REMOVED if filter_seen else _SEEN_REMOVED
            return (
                f"{test} where 1 is expected: the log lacks its choices ({cause}), or propensities "
                "are wrong"
            )
    effective = min(effective_number(column) for column in weights.T)
    return f"the weights leave {effective:.0f} effective steps" if effective < _LEAST_STEPS else ""
