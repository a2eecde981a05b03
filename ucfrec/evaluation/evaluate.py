"""Evaluate policies in simulated environments."""

import time
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import Actor, Episodes, rollout
from ucfrec.arrays import IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.states import TrainingCounts
from ucfrec.errors import InputError
from ucfrec.evaluation.collect import environment_items
from ucfrec.evaluation.diversity import Recommended, variety_columns
from ucfrec.evaluation.simulator import Environment
from ucfrec.processes import random_state_kept
from ucfrec.provenance import config_hash, provenance
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import bootstrap_interval
from ucfrec.runs.trained_policy import TrainedPolicy

SUITE: Final = "evaluate"
"""Suite of the rows."""
SIDE_BY_SIDE = 512
"""Largest number of episodes simulated in parallel."""


@random_state_kept()
def evaluate_behavior(
    environment: Environment, behavior: str, episodes: int, seed: int
) -> ResultRow:
    """Result row of an environment's built-in policy (`random`, `optimal`, …).

    Args:
        seed: seed of the environments and of the policy.

    Raises:
        InputError: the environment has no policy of that name.
    """
    simulator = environment.simulator()
    if behavior not in simulator.behaviors:
        names = ", ".join(simulator.behaviors)
        raise InputError(f"{environment.name} has no behavior {behavior!r}; it has {names}")
    env = simulator.started(min(episodes, SIDE_BY_SIDE), environment.folder)
    actor = simulator.behaviors[behavior](env, seed)
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
    """Result row of a trained policy.

    Args:
        name: name of the policy in the row.
        seed: environment i is seeded with `seed` + i; also of the draws of the rule.
        rule: the decision rule; None for the run's own.

    Raises:
        InputError: the policy's actions or observations do not fit this environment.
    """
    env = environment.simulator().started(min(episodes, SIDE_BY_SIDE), environment.folder)
    numbers = _item_numbers(environment, env, trained)
    rule = rule or trained.rule
    actor = trained.actor(env.num_envs, rule, numbers, seed)
    record = trained.record
    about = {
        "method": name,
        "policy": record.config.policy_name,
        "training_seed": record.seed,
        "config_hash": config_hash(record.settings),
        "data_fingerprint": record.fingerprint,
        "target_return": rule.target,
        "rule": rule.hash,
        "details": {"decision_rule": rule.as_dict()},
    }
    return _row(environment, about, env, actor, episodes, seed, trained.counts, numbers)


def _row(
    environment: Environment,
    about: dict[str, Any],
    env: Any,
    actor: Actor,
    episodes: int,
    seed: int,
    counts: TrainingCounts | None = None,
    numbers: IntArray | None = None,
) -> ResultRow:
    start = time.perf_counter()
    recommended, describe = Recommended(), f"{about['method']} in {environment.name}"
    played = rollout(env, actor, episodes, seed, recommended.record, describe)
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
        **about,
        **provenance(),
    )
    return row.extended({**session_metrics(played), **variety})


def _item_numbers(environment: Environment, env: Any, trained: TrainedPolicy) -> IntArray | None:
    """The environment's index of each item of the policy, −1 for items it lacks; None for
    vectors."""
    space, sizes = env.single_action_space, trained.record.sizes
    provided = int(np.prod(env.single_observation_space.shape))
    expected = trained.logged_observation_size
    if expected > provided:
        raise InputError(
            f"the policy observes {expected} numbers, {environment.title} shows {provided}; "
            f"train it on logs of {environment.name}, collected with the same --observe"
        )
    if not isinstance(space, spaces.Discrete):
        if sizes["items"] or space.shape != (sizes["action"],):
            raise _misfit(environment, f"vector actions of size {space.shape}")
        return None
    names = environment_items(env)
    ids = trained.item_ids
    if ids is None or ids.dtype.kind not in "iu":
        raise _misfit(environment, f"{len(names)} items with whole numbers as {schema.ITEM_ID}")
    numbers = IdLookup(names).numbers(ids)
    if (numbers < 0).all():
        raise _misfit(environment, f"items {names.min()} to {names.max()} as {schema.ITEM_ID}")
    return numbers


def _misfit(environment: Environment, takes: str) -> InputError:
    return InputError(
        f"{environment.name} takes {takes}, which the policy was not trained on; train it on "
        f"logs of {environment.name}"
    )


def session_metrics(played: Episodes) -> dict[str, float]:
    """Metrics of simulated episodes; rewards and returns in reward units.

    Returns:
        `R_cum`: mean episode return (called R_tra in some papers). `R_avg_pooled`: sum of all
        rewards divided by the number of all steps (called R_each in some papers). `R_avg_episode`:
        mean over episodes of the episode's mean reward per step. `length`: mean number of steps of
        an episode.
    """
    returns, lengths = played.returns, played.lengths
    return {
        "R_cum": float(returns.mean()),
        "R_avg_pooled": float(returns.sum() / lengths.sum()),
        "R_avg_episode": float((returns / lengths).mean()),
        "length": float(lengths.mean()),
    }
