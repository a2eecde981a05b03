"""Roll out episodes with one actor in many environments in parallel."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.progress import progress
from ucfrec.schema import FORBIDDEN, USER_IDS

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


class Actor(Protocol):
    """Chooses actions for N episodes at once: a trained policy or a built-in rule."""

    def begin(self, rows: IntArray) -> None:
        """Start a new episode in each of `rows`, (M,) environment indices from 0 to N − 1."""

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Choose one action per environment.

        Args:
            observations: (N, O).
            live: (N,) true where the action is used; actions of the other rows are ignored.

        Returns:
            The actions, (N, A) float32 vectors or (N,) int64 items, and their propensities (N,):
            the probability of each item, or the probability density of each vector, which may
            exceed 1. Propensities are None if they are unknown or undefined.
        """

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Record the actions just taken, (N, A) or (N,), and their rewards (N,)."""


@runtime_checkable
class Informed(Protocol):
    """An actor that also uses the environment's `info`."""

    def inform(self, info: Mapping[str, Any]) -> None:
        """Record `info` (keys `USER_IDS` and `FORBIDDEN`); called before each `act`."""


@dataclass(frozen=True)
class Step:
    """One step of M episodes; row i of every array belongs to the same episode."""

    rows: IntArray
    """(M,) environment indices, 0 to N − 1."""
    episodes: IntArray
    """(M,) episode indices, 0 to episodes − 1."""
    observations: Float32Array
    """(M, O) observations before the actions."""
    actions: Array
    """(M, A) vectors or (M,) items."""
    rewards: Float32Array
    """(M,)."""
    next_observations: Float32Array
    """(M, O) observations after the actions; the final observation where the episode ended."""
    propensities: Float32Array | None
    """(M,) see `Actor.act`."""
    terminated: BoolArray
    """(M,)."""
    truncated: BoolArray
    """(M,)."""
    user_ids: IntArray | None
    """(M,) users of the step; None if the environment does not report them (`USER_IDS`)."""

    def select(self, rows: IntArray) -> "Step":
        """The step with only `rows` (L,), indices into the M rows."""
        columns: dict[str, Any] = {
            name: None if column is None else column[rows] for name, column in vars(self).items()
        }
        return Step(**columns)


@dataclass(frozen=True)
class Episodes:
    """Outcome of every episode."""

    returns: Float64Array
    """(episodes,) sums of rewards, in reward units."""
    lengths: IntArray
    """(episodes,) numbers of steps."""


def rollout(
    env: "VectorEnv[Any, Any, Any]",
    actor: Actor,
    episodes: int,
    seed: int,
    on_step: Callable[[Step], None] | None = None,
    describe: str = "rollout",
) -> Episodes:
    """Roll out exactly `episodes` episodes.

    Environment i of N simulates episodes i, i + N, i + 2N, …: with a fixed assignment, short
    episodes are not over-represented.

    Args:
        env: N environments, reset within the step (`AutoresetMode.SAME_STEP`).
        seed: environment i is seeded with `seed` + i.
        on_step: called after each step with the rows that belong to one of the `episodes`.

    Raises:
        InputError: the environment does not reset within the step, or forbids actions (`FORBIDDEN`)
            and the actor has no `inform`.
    """
    _require_same_step_reset(env)
    n = env.num_envs
    returns = np.zeros(episodes, dtype=np.float64)
    lengths = np.zeros(episodes, dtype=np.int64)
    observations, info = env.reset(seed=seed)
    _require_informed(env, info, actor)
    actor.begin(np.arange(n))
    episode = np.arange(n)
    live = episode < episodes
    with progress(episodes, describe, "episodes") as bar:
        while live.any():
            step, next_observations, next_info = _play_step(
                env, actor, observations, info, episode, live
            )
            counted = step.select(np.flatnonzero(live))
            returns[counted.episodes] += counted.rewards
            lengths[counted.episodes] += 1
            if on_step is not None:
                on_step(counted)
            ended = step.terminated | step.truncated
            actor.begin(np.flatnonzero(ended))
            bar.update(int((ended & live).sum()))
            episode = np.where(ended, episode + n, episode)
            live = episode < episodes
            observations, info = next_observations, next_info
    return Episodes(returns, lengths)


def _play_step(
    env: "VectorEnv[Any, Any, Any]",
    actor: Actor,
    observations: Float32Array,
    info: Mapping[str, Any],
    episode: IntArray,
    live: BoolArray,
) -> tuple[Step, Float32Array, dict[str, Any]]:
    """One step of all N environments, and the observations and `info` of the next one.

    `episode` (N,) is the index of each environment's episode.
    """
    if isinstance(actor, Informed):
        actor.inform(info)
    actions, propensities = actor.act(observations, live)
    next_observations, rewards, terminated, truncated, next_info = env.step(actions)
    rewards = np.asarray(rewards, dtype=np.float32)
    actor.observe(actions, rewards)
    step = Step(
        rows=np.arange(env.num_envs),
        episodes=episode,
        observations=observations,
        actions=actions,
        rewards=rewards,
        next_observations=_before_reset(next_observations, next_info),
        propensities=propensities,
        terminated=terminated,
        truncated=truncated,
        user_ids=info.get(USER_IDS),
    )
    return step, next_observations, next_info


def _require_same_step_reset(env: "VectorEnv[Any, Any, Any]") -> None:
    # Imported here because scoring logs and recommending run without gymnasium.
    from gymnasium.vector import AutoresetMode

    if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise InputError(
            f"{type(env).__name__} does not reset in the same step; build it with "
            "autoreset_mode=AutoresetMode.SAME_STEP"
        )


def _require_informed(
    env: "VectorEnv[Any, Any, Any]", info: Mapping[str, Any], actor: Actor
) -> None:
    if FORBIDDEN in info and not isinstance(actor, Informed):
        raise InputError(
            f"{type(env).__name__} forbids some actions, which {type(actor).__name__} ignores; "
            "give it a method `inform`"
        )


def _before_reset(next_observations: Float32Array, info: Mapping[str, Any]) -> Float32Array:
    """Observations (N, O) after a step; of episodes that ended, the final one, not the reset's."""
    if "final_obs" not in info:
        return next_observations
    before_reset, ended = next_observations.copy(), np.asarray(info["_final_obs"])
    before_reset[ended] = np.stack(list(info["final_obs"][ended]))
    return before_reset
