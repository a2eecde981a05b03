"""What a trained policy would have earned on logs: the logs read, modelled, weighed, reported."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.off_policy.estimators import LOGGED, LoggedSteps, as_row, estimate, overlap, warnings
from ucfrec.off_policy.fqe import cross_fitted
from ucfrec.off_policy.score import LoggedSessions, ScoredSteps, scored_steps
from ucfrec.provenance import provenance
from ucfrec.runs.trained_policy import TrainedPolicy

_PRODUCTS = 256

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class OffPolicyReport:
    """Result rows, one an estimator, and why not to believe them."""

    rows: list[dict[str, Any]]
    warnings: list[str]


def judge_off_policy(
    run: Path,
    trained: TrainedPolicy,
    logged: LoggedSessions,
    *,
    target_return: float,
    greedy: bool,
    seed: int,
) -> OffPolicyReport:
    """Estimate the mean return of a session under the policy of `run`, from logs alone.

    Models are fitted on these logs, each session judged by models of others. Takes about 5 kB of
    memory a logged step.

    Args:
        greedy: judge the policy that shows its most probable item; otherwise the one that draws
            items from its softmax.
        seed: draws the folds and the bootstrap's resamples.

    Raises:
        InputError: propensities are no probabilities, or there is only one session.
    """
    steps = logged_steps(trained, logged.store, target_return, greedy, seed)
    found = estimate(steps, seed)
    said = warnings(steps, found)
    dropped = logged.report["dropped"]
    if unknown := dropped["unknown_item"]:
        said.append(
            f"{unknown:,} rows show items that the run does not know, and so never would: their "
            "sessions are judged as if those rows were not there"
        )
    about = {
        "target_return": target_return,
        "sessions": len(steps.first),
        "steps": len(steps.reward),
        "dropped": dropped,
        "overlap": None if steps.unknown_propensities else overlap(steps),
        "warnings": said,
        "run": str(run),
        "fingerprint": logged.store.meta["fingerprint"],
        "seed": seed,
        **provenance(),
    }
    who = {"policy": trained.name, "choice": "greedy" if greedy else "softmax"}
    behavior = {"policy": "behavior", "choice": "as logged"}
    rows = [
        as_row(name, one) | (behavior if name == LOGGED else who) | about
        for name, one in found.items()
    ]
    return OffPolicyReport(rows, said)


def logged_steps(
    trained: TrainedPolicy, store: EpisodeStore, target_return: float, greedy: bool, seed: int
) -> LoggedSteps:
    """The steps of `store` with the policy's probabilities and models of what it would earn."""
    assert trained.item_states is not None
    one_state, one_item = torch.zeros(1, store.state_size), trained.item_states.embeddings[:1]
    width = _features(one_state, one_item).shape[1]
    features, at_policy = np.empty((2, store.n_steps, width), dtype=np.float32)
    target, done = np.empty(store.n_steps), 0
    for batch in scored_steps(trained, store, target_return):
        rows = slice(done, done + len(batch.steps))
        target[rows], features[rows], at_policy[rows] = step_features(trained, batch, greedy)
        done = rows.stop
    episodes, steps = store.all_steps()
    reward = store.step_values(schema.REWARD, episodes, steps).astype(np.float64)
    propensity = np.full(len(reward), np.nan)
    if schema.PROPENSITY in store.meta["columns"]:
        propensity = store.step_values(schema.PROPENSITY, episodes, steps).astype(np.float64)
    # What cannot be weighed is found out before anything is fitted.
    unmodelled = LoggedSteps(episodes, reward, propensity, target)
    return replace(unmodelled, model=cross_fitted(features, at_policy, reward, episodes, seed))


def step_features(
    trained: TrainedPolicy, batch: ScoredSteps, greedy: bool
) -> tuple[npt.NDArray[Any], Float32Array, Float32Array]:
    """What models see of B logged steps.

    Returns:
        The judged policy's probability (B,) of the logged item; features (B, P) of the state and
        the logged item, and the mean of those over the policy's items.
    """
    assert trained.item_states is not None
    embeddings = trained.item_states.embeddings
    states, items = batch.windows.states[:, -1], batch.windows.actions[:, -1]
    if greedy:
        best = batch.log_probabilities.argmax(1)
        target, shown = (best == items).double(), embeddings[best]
    else:
        probabilities = batch.log_probabilities.exp()
        target = probabilities.gather(1, items[:, None])[:, 0].double()
        shown = probabilities @ embeddings
    chosen = _features(states, embeddings[items])
    return target.clamp(0, 1).numpy(), chosen, _features(states, shown)


def _features(states: Tensor, items: Tensor) -> Float32Array:
    """(B, P) of states and item embeddings (B, D), linear in the latter: 1, both, and products.

    The three embeddings that lead a state (`ucfrec.episodes.states.ItemStates`) are multiplied with
    the item's own; the rest (user, observation) with as many of its first dimensions as `_PRODUCTS`
    allows.
    """
    dim = items.shape[1]
    led_by, rest = states[:, : 3 * dim], states[:, 3 * dim :]
    leading = items[:, : _PRODUCTS // rest.shape[1]]
    products = rest.unsqueeze(2) * leading.unsqueeze(1)
    ones = torch.ones(len(states), 1)
    parts = [ones, states, items, led_by * items.repeat(1, 3), products.flatten(1)]
    return np.asarray(torch.cat(parts, dim=1))
