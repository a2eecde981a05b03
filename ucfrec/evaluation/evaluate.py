"""Evaluate policies in simulated environments: returns of sessions, and coverage, diversity and
novelty of the items recommended (EasyRL4Rec)."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import Actor, Episodes, Step, rollout
from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.states import TrainingCounts
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import COLUMNS, Catalog, Environment, environment_items
from ucfrec.processes import random_state_kept
from ucfrec.provenance import config_hash, provenance
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import bootstrap_interval
from ucfrec.runs.trained_policy import TrainedPolicy

SUITE = "evaluate"
"""Suite of the rows."""
SIDE_BY_SIDE = 512
"""Largest number of episodes simulated in parallel."""
TAGS = "tags"
"""Catalogue column with the list of each item's tags."""
ONE_HOT = "tag_"
"""Prefix of catalogue columns, one per tag, that are above 0 for items with the tag."""
Recommended = Sequence[tuple[IntArray, IntArray]]
"""Episode and item of every live episode, step by step."""


@random_state_kept()
def evaluate_behavior(
    environment: Environment,
    behavior: str,
    episodes: int,
    seed: int,
) -> ResultRow:
    """Result row of an environment's built-in policy (`random`, `optimal`, …); InputError if it has
    none of that name. The seed is that of the environments and of the policy."""
    env, actor = environment.start(min(episodes, SIDE_BY_SIDE), behavior, seed)
    name = {"method": behavior, "policy": behavior}
    return _row(environment, name, env, actor, episodes, seed)


@random_state_kept()
def evaluate_policy(
    environment: Environment,
    trained: TrainedPolicy,
    name: str,
    episodes: int,
    seed: int,
    rule: DecisionRule | None = None,
) -> ResultRow:
    """Result row of a trained policy, under that name; InputError if its actions or observations do
    not fit this environment. `seed` is of the draws, and environment i is seeded with `seed` + i;
    without a rule, the run's own decides."""
    env = environment.simulator().make(min(episodes, SIDE_BY_SIDE), environment.folder)
    numbers, rule = _item_numbers(environment, env, trained), rule or trained.rule
    actor = trained.actor(env.num_envs, rule, numbers, seed)
    record = trained.record
    columns = {
        "method": name,
        "policy": record.config.policy_name,
        "training_seed": record.seed,
        "config_hash": config_hash(record.settings),
        "data_fingerprint": record.fingerprint,
        "target_return": rule.target,
        "rule": rule.hash,
        "details": {"decision_rule": rule.as_dict()},
    }
    return _row(environment, columns, env, actor, episodes, seed, trained.counts, numbers)


def _row(
    environment: Environment,
    columns: dict[str, Any],
    env: Any,
    actor: Actor,
    episodes: int,
    seed: int,
    counts: TrainingCounts | None = None,
    numbers: IntArray | None = None,
) -> ResultRow:
    start = time.perf_counter()
    recommended: list[tuple[IntArray, IntArray]] = []

    def note(step: Step) -> None:
        recommended.append((step.episodes, step.actions))

    describe = f"{columns['method']} in {environment.name}"
    played = rollout(env, actor, episodes, seed, note, describe)
    seconds = time.perf_counter() - start
    variety: Mapping[str, float | None] = {}
    if isinstance(env.single_action_space, spaces.Discrete):
        variety = variety_columns(env, recommended, counts, numbers)
    env.close()
    row = ResultRow(
        suite=SUITE,
        table=SUITE,
        task=environment.title,
        environment=environment.title,
        evaluation_seed=seed,
        conditions={"episodes": episodes},
        metric="R_cum",
        metrics={},
        interval=bootstrap_interval(played.returns, seed),
        wall_time_s=seconds,
        **columns,
        **provenance(),
    )
    return row.extended({**session_metrics(played), **variety})


def _item_numbers(environment: Environment, env: Any, trained: TrainedPolicy) -> IntArray | None:
    """The environment's index of each of the policy's items, −1 for none; None for vectors."""
    space, sizes = env.single_action_space, trained.record.sizes
    provided = int(np.prod(env.single_observation_space.shape))
    expected = trained.logged_observation_size
    if expected > provided:
        raise InputError(
            f"the policy observes {expected} numbers, {environment.title} shows {provided}; "
            f"train it on logs of {environment.name}, collected with the same --observe"
        )
    numbers, ids = None, trained.item_ids
    if isinstance(space, spaces.Discrete):
        names = environment_items(env)
        takes = f"items {names.min()} to {names.max()} as {schema.ITEM_ID}"
        if ids is not None and ids.dtype.kind in "iu":
            numbers = IdLookup(names).numbers(ids)
        fits = numbers is not None and bool((numbers >= 0).any())
    else:
        takes = f"vector actions of size {space.shape}"
        fits = not sizes["items"] and space.shape == (sizes["action"],)
    if not fits:
        raise InputError(
            f"{environment.name} takes {takes}, which the policy was not trained on; train it on "
            f"logs of {environment.name}"
        )
    return numbers


def session_metrics(played: Episodes) -> dict[str, float]:
    """Metrics of simulated episodes, in reward units: `R_cum`, the mean return (R_tra in some
    papers), `R_avg_pooled`, all rewards by all steps (R_each in some), `R_avg_episode`, the mean of
    episodes' mean rewards per step, and `length`, the mean number of steps.
    """
    returns, lengths = played.returns, played.lengths
    return {
        "R_cum": float(returns.mean()),
        "R_avg_pooled": float(returns.sum() / lengths.sum()),
        "R_avg_episode": float((returns / lengths).mean()),
        "length": float(lengths.mean()),
    }


def diversity(episodes: IntArray, items: IntArray, incidence: BoolArray) -> float:
    """Mean over episodes of the mean over pairs of steps of 1 − Jaccard similarity of their items'
    tags, 0 for equal items; 1 for a single step.

    `episodes` (M,) are sorted indices, `items` (M,) the items of these steps; M is at least 1.
    """
    starts, means = np.unique(episodes, return_index=True)[1], []
    for session_items in np.split(items, starts[1:]):
        first, second = (session_items[places] for places in np.triu_indices(len(session_items), 1))
        shared = (incidence[first] & incidence[second]).sum(axis=1)
        either = (incidence[first] | incidence[second]).sum(axis=1)
        distances = np.where(first == second, 0.0, 1 - shared / np.maximum(either, 1))
        means.append(distances.mean() if len(distances) else 1.0)
    return float(np.mean(means))


def variety_columns(
    env: VectorEnv[Any, Any, Any],
    recommended: Recommended,
    counts: TrainingCounts | None = None,
    numbers: IntArray | None = None,
) -> dict[str, float | None]:
    """The `COLUMNS`; a metric whose inputs are missing is None.

    Diversity (tag Jaccard) needs a catalogue with tags; novelty needs `counts` and `numbers`, which
    built-in policies do not have: the environment's index of each item of the log, −1 for none.
    """
    sessions = np.hstack(recommended)
    episodes, items = sessions[:, np.argsort(sessions[0], kind="stable")]
    n_items, distinct = len(environment_items(env)), len(np.unique(items))
    row: dict[str, float | None] = dict.fromkeys(COLUMNS)
    row["coverage"] = distinct / n_items
    row["coverage_per_turn"] = distinct / len(items)
    incidence = _read_incidence(env)
    if incidence is not None:
        row["diversity"] = diversity(episodes, items, incidence)
    if counts is None or numbers is None:
        return row
    in_catalogue = numbers >= 0
    impressions = np.bincount(numbers[in_catalogue], counts.shown.numpy()[in_catalogue], n_items)
    if impressions.any():
        # In nats; an item that was never shown counts as the rarest.
        popularity = impressions / counts.episodes
        popularity = np.maximum(popularity, popularity[popularity > 0].min())
        row["novelty"] = float(-np.log(popularity[items]).mean())
    return row


def _read_incidence(env: VectorEnv[Any, Any, Any]) -> BoolArray | None:
    """Tags (n_items, n_tags) of the environment's catalogue; None if it has no tags."""
    environment = env.unwrapped
    table = environment.item_features() if isinstance(environment, Catalog) else pa.table({})
    hot = [name for name in table.column_names if name.startswith(ONE_HOT)]
    if hot:
        return np.stack([np.asarray(table[name]) > 0 for name in hot], axis=1)
    if TAGS not in table.column_names:
        return None
    column = table[TAGS].combine_chunks()
    tag_ids, places = np.unique(np.asarray(column.flatten()), return_inverse=True)
    incidence = np.zeros((len(column), len(tag_ids)), dtype=np.bool_)
    items = np.repeat(np.arange(len(column)), np.diff(np.asarray(column.offsets)))
    incidence[items, places] = True
    return incidence
