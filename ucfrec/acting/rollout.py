"""Episodes played in many environments side by side, by one actor."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ucfrec.errors import InputError
from ucfrec.progress import progress

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

USER_IDS: Final = "user_id"
"""Key of `info`: (N,) identifiers of the users of the next step, as in the logs."""
FORBIDDEN: Final = "forbidden"
"""Key of `info`: (N, L) items that may not be played next, −1 where there are fewer than L."""


class Actor(Protocol):
    """Chooses actions for N episodes at once: a trained policy, or a rule."""

    def begin(self, rows: IntArray) -> None:
        """The episodes in `rows` (positions among the N) start afresh."""

    def act(
        self, observations: FloatArray, live: BoolArray
    ) -> tuple[npt.NDArray[Any], FloatArray | None]:
        """Choose one action a row.

        Args:
            observations: (N, O).
            live: (N,) rows whose action counts; what is returned for the others is ignored.

        Returns:
            Actions, (N, A) float32 or (N,) int64, and the probability (of items) or the density
            (of vectors, where it may exceed 1) with which each was chosen, (N,), or None where it
            is unknown or does not exist.
        """

    def observe(self, actions: npt.NDArray[Any], rewards: FloatArray) -> None:
        """Take note of the actions (N, …) just played and the rewards (N,) they earned."""


@runtime_checkable
class Informed(Protocol):
    """An actor that uses what the environment reports beside its observations."""

    def inform(self, info: Mapping[str, Any]) -> None:
        """Take note of `info` (see `USER_IDS`, `FORBIDDEN`) before choosing the next actions."""


@dataclass(frozen=True)
class Step:
    """One step of the M rows that count; arrays are aligned."""

    rows: IntArray
    """(M,) positions among the N environments."""
    episodes: IntArray
    """(M,) number of the episode that each row plays, 0 to episodes − 1."""
    observations: FloatArray
    """(M, O) what was known before acting."""
    actions: npt.NDArray[Any]
    """(M, A) vectors or (M,) items."""
    rewards: FloatArray
    """(M,)."""
    next_observations: FloatArray
    """(M, O) what the actions led to; of an episode that ended, its own last one."""
    propensities: FloatArray | None
    """(M,) see `Actor.act`."""
    terminated: BoolArray
    """(M,)."""
    truncated: BoolArray
    """(M,)."""
    user_ids: IntArray | None
    """(M,) users of the step, where the environment reports them (`USER_IDS`)."""


@dataclass(frozen=True)
class Episodes:
    """What was earned, one row an episode."""

    returns: npt.NDArray[np.float64]
    """(episodes,) sum of the rewards."""
    lengths: IntArray
    """(episodes,) steps."""


def rollout(
    env: "VectorEnv[Any, Any, Any]",
    actor: Actor,
    episodes: int,
    seed: int,
    on_step: Callable[[Step], None] | None = None,
    describe: str = "rollout",
) -> Episodes:
    """Play exactly `episodes` episodes.

    Environment i of N plays episodes i, i + N, i + 2N, …: the number is fixed beforehand, so
    episodes are not preferred for being short.

    Args:
        env: N environments, reset within the step (`AutoresetMode.SAME_STEP`).
        actor: chooses the actions.
        episodes: how many to play.
        seed: environment i starts with `seed` + i.
        on_step: called with every step of the episodes that count.
        describe: name of the progress bar.

    Raises:
        InputError: the environment does not reset within the step, or forbids actions (`FORBIDDEN`)
            and the actor has no `inform`.
    """
    # Only playing needs gymnasium: scoring logs and recommending do without.
    from gymnasium.vector import AutoresetMode

    if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise InputError(
            f"{type(env).__name__} does not reset in the same step; build it with "
            "autoreset_mode=AutoresetMode.SAME_STEP"
        )
    n = env.num_envs
    returns = np.zeros(episodes, dtype=np.float64)
    lengths = np.zeros(episodes, dtype=np.int64)
    observations, info = env.reset(seed=seed)
    if FORBIDDEN in info and not isinstance(actor, Informed):
        raise InputError(
            f"{type(env).__name__} forbids some actions and {type(actor).__name__} does not take "
            "note of them; give it a method `inform`"
        )
    actor.begin(np.arange(n))
    episode = np.arange(n)
    live = episode < episodes
    with progress(episodes, describe, "episodes") as bar:
        while live.any():
            if isinstance(actor, Informed):
                actor.inform(info)
            actions, propensities = actor.act(observations, live)
            next_observations, rewards, terminated, truncated, info_next = env.step(actions)
            rewards = np.asarray(rewards, dtype=np.float32)
            actor.observe(actions, rewards)
            rows = np.flatnonzero(live)
            returns[episode[rows]] += rewards[rows]
            lengths[episode[rows]] += 1
            if on_step is not None:
                users = info.get(USER_IDS)
                on_step(
                    Step(
                        rows=rows,
                        episodes=episode[rows],
                        observations=observations[rows],
                        actions=actions[rows],
                        rewards=rewards[rows],
                        next_observations=_led_to(next_observations, info_next)[rows],
                        propensities=None if propensities is None else propensities[rows],
                        terminated=terminated[rows],
                        truncated=truncated[rows],
                        user_ids=None if users is None else users[rows],
                    )
                )
            ended = terminated | truncated
            actor.begin(np.flatnonzero(ended))
            bar.update(int((ended & live).sum()))
            episode = np.where(ended, episode + n, episode)
            live = episode < episodes
            observations, info = next_observations, info_next
    return Episodes(returns, lengths)


def _led_to(next_observations: FloatArray, info: Mapping[str, Any]) -> FloatArray:
    """Observations (N, O) after a step, before the episodes that ended were replaced."""
    if "final_obs" not in info:
        return next_observations
    led_to, ended = next_observations.copy(), np.asarray(info["_final_obs"])
    led_to[ended] = np.stack(list(info["final_obs"][ended]))
    return led_to
