"""A distractor beside every page or item: in the logs it goes with the reward, it causes nothing.

It is the first number of the observation, in planted stores and in worlds: policies read as many of
a world's numbers as their logs had, and KuaiRand's logs have none but this one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ucfrec.acting.rollout import Actor, BoolArray, FloatArray, Informed
from ucfrec.episodes.distractor import logged_observations, reward_bit, with_observations
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.world import World
from ucfrec.plugins import Simulator
from ucfrec_simulators.kuai import kuairand
from ucfrec_simulators.session_env import AnyArray
from ucfrec_simulators.taobao import synthetic as synthetic_taobao

OFF: Final = 0.0
ON: Final = 1.0


def plant_distractor(
    store: EpisodeStore, out: Path, flip: float = 0.0, seed: int = 0
) -> EpisodeStore:
    """Write `store`, of items or of vector actions, with a distractor before every observation.

    `meta["source"]["distractor"]` has its `rate`, the share of steps with it.

    Raises:
        InputError: as `ucfrec.episodes.distractor.reward_bit`, or `out` exists.
    """
    distractor = reward_bit(store, flip, seed)
    planted = np.column_stack([distractor, logged_observations(store)])
    about = {"flip": flip, "seed": seed, "rate": float(distractor.mean())}
    return with_observations(store, out, planted, {"distractor": about})


class DistractorEnv(VectorWrapper[FloatArray, AnyArray, AnyArray]):
    """A world whose observation starts with a distractor that changes nothing.

    Each step's distractor is drawn with probability `rate`, independently of everything else,
    do(d ~ Bernoulli), by a generator of its own. 0 switches it off, 1 on; the training frequency
    distinguishes a policy that is misled by it from one that needs it to be on at times.

    Raises:
        InputError: `rate` is no probability.
    """

    def __init__(self, env: VectorEnv[FloatArray, AnyArray, AnyArray], rate: float) -> None:
        if not 0 <= rate <= 1:
            raise InputError(f"the distractor is shown with probability {rate}; it lies in [0, 1]")
        super().__init__(env)
        plain = env.single_observation_space
        assert isinstance(plain, spaces.Box)
        low, high = (
            np.append(np.float32(n), side) for n, side in ((0, plain.low), (1, plain.high))
        )
        self.single_observation_space = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._rate, self._distractors = rate, np.random.default_rng()

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start all sessions afresh; `seed` seeds the world and, apart from it, the distractors."""
        observations, info = super().reset(seed=seed, options=options)
        if seed is not None:
            self._distractors = np.random.default_rng([seed, 31])
        return self._shown(observations), info

    def step(
        self, actions: AnyArray
    ) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Play one action a session."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info:
            rows = np.flatnonzero(info["_final_obs"])
            last = self._shown(np.stack(info["final_obs"][rows].tolist()))
            for row, final in zip(rows, last, strict=True):
                info["final_obs"][row] = final
        return self._shown(observations), rewards, terminated, truncated, info

    def _shown(self, observations: FloatArray) -> FloatArray:
        distractors = self._distractors.random(len(observations)) < self._rate
        return np.column_stack([distractors, observations]).astype(np.float32)


class Unaware:
    """A behavior policy of the world without the distractor, which it does not look at."""

    def __init__(self, actor: Actor) -> None:
        self._actor = actor
        self.begin, self.observe = actor.begin, actor.observe

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[AnyArray, FloatArray | None]:
        """Choose by all of the observation but the distractor."""
        return self._actor.act(observations[:, 1:], live)

    def inform(self, info: Mapping[str, Any]) -> None:
        """Hand on what the world says."""
        if isinstance(self._actor, Informed):
            self._actor.inform(info)


def _unaware(
    behavior: Callable[[VectorEnv[Any, Any, Any], int], Actor],
    env: VectorEnv[Any, Any, Any],
    seed: int,
) -> Unaware:
    assert isinstance(env, DistractorEnv)
    return Unaware(behavior(env.env, seed))


def with_distractor(simulator: Simulator, rate: float) -> Simulator:
    """The simulator's world with a distractor shown with probability `rate`, and its behaviors."""
    shown = {OFF: "off", ON: "always on"}.get(rate, f"drawn with probability {rate:g}")
    return replace(
        simulator,
        summary=f"{simulator.summary}; with an idle distractor, {shown}",
        make=lambda num_envs, folder: DistractorEnv(simulator.make(num_envs, folder), rate),
        behaviors={name: partial(_unaware, own) for name, own in simulator.behaviors.items()},
    )


@dataclass(frozen=True)
class DistractorWorld(World):
    """A named world without a distractor, made one with it, for `ucfrec.evaluation.evaluate`."""

    rate: float = OFF

    def simulator(self) -> Simulator:
        """Load the simulator that the name stands for, and show the distractor in it."""
        return with_distractor(super().simulator(), self.rate)


SYNTHETIC_TAOBAO: Final = with_distractor(synthetic_taobao.SIMULATOR, OFF)
SYNTHETIC_TAOBAO_ON: Final = with_distractor(synthetic_taobao.SIMULATOR, ON)
KUAIRAND: Final = with_distractor(kuairand.SIMULATOR, OFF)
KUAIRAND_ON: Final = with_distractor(kuairand.SIMULATOR, ON)
