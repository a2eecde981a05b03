"""Estimates from logs what a trained policy would have earned, and reports how reliable that is."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.off_policy.diagnostics import Diagnosis, diagnose
from ucfrec.off_policy.estimators import LOGGED, Estimate, estimate
from ucfrec.off_policy.fqe import cross_fitted
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.pages import as_pages
from ucfrec.off_policy.score import LoggedSessions, ScoredSteps, scored_steps
from ucfrec.off_policy.training_rows import MOST_SEEN, share_seen
from ucfrec.off_policy.verdict import Verdict, cautions, judge
from ucfrec.provenance import provenance
from ucfrec.runs.trained_policy import TrainedPolicy

_PRODUCTS = 256

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class OffPolicyReport:
    """The estimates, and whether to believe them."""

    rows: list[dict[str, Any]]
    """One result row for each estimator."""
    warnings: list[str]
    """The verdict's reasons, cautions, and remarks on the logs."""
    verdict: Verdict


def evaluate_off_policy(
    run: Path,
    trained: TrainedPolicy,
    logged: LoggedSessions,
    *,
    target_return: float,
    greedy: bool,
    seed: int,
    discount: float = 1.0,
    pages: bool = False,
) -> OffPolicyReport:
    """Estimate the mean return of a session under the policy of `run`, from logs alone.

    Models of future reward are fitted on these logs; each user's sessions are predicted by models
    fitted on other users. Needs about 5 kB of memory per logged step.

    Args:
        run: folder of the run, named in the rows.
        trained: the policy of the run.
        logged: logs read with `keep_unknown`. The policy would never show an item that it does not
            know, so such a step has weight 0.
        target_return: the return that the policy is asked for, in units of the reward.
        greedy: judge the policy that shows its most probable item; otherwise the one that draws
            items from its softmax.
        seed: seed of the folds and of the bootstrap.
        discount: discount factor γ of the estimated returns.
        pages: estimate the return of a page instead: sessions of one step, of one user and time,
            are the positions of a page (`ucfrec.off_policy.pages`).

    Returns:
        The estimates, the warnings and the verdict.

    Raises:
        InputError: propensities are not probabilities, there is only one user, or `pages` is set
            and a session has several steps.
    """
    steps = logged_steps(trained, logged, target_return, greedy, seed, discount)
    if pages:
        steps = as_pages(steps, _pages(logged))
    found, diagnosis = estimate(steps, seed), diagnose(steps)
    seen = share_seen(trained, logged.store)
    verdict = judge(steps, seed, diagnosis=diagnosis, forbidden=_seen_too_often(seen))
    said = [*verdict.reasons, *cautions(diagnosis, found), *_of_the_logs(seen, logged)]
    about = {
        "target_return": target_return,
        "discount": discount,
        "sessions": len(steps.first),
        "pages": pages,
        "steps": len(steps.reward),
        "dropped": logged.report["dropped"],
        "unknown_item_rows": logged.unknown_items,
        "seen_in_training": seen,
        "warnings": said,
        **_verdict_columns(verdict),
        **_diagnosis_columns(diagnosis),
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
    return OffPolicyReport(rows, said, verdict)


def _pages(logged: LoggedSessions) -> npt.NDArray[np.int64]:
    """(N,) number of the page of each step: of one user and millisecond."""
    episodes, steps = logged.store.all_steps()
    users = np.unique(logged.users, return_inverse=True)[1][episodes]
    times = logged.store.step_values(schema.TIMESTAMP, episodes, steps).astype(np.int64)
    return np.asarray(np.unique(np.stack([users, times]), axis=1, return_inverse=True)[1]).ravel()


def _seen_too_often(seen: float | None) -> list[str]:
    if seen is None or seen <= MOST_SEEN:
        return []
    return [
        f"{seen:.0%} of the rows were seen in training: on these a policy looks "
        "better than it is; give later logs"
    ]


def _of_the_logs(seen: float | None, logged: LoggedSessions) -> list[str]:
    said = []
    if seen is None:
        said.append(
            "the store that the run was trained on is not there any more: whether these logs were "
            "seen in training is not known"
        )
    if unknown := logged.unknown_items:
        said.append(
            f"{unknown:,} rows show items that the run does not know, and so never would: they "
            "weigh 0"
        )
    return said


def as_row(name: str, found: Estimate) -> dict[str, Any]:
    """Turn an estimate into a result row.

    Args:
        name: name of the estimator.
        found: its estimate.

    Returns:
        The row. `R_cum` is the mean return, as in `ucfrec.evaluation.metrics`; the ends of its
        interval are None if there is no interval.
    """
    return {
        "estimator": name,
        "R_cum": found.value,
        "R_cum_low": found.low,
        "R_cum_high": found.high,
        "R_cum_error": found.error,
        "effective_sessions": found.effective_sessions,
        "largest_weight": found.largest_weight,
        "parameter": found.parameter if found.parameter != math.inf else None,
    }


def _verdict_columns(verdict: Verdict) -> dict[str, Any]:
    columns = asdict(verdict) | {"verdict": str(verdict), "verdict_of": verdict.estimator}
    return {name: value for name, value in columns.items() if name not in ("estimator", "reasons")}


def _diagnosis_columns(diagnosis: Diagnosis) -> dict[str, Any]:
    return {
        "overlap": diagnosis.overlap,
        "users": diagnosis.users,
        "sessions_without_propensity": diagnosis.left_out,
        "effective_users": diagnosis.effective_users,
        "effective_by_step": list(diagnosis.effective_by_step),
        "stops_telling_at": diagnosis.stops_telling_at,
        "weight_tests": [asdict(test) for test in diagnosis.tests],
        "mean_weight": diagnosis.mean_weight,
        "pareto_tail": diagnosis.tail,
        "bounds": None if diagnosis.bounds is None else list(diagnosis.bounds),
    }


def logged_steps(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    target_return: float,
    greedy: bool,
    seed: int,
    discount: float = 1.0,
) -> LoggedSteps:
    """Collect the logged steps, the policy's probabilities and models of what it would earn.

    Args:
        trained: a policy that chooses items.
        logged: logs read with `keep_unknown`.
        target_return: the return that the policy is asked for, in units of the reward.
        greedy: judge the policy that shows its most probable item, instead of drawing items.
        seed: seed of the folds.
        discount: discount factor γ of the returns.

    Returns:
        The N logged steps, in order.

    Raises:
        InputError: propensities are not probabilities, or there is only one user.
    """
    store = logged.store
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
    user = np.unique(logged.users, return_inverse=True)[1]
    # This checks the propensities before the slow fitting starts.
    unmodelled = LoggedSteps(episodes, reward, propensity, target, user=user, discount=discount)
    model = cross_fitted(features, at_policy, reward, episodes, seed, user, discount)
    return replace(unmodelled, model=model)


def step_features(
    trained: TrainedPolicy, batch: ScoredSteps, greedy: bool
) -> tuple[npt.NDArray[Any], Float32Array, Float32Array]:
    """Compute the policy's probability and the models' inputs for B logged steps.

    An item that the run does not know (−1) has probability 0 and an embedding of zeros.

    Args:
        trained: a policy that chooses items.
        batch: the steps, scored by the policy.
        greedy: judge the policy that shows its most probable item, instead of drawing items.

    Returns:
        The evaluated policy's probability (B,) of the logged item; features (B, P) of the state and
        the logged item; and the mean (B, P) of such features over the items that the policy shows.
    """
    assert trained.item_states is not None
    embeddings = trained.item_states.embeddings
    states, items = batch.windows.states[:, -1], batch.windows.actions[:, -1]
    known = items >= 0
    if greedy:
        best = batch.log_probabilities.argmax(1)
        target, shown = (best == items).double(), embeddings[best]
    else:
        probabilities = batch.log_probabilities.exp()
        target = probabilities.gather(1, items[:, None].clamp(min=0))[:, 0].double() * known
        shown = probabilities @ embeddings
    chosen = _features(states, embeddings[items] * known[:, None])
    return target.clamp(0, 1).numpy(), chosen, _features(states, shown)


def _features(states: Tensor, items: Tensor) -> Float32Array:
    """Features (B, P) of states (B, S) and item embeddings (B, D), linear in the embeddings.

    They are a constant 1, the states, the embeddings, and products of the two.

    The three embeddings at the start of a state (`ucfrec.episodes.states.ItemStates`) are
    multiplied with the item's own, dimension by dimension. The rest (user, observation) is
    multiplied with as many of the item's first dimensions as `_PRODUCTS` allows.
    """
    dim = items.shape[1]
    led_by, rest = states[:, : 3 * dim], states[:, 3 * dim :]
    leading = items[:, : _PRODUCTS // rest.shape[1]]
    products = rest.unsqueeze(2) * leading.unsqueeze(1)
    ones = torch.ones(len(states), 1)
    parts = [ones, states, items, led_by * items.repeat(1, 3), products.flatten(1)]
    return np.asarray(torch.cat(parts, dim=1))
