"""Whether an updated run is better than the one before, on rows that neither was trained on."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.episodes.earlier import UserRows
from ucfrec.episodes.item_counts import liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.off_policy.intervals import FEWEST_USERS, cluster_intervals, cluster_mean
from ucfrec.off_policy.score import scored_steps
from ucfrec.off_policy.verdict import OTHERS_REMOVED
from ucfrec.results.statistics import effective_number
from ucfrec.runs.record import Difference, UpdateVerdict
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.drift import as_known

RANKING: Final = "ndcg_liked"
VALUE: Final = "reward per step"
_K: Final = 10
_ERRORS: Final = 3.0
"""Standard errors by which a mean weight may differ from 1."""
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
    found = _Logged.of(new, rows, seen), _Logged.of(old, as_known(rows, old), seen)
    reward = rows.column(schema.REWARD)
    liked = liked_rewards(rows, reward)
    differences = [_ranked(*found, liked, user, seed)]
    if schema.PROPENSITY in rows.record.columns:
        propensity = rows.column(schema.PROPENSITY).astype(np.float64)
        if (weighed := propensity > 0).any():
            weights = np.stack([each.probability for each in found], axis=1)[weighed]
            weights /= propensity[weighed, None]
            doubt = _doubt(weights, user[weighed], seen is not None)
            differences.append(
                _valued(weights, reward[weighed].astype(np.float64), user[weighed], seed, doubt)
            )
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
    for each in verdict.differences:
        what = {1: "for", 0: "open", -1: "against"}[each.sign]
        doubt = f"; not reliable: {each.doubt}" if each.doubt else ""
        interval = f"{each.value:+.4g} [{each.low:+.4g}, {each.high:+.4g}]"
        lines.append(f"  {what:<11} {each.measure} {interval}{doubt}")
    return "\n".join(lines)


@dataclass(frozen=True)
class _Logged:
    """What a run makes of N logged items."""

    probability: Float64Array
    """(N,) under the run's rule; 0 of items that it does not know."""
    gain: Float64Array
    """(N,) 1 / log2(1 + rank), 0 of items that are not among the first ten."""

    @classmethod
    def of(cls, trained: TrainedPolicy, view: EpisodeStore, seen: UserRows | None) -> "_Logged":
        """One pass over a view whose unknown items are −1."""
        chances, gains = [], []
        for batch in scored_steps(trained, view, None, seen):
            items, unknown = batch.items.clamp(min=0), batch.items < 0
            chance = batch.log_probabilities.gather(1, items.unsqueeze(1))[:, 0].double().exp()
            rank = _mean_ranks(batch.scores, items)
            gain = torch.where(rank <= _K, 1 / torch.log2(1 + rank), 0.0)
            chances.append(chance.masked_fill(unknown, 0.0).numpy())
            gains.append(gain.masked_fill(unknown, 0.0).numpy())
        return cls(np.concatenate(chances), np.concatenate(gains))


def _ranked(new: _Logged, old: _Logged, liked: BoolArray, user: IntArray, seed: int) -> Difference:
    """The paired difference in nDCG of liked items."""
    if not liked.any():
        return Difference(measure=RANKING, value=0, low=0, high=0, doubt="no step was liked")
    gained = ((new.gain - old.gain) * liked)[:, None]
    return _difference(RANKING, gained, liked[:, None].astype(np.float64), user, seed, "")


def _valued(
    weights: Float64Array, reward: Float64Array, user: IntArray, seed: int, doubt: str
) -> Difference:
    """The difference in reward per step, by inverse propensities.

    The mean reward is a control variate: weights of both policies have mean 1.

    Args:
        weights: (N, 2) probability under the new and the old rule, by the propensity.
        reward: (N,).
        user: (N,).
    """
    lift = ((weights[:, 0] - weights[:, 1]) * (reward - reward.mean()))[:, None]
    return _difference(VALUE, lift, np.ones_like(lift), user, seed, doubt)


def _mean_ranks(scores: torch.Tensor, items: torch.Tensor) -> torch.Tensor:
    """(B,) float64 rank of items (B,) by scores (B, n_items), from 1; tied ones share the mean."""
    own = scores.gather(1, items.unsqueeze(1))
    above, equal = (scores > own).sum(1), (scores == own).sum(1)
    return 1 + above.double() + (equal - 1).double() / 2


def _difference(
    measure: str, above: Float64Array, below: Float64Array, user: IntArray, seed: int, doubt: str
) -> Difference:
    """The ratio of sums over steps (N, 1), with its interval over users."""
    low = high = value = float(above.sum() / below.sum())
    users = len(np.unique(user[below[:, 0] > 0]))
    if users < FEWEST_USERS:
        doubt = f"{users} user{'s' * (users != 1)}, fewer than {FEWEST_USERS}, have such rows"
    (interval,) = cluster_intervals(above, below, user, seed)
    if interval is not None and np.isfinite([interval.low, interval.high]).all():
        low, high = interval.low, interval.high
    elif value and not doubt:
        doubt = "the users do not differ enough"
    return Difference(measure=measure, value=value, low=low, high=high, doubt=doubt)


def _doubt(weights: Float64Array, user: IntArray, filter_seen: bool) -> str:
    """Why not to rely on weights (N, 2) of the new and the old run; empty if nothing is found."""
    for name, column in zip(("new", "old"), weights.T, strict=True):
        mean, error = cluster_mean(column, user)
        if not abs(mean - 1) <= _ERRORS * error:
            cause = OTHERS_REMOVED if filter_seen else _SEEN_REMOVED
            return (
                f"the mean weight of the {name} run is {mean:.3g} ± {error:.2g} where 1 is "
                f"expected: the log lacks its choices ({cause}), or propensities are wrong"
            )
    effective = min(effective_number(column) for column in weights.T)
    if effective < _LEAST_STEPS:
        return f"the weights leave {effective:.0f} effective steps"
    return ""
