"""Whether an updated run is better than the one before, on rows that neither was trained on."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.ranking import Period, Steps, compare, rank_steps
from ucfrec.evaluation.ranking_baselines import PolicyRanker
from ucfrec.off_policy.intervals import cluster_intervals, cluster_means
from ucfrec.off_policy.score import scored_steps
from ucfrec.runs.record import Difference, UpdateVerdict
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.new_rows import as_known

RANKING: Final = "ndcg_liked"
VALUE: Final = "reward per step"
_K: Final = 10
_ERRORS: Final = 3.0
"""Standard errors by which a mean weight may differ from 1."""
_LEAST_STEPS: Final = 30
"""Effective steps below which weights say nothing."""


def compare_runs(
    new: TrainedPolicy, old: TrainedPolicy, rows: EpisodeStore, seed: int
) -> UpdateVerdict:
    """Compare two runs, each under its own rule.

    Where steps have propensities, the difference in reward per step decides, under the logging
    policy's distribution of histories, and nothing if that is not reliable: rankings of logged
    clicks favour whoever showed them. Else the difference in nDCG of liked items decides.

    Args:
        new: trained on a store that was grown from that of `old`.
        old: the run before.
        rows: newest episodes of the grown store, which neither was trained on.
        seed: of the bootstrap over users.
    """
    known = as_known(rows, old)
    users = rows.episode_values(schema.USER).astype(np.int64)
    differences = [_ranked(new, old, rows, known, users, seed)]
    value = _valued(new, old, rows, known, users, seed)
    if value is not None:
        differences.append(value)
    decisive = differences[-1]
    results: dict[int, Literal["better", "no significant difference", "worse"]] = {
        1: "better", 0: "no significant difference", -1: "worse"
    }  # fmt: skip
    return UpdateVerdict(
        result=results[decisive.sign],
        decided_by=decisive.measure,
        differences=tuple(differences),
        steps=rows.n_steps,
        users=len(np.unique(users)),
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
class _Padded:
    """A ranker that knows the first items of a larger catalogue; others come last."""

    ranker: PolicyRanker
    view: EpisodeStore
    """The ranked episodes as the ranker sees them."""
    n_items: int
    name: str

    def scores(self, steps: Steps) -> Tensor:
        """Scores (B, n_items)."""
        found = self.ranker.scores(Steps(self.view, steps.episodes, steps.steps, steps.users))
        missing = found.new_full((len(found), self.n_items - found.shape[1]), -torch.inf)
        return torch.cat([found, missing], dim=1)


def _ranked(
    new: TrainedPolicy,
    old: TrainedPolicy,
    rows: EpisodeStore,
    known: EpisodeStore,
    users: IntArray,
    seed: int,
) -> Difference:
    """The paired difference in nDCG of liked items."""
    period = Period.of(rows, users)
    assert old.item_ids is not None
    k = min(_K, len(old.item_ids))
    ranked = {
        name: rank_steps(
            _Padded(PolicyRanker(trained, None, name), view, period.n_items, name),
            *(rows, k, period.users),
        )
        for name, trained, view in (("old", old, known), ("new", new, rows))
    }
    value, low, high = compare(period, ranked, k, "old", seed)[1].differences[RANKING]
    if not np.isfinite([value, low, high]).all():
        return Difference(measure=RANKING, value=0, low=0, high=0, doubt="no step was liked")
    return Difference(measure=RANKING, value=value, low=low, high=high)


def _valued(
    new: TrainedPolicy,
    old: TrainedPolicy,
    rows: EpisodeStore,
    known: EpisodeStore,
    users: IntArray,
    seed: int,
) -> Difference | None:
    """The difference in reward per step, by inverse propensities; None without propensities.

    The mean reward is a control variate: weights of both policies have mean 1.
    """
    if schema.PROPENSITY not in rows.record.columns:
        return None
    places = rows.all_steps()
    propensity = rows.step_values(schema.PROPENSITY, *places).astype(np.float64)
    weighed = propensity > 0
    if not weighed.any():
        return None
    weights = np.stack(
        [_probabilities(one, view)[weighed] / propensity[weighed] for one, view in
         ((new, rows), (old, known))], axis=1
    )  # fmt: skip
    reward = rows.step_values(schema.REWARD, *places).astype(np.float64)[weighed]
    user = users[places[0]][weighed]
    lift = (weights[:, 0] - weights[:, 1]) * (reward - reward.mean())
    doubt = _doubt(weights, user)
    (interval,) = cluster_intervals(lift[:, None], np.ones((len(lift), 1)), user, seed)
    if interval is None:
        return Difference(
            measure=VALUE, value=0, low=0, high=0, doubt=doubt or "the users do not differ enough"
        )
    return Difference(
        measure=VALUE, value=lift.mean(), low=interval.low, high=interval.high, doubt=doubt
    )


def _probabilities(trained: TrainedPolicy, view: EpisodeStore) -> Float64Array:
    """(N,) probability of each logged item under the run's rule; 0 of items it does not know."""
    parts = []
    for batch in scored_steps(trained, view):
        chosen = batch.log_probabilities.gather(1, batch.items.clamp(min=0).unsqueeze(1))[:, 0]
        parts.append(torch.where(batch.items < 0, 0.0, chosen.double().exp()).numpy())
    return np.concatenate(parts)


def _doubt(weights: Float64Array, user: IntArray) -> str:
    """Why not to rely on weights (N, 2) of the new and the old run; empty if nothing is found."""
    means, errors = cluster_means(weights, user)
    for name, mean, error in zip(("new", "old"), means, errors, strict=True):
        if not abs(mean - 1) <= _ERRORS * error:
            return (
                f"the mean weight of the {name} run is {mean:.3g} ± {error:.2g} where 1 is "
                "expected: the log lacks its choices, or propensities are wrong"
            )
    effective = weights.sum(axis=0) ** 2 / np.maximum((weights**2).sum(axis=0), 1e-12)
    if effective.min() < _LEAST_STEPS:
        return f"the weights leave {effective.min():.0f} effective steps"
    return ""
