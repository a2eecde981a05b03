"""New rows as a run sees them, and how much they differ from those that it was trained on."""

from typing import Any, Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.reward_report import RewardRows, calibration, fit_line, score_rows

_GROUPS: Final = 10
_PRIOR: Final = 0.5
"""Added to every count, so that no group is empty."""
_MOST_STEPS: Final = 100_000
LARGE: Final = 0.25
"""Population stability index from which on a distribution counts as another one; below 0.1 it
counts as the same (Siddiqi, Credit Risk Scorecards, 2006)."""


def stability_index(old: Array, new: Array) -> float:
    """Population stability index of counts (G,) in the same groups: Σ (q − p) ln(q / p).

    Example: shares of 50% and 50% that become 60% and 40% have 0.041.
    """
    p, q = ((counts + _PRIOR) / (counts + _PRIOR).sum() for counts in (old, new))
    return float(((q - p) * np.log(q / p)).sum())


def popularity_index(old: Array, new: Array) -> float:
    """`stability_index` of items in groups of about equal old popularity.

    Args:
        old: (n_items,) training steps that showed each item.
        new: (n_items,) of the new rows.
    """
    order = np.argsort(-old, kind="stable")
    more_popular = np.cumsum(old[order]) - old[order]
    group = np.minimum(_GROUPS * more_popular // max(old.sum(), 1), _GROUPS - 1).astype(np.int64)
    return stability_index(
        np.bincount(group, old[order], _GROUPS), np.bincount(group, new[order], _GROUPS)
    )


def reward_index(old: Float64Array, new: Float64Array) -> float:
    """`stability_index` of rewards in groups between deciles of the old ones."""
    edges = np.unique(np.quantile(old, np.linspace(0, 1, _GROUPS + 1)[1:-1], method="lower"))
    old_counts, new_counts = (
        np.bincount(np.searchsorted(edges, rewards, side="left"), minlength=len(edges) + 1)
        for rewards in (old, new)
    )
    return stability_index(old_counts, new_counts)


def measure_drift(
    old: TrainedPolicy,
    training: EpisodeStore,
    added: EpisodeStore,
    counts: dict[str, Any],
    seed: int,
) -> dict[str, Any]:
    """What is different in new rows.

    Args:
        training: the run's training episodes.
        added: the new episodes of the grown store.
        counts: of `ucfrec.logs.append.append_logs`.
        seed: of the rows that are drawn from many.

    Returns:
        `unknown_items`, `unknown_users`: share of the new rows. `item_popularity`, `rewards`:
        population stability indices, the first of known items. `predicted`, `observed`,
        `calibration_error`, `slope`: of the run's reward model on new rows of known items, absent
        without a reward model.
    """
    episodes = np.random.default_rng(seed).permutation(added.n_episodes)
    last = int(np.searchsorted(np.cumsum(added.lengths[episodes]), _MOST_STEPS))
    sample = restrict_to_run(added.select(np.sort(episodes[: last + 1])), old)
    items = sample.column(schema.ITEM)
    assert old.counts is not None
    times_shown = old.counts.shown.numpy()
    times_shown_now = np.bincount(items[items >= 0], None, len(times_shown))
    rows = np.sort(np.random.default_rng(seed).integers(training.n_steps, size=_MOST_STEPS))
    where, steps = training.locate(rows), max(counts["steps"], 1)
    rewards = training.step_values(schema.REWARD, *where).astype(np.float64)
    measures = {
        "unknown_items": counts["new_item_steps"] / steps,
        "unknown_users": counts["new_user_steps"] / steps,
        "item_popularity": popularity_index(times_shown, times_shown_now),
        "rewards": reward_index(rewards, sample.column(schema.REWARD).astype(np.float64)),
    }
    model = old.reward_model
    if model is None:
        return measures
    reward_rows = RewardRows.of(sample, model.reach, _MOST_STEPS, seed)
    keep = (reward_rows.items >= 0).nonzero()[:, 0]
    if not len(keep):
        return measures
    reward_rows = RewardRows(
        reward_rows.items[keep],
        reward_rows.users[keep],
        reward_rows.history.at(keep),
        reward_rows.states[keep],
        reward_rows.rewards[keep],
        reward_rows.observations,
    )
    scores = score_rows(model, reward_rows)[0]
    predicted, observed = (
        model.expect(scores).double().numpy(),
        reward_rows.rewards.double().numpy(),
    )
    slope, _ = fit_line(scores, model.target(reward_rows.rewards), bool(model.binary))
    return measures | {
        "predicted": float(predicted.mean()),
        "observed": float(observed.mean()),
        "calibration_error": calibration(predicted, observed).error,
        "slope": slope,
    }


def describe(drift: dict[str, Any]) -> str:
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
    """The episodes of a view, in memory, with the item states of a run.

    Args:
        view: of a store that was grown from the run's.
        trained: the run; users and items that it does not know become −1.
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
