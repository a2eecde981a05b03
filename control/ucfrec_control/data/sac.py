"""A soft actor-critic learner that can be stopped and resumed with the same results.

Stable-Baselines3 (extra `collect`) holds the networks, the replay buffer and the update; episodes
are played here. Every episode begins with all random streams seeded from the seed and the episode's
number, and checkpoints are taken between episodes, so no state of a generator or of an environment
need be stored.
"""

from pathlib import Path
from typing import Annotated, Any, Final

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.vector import VectorEnv
from pydantic import Field

from ucfrec.acting.rollout import BoolArray, FloatArray, IntArray
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, save_tensors
from ucfrec.progress import Progress
from ucfrec.settings import BatchSize, LearningRate, Share, Width, settings_table

_COLUMNS: Final = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of the replay buffer, each (capacity, 1, …)."""


@settings_table("sac")
class SacConfig:
    """Haarnoja et al. (2018), entropy coefficient learned."""

    learning_starts: Annotated[int, Field(ge=0, le=10**12)] = 10_000
    """Uniform steps before the first update; then there is one update a step."""
    batch_size: BatchSize = 256
    """Transitions of an update."""
    hidden: Width = 256
    """Width of the two hidden layers of actor and critics."""
    learning_rate: LearningRate = 3e-4
    """Step size of the updates."""
    discount: Share = 0.99
    """γ, of later rewards."""
    target_rate: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Share of the critics that their targets take over every update."""


class SacLearner:
    """Plays whole episodes in one environment and learns at every step.

    Args:
        env: a vector environment of one, with `AutoresetMode.SAME_STEP` and actions in a box.
        capacity: steps that the replay buffer holds; all that are ever played must fit.

    Raises:
        InputError: actions are no box, or Stable-Baselines3 is not installed.
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], seed: int, capacity: int, config: SacConfig
    ) -> None:
        self._env, self._seed, self._config = env, seed, config
        self._model = _sb3_model(env, seed, capacity, config)
        self._buffer = self._model.replay_buffer
        self.episode = 0
        """Episodes played so far."""

    @property
    def steps(self) -> int:
        """Steps played so far, all of them in the replay buffer."""
        return int(self._buffer.pos)

    def play_episode(self, bar: Progress) -> None:
        """Play one episode to its end, learning; uniform actions before `learning_starts`."""
        reset_seed = seed_all(self._seed, 1, self.episode)
        generator = np.random.default_rng(reset_seed)
        observations, _ = self._env.reset(seed=reset_seed)
        ended = False
        while not ended:
            before = observations.astype(np.float32)
            scaled = self._explore(before, generator)
            played = self._model.policy.unscale_action(scaled)
            observations, rewards, terminated, truncated, info = self._env.step(played)
            ended = bool(terminated[0] or truncated[0])
            after = info["final_obs"][0][None] if ended else observations
            timeout = {"TimeLimit.truncated": bool(truncated[0] and not terminated[0])}
            self._buffer.add(before, after, scaled, rewards, np.array([ended]), [timeout])
            if self.steps > self._config.learning_starts:
                self._model.train(1, self._config.batch_size)
            bar.update()
        self.episode += 1

    def _explore(self, observations: FloatArray, generator: np.random.Generator) -> FloatArray:
        """An action (1, A) on the scale [−1, 1]."""
        if self.steps < self._config.learning_starts:
            shape = (1, *(self._env.single_action_space.shape or ()))
            return generator.uniform(-1, 1, shape).astype(np.float32)
        drawn, _ = self._model.predict(observations, deterministic=False)
        return np.asarray(self._model.policy.scale_action(drawn), dtype=np.float32)

    def replay(self, steps: int) -> dict[str, npt.NDArray[Any]]:
        """The first `steps` steps played: columns named as in D4RL, actions as they were played."""
        columns = {name: getattr(self._buffer, name)[:steps, 0] for name in _COLUMNS}
        actions = self._model.policy.unscale_action(columns["actions"])
        timeouts = columns["timeouts"] > 0
        return {
            "observations": columns["observations"],
            "next_observations": columns["next_observations"],
            "actions": actions,
            "rewards": columns["rewards"],
            "terminals": (columns["dones"] > 0) & ~timeouts,
            "timeouts": timeouts,
        }

    def save_policy(self, path: Path, metadata: dict[str, Any]) -> None:
        """Write the policy's weights."""
        save_tensors(path, dict(self._model.actor.state_dict()), metadata)

    def load_policy(self, path: Path) -> dict[str, Any]:
        """Play with the weights of `save_policy` from now on; returns their metadata."""
        tensors, metadata = load_tensors(path)
        self._model.actor.load_state_dict(tensors)
        return metadata

    def save(self, path: Path, metadata: dict[str, Any]) -> None:
        """Write all that the learner needs to go on, atomically."""
        tensors = {"log_ent_coef": self._model.log_ent_coef}
        for name, state in self._model.get_parameters().items():
            moments = state.get("state")
            groups = {"": state} if moments is None else {f"{i}/": m for i, m in moments.items()}
            for prefix, group in groups.items():
                tensors |= {f"{name}/{prefix}{key}": value for key, value in group.items()}
        for name in _COLUMNS:
            tensors[f"replay/{name}"] = torch.from_numpy(getattr(self._buffer, name)[: self.steps])
        save_tensors(path, tensors, metadata | {"episode": self.episode})

    def load(self, path: Path) -> dict[str, Any]:
        """Go on from what `save` wrote, in place; returns its metadata."""
        tensors, metadata = load_tensors(path)
        for name in _COLUMNS:
            rows = tensors.pop(f"replay/{name}").numpy()
            getattr(self._buffer, name)[: len(rows)] = rows
            self._buffer.pos = len(rows)
        self._model.log_ent_coef.data.copy_(tensors.pop("log_ent_coef"))
        parameters = self._model.get_parameters()
        for key, value in tensors.items():
            name, key = key.split("/", 1)
            if "param_groups" in parameters[name]:
                index, key = key.split("/")
                parameters[name]["state"].setdefault(int(index), {})[key] = value
            else:
                parameters[name][key] = value
        self._model.set_parameters(parameters)
        self.episode = metadata.pop("episode")
        return metadata

    def begin(self, rows: IntArray) -> None:
        """As an `ucfrec.acting.rollout.Actor` the policy looks at nothing but the observation."""

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[FloatArray, None]:
        """Sample the policy, (N, A), as in training."""
        return self._model.predict(observations.astype(np.float32), deterministic=False)[0], None

    def observe(self, actions: npt.NDArray[Any], rewards: FloatArray) -> None:
        """Nothing is learned from what is played through `rollout`."""


def seed_all(*key: int) -> int:
    """Seed the global generators of numpy and torch, which Stable-Baselines3 draws from, by `key`.

    Returns:
        The seed, for what has a generator of its own.
    """
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    return seed


class _Spaces(gymnasium.Env[FloatArray, FloatArray]):
    """All that Stable-Baselines3 needs of an environment that is played elsewhere."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        shape = env.single_observation_space.shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, dtype=np.float32)
        self.action_space = env.single_action_space


def _sb3_model(env: VectorEnv[Any, Any, Any], seed: int, capacity: int, config: SacConfig) -> Any:
    try:
        from stable_baselines3 import SAC
        from stable_baselines3.common.logger import Logger
    except ImportError:
        raise InputError("stable-baselines3 is not installed; install ucfrec[collect]") from None

    if not isinstance(env.single_action_space, gymnasium.spaces.Box):
        raise InputError("SAC needs actions in a box; this environment's are not")
    model = SAC(
        "MlpPolicy",
        _Spaces(env),
        learning_rate=config.learning_rate,
        buffer_size=capacity,
        batch_size=config.batch_size,
        tau=config.target_rate,
        gamma=config.discount,
        policy_kwargs={"net_arch": [config.hidden] * 2},
        seed=seed,
    )
    model.set_logger(Logger(None, []))
    return model
