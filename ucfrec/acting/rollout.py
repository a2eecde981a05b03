"""Roll out episodes with one actor in many environments in parallel; uniformly random actors."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.processes import progress
from ucfrec.schema import FORBIDDEN, USER_IDS


class Actor(Protocol):
    """Chooses actions for N episodes at once: a trained policy or a built-in rule."""

    def begin(self, rows: IntArray) -> None:
        """Start a new episode in each of `rows`, (M,) environment indices from 0 to N − 1."""

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Choose one action per environment from observations (N, O); those of rows that are not
        `live` (N,) are ignored. Returns (N, A) float32 vectors or (N,) int64 items, and their
        propensities (N,): the probability of each item, or the density of each vector, which may
        exceed 1; None if they are unknown or undefined."""

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Record the actions just taken, (N, A) or (N,), and their rewards (N,)."""


@runtime_checkable
class Informed(Protocol):
    """An actor that also uses the environment's `info`."""

    def inform(self, info: Mapping[str, Any]) -> None:
        """Record `info` (keys `USER_IDS` and `FORBIDDEN`); called before each `act`."""


class Memoryless:
    """An actor whose choice depends on the current observation only."""

    def begin(self, rows: IntArray) -> None:
        """Do nothing: there is no state to reset."""

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Do nothing: there is no state to update."""


class Uniform(Memoryless):
    """Uniformly random actions: vectors in a box, or items of a catalogue with their propensity.
    InputError if the actions are vectors without finite bounds."""

    def __init__(self, env: VectorEnv[Any, Any, Any], seed: int) -> None:
        self._space = env.single_action_space
        if isinstance(self._space, spaces.Box) and not self._space.is_bounded():
            raise InputError(
                "no vectors can be drawn uniformly, because the environment's actions have no "
                "finite bounds; collect its logs with another policy, or bound its action space"
            )
        self._generator = np.random.default_rng([seed, 1])
        self._forbidden: IntArray | None = None

    def inform(self, info: Mapping[str, Any]) -> None:
        """Read the (N, L) forbidden items of sessions from `info`, if the environment masks any."""
        self._forbidden = info.get(FORBIDDEN)

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Draw actions: (N, A) without propensities, or items (N,) with propensities (N,)."""
        if isinstance(self._space, spaces.Box):
            low, high = self._space.low, self._space.high
            vectors = self._generator.uniform(low, high, size=(len(observations), *low.shape))
            return vectors.astype(np.float32), None
        assert isinstance(self._space, spaces.Discrete)
        n_items = int(self._space.n)
        forbidden = self._forbidden
        if forbidden is None:
            chosen = self._generator.integers(n_items, size=len(observations))
            return chosen, np.full(len(observations), 1.0 / n_items, dtype=np.float32)
        # A rank among the allowed items is drawn, then raised by one per forbidden item up to it;
        # lists of forbidden items are padded with −1.
        n_allowed = n_items - (forbidden >= 0).sum(axis=1)
        chosen = self._generator.integers(n_allowed)
        for item in np.sort(np.where(forbidden < 0, n_items, forbidden), axis=1).T:
            chosen += chosen >= item
        return chosen, (1.0 / n_allowed).astype(np.float32)


class Step(NamedTuple):
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


class Episodes(NamedTuple):
    """Outcome of every episode."""

    returns: Float64Array
    """(episodes,) sums of rewards, in reward units."""
    lengths: IntArray
    """(episodes,) numbers of steps."""


def rollout(
    env: VectorEnv[Any, Any, Any],
    actor: Actor,
    episodes: int,
    seed: int,
    on_step: Callable[[Step], None] | None = None,
    describe: str = "rollout",
) -> Episodes:
    """Roll out exactly `episodes` episodes.

    Environment i of N simulates episodes i, i + N, i + 2N, …: with a fixed assignment, short
    episodes are not over-represented. InputError if the environment does not reset within the step,
    or forbids actions (`FORBIDDEN`) and the actor has no `inform`.

    Args:
        env: N environments, reset within the step (`AutoresetMode.SAME_STEP`).
        seed: environment i is seeded with `seed` + i.
        on_step: called after each step with the rows that belong to one of the `episodes`.
    """
    if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise InputError(
            f"{type(env).__name__} does not reset in the same step; build it with "
            "autoreset_mode=AutoresetMode.SAME_STEP"
        )
    observations, info = env.reset(seed=seed)
    informed = actor if isinstance(actor, Informed) else None
    if FORBIDDEN in info and informed is None:
        raise InputError(
            f"{type(env).__name__} forbids some actions, which {type(actor).__name__} ignores; "
            "give it a method `inform`"
        )
    n = env.num_envs
    returns = np.zeros(episodes, dtype=np.float64)
    lengths = np.zeros(episodes, dtype=np.int64)
    actor.begin(np.arange(n))
    episode = np.arange(n)
    live = episode < episodes
    with progress(episodes, describe, "episodes") as bar:
        while live.any():
            if informed is not None:
                informed.inform(info)
            actions, propensities = actor.act(observations, live)
            next_observations, rewards, terminated, truncated, next_info = env.step(actions)
            rewards = np.asarray(rewards, dtype=np.float32)
            actor.observe(actions, rewards)
            rows = np.flatnonzero(live)
            returns[episode[rows]] += rewards[rows]
            lengths[episode[rows]] += 1
            if on_step is not None:
                final = _undo_reset(next_observations, next_info)
                columns = [episode, observations, actions, rewards, final]
                columns += [propensities, terminated, truncated, info.get(USER_IDS)]
                of_rows = [None if column is None else column[rows] for column in columns]
                on_step(Step._make([rows, *of_rows]))
            ended = terminated | truncated
            actor.begin(np.flatnonzero(ended))
            bar.update(int((ended & live).sum()))
            episode = np.where(ended, episode + n, episode)
            live = episode < episodes
            observations = next_observations
            info = next_info
    return Episodes(returns, lengths)


def _undo_reset(next_observations: Float32Array, info: Mapping[str, Any]) -> Float32Array:
    """Observations (N, O) after a step; of episodes that ended, the final one, not the reset's."""
    if "final_obs" not in info:
        return next_observations
    final_observations = next_observations.copy()
    ended = np.asarray(info["_final_obs"])
    final_observations[ended] = np.stack(info["final_obs"][ended])
    return final_observations
