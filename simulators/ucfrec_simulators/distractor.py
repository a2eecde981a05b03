"""A distractor in the observations: correlated with the reward in the logs, without any effect.

It is the first number of the observation, in stores and in environments: a policy reads as many
numbers of an environment's observation as its logs had, and KuaiRand's logs have none but the
distractor.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ucfrec.arrays import Array, BoolArray, Float32Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.writer import read_observations, reward_bit, write_observations
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Environment, Simulator

OFF: Final = 0.0
ON: Final = 1.0


def plant_distractor(
    store: EpisodeStore, out: Path, flip: float = 0.0, seed: int = 0
) -> EpisodeStore:
    """Write a copy of `store` with a distractor in front of every observation.

    `meta["source"]["distractor"]` records `flip`, `seed` and `rate`, the share of steps where the
    distractor is 1.

    Args:
        flip: probability that the distractor is the opposite of the reward bit.

    Raises:
        InputError: as `ucfrec.episodes.writer.reward_bit`, or `out` exists.
    """
    distractor = reward_bit(store, flip, seed)
    planted = np.column_stack([distractor, read_observations(store)])
    record = {"flip": flip, "seed": seed, "rate": float(distractor.mean())}
    return write_observations(store, out, planted, {"distractor": record})


class DistractorEnv(VectorWrapper[Float32Array, Array, Array]):
    """An environment whose observation starts with a distractor that has no effect.

    In each step the distractor is 1 with probability `rate`, independently of everything else:
    do(d ~ Bernoulli(rate)), from a separate random generator. With rate 0 it is always off, with 1
    always on. A rate between, such as that of the training logs, distinguishes a policy that is
    misled by the distractor from one that fails when it never occurs.

    Raises:
        InputError: `rate` is not in [0, 1].
    """

    def __init__(self, env: VectorEnv[Float32Array, Array, Array], rate: float) -> None:
        if not 0 <= rate <= 1:
            raise InputError(f"the distractor's rate is {rate}; it must lie in [0, 1]")
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
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start all sessions; `seed` seeds the environment and, independently, the distractors."""
        observations, info = super().reset(seed=seed, options=options)
        if seed is not None:
            self._distractors = np.random.default_rng([seed, 31])
        return self._add_distractors(observations), info

    def step(
        self, actions: Array
    ) -> tuple[Float32Array, Float32Array, BoolArray, BoolArray, dict[str, Any]]:
        """Take one action in each session, as the wrapped environment does."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info:
            rows = np.flatnonzero(info["_final_obs"])
            last = self._add_distractors(np.stack(info["final_obs"][rows].tolist()))
            for row, final in zip(rows, last, strict=True):
                info["final_obs"][row] = final
        return self._add_distractors(observations), rewards, terminated, truncated, info

    def _add_distractors(self, observations: Float32Array) -> Float32Array:
        distractors = self._distractors.random(len(observations)) < self._rate
        return np.column_stack([distractors, observations]).astype(np.float32)


@dataclass(frozen=True)
class DistractorEnvironment(Environment):
    """A named environment with a distractor added, for `ucfrec.evaluation.evaluate`."""

    rate: float = OFF
    """Probability that the distractor is on in a step."""

    def simulator(self) -> Simulator:
        """Load the simulator of this name, with the distractor added. It has no behavior policies,
        which would read the distractor."""
        plain = super().simulator()

        def make(sessions: int, folder: Path | None) -> DistractorEnv:
            return DistractorEnv(plain.make(sessions, folder), self.rate)

        return replace(plain, make=make, behaviors={})
