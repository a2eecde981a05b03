"""Training by soft actor-critic that can be stopped and resumed with the same results.

Stable-Baselines3 (extra `collect`) provides the networks, the replay buffer and the update; this
module runs the episodes. At the start of every episode, all random generators are seeded from the
seed and the episode's number, and checkpoints are saved between episodes. Checkpoints therefore
need no state of a random generator or an environment.
"""

from pathlib import Path
from typing import Annotated, Any, Final

import gymnasium
import numpy as np
import torch
from pydantic import Field

from ucfrec.acting.rollout import Memoryless
from ucfrec.arrays import Array, BoolArray, Float32Array
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file
from ucfrec.fitting.checkpoint import load_tensors, save_tensors
from ucfrec.processes import Progress
from ucfrec.settings import BatchSize, LearningRate, Share, Width, settings_table
from ucfrec_control.environments.environments import AnyEnv

_COLUMNS: Final = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Names of the replay buffer's arrays, each of shape (capacity, 1, …)."""


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


class SacTraining(Memoryless):
    """SAC that runs whole episodes in one environment and learns at every step; an
    `ucfrec.acting.rollout.Actor`, so that `rollout` can evaluate its policy.

    Args:
        env: vector environment of size one, with `AutoresetMode.SAME_STEP`.
        seed: of the networks, the exploration and the environment.
        capacity: steps of the replay buffer; every step taken must fit.

    Raises:
        InputError: the action space is not a `Box`, or Stable-Baselines3 is not installed.
    """

    def __init__(self, env: AnyEnv, seed: int, capacity: int, config: SacConfig) -> None:
        self._env, self._seed, self._config = env, seed, config
        self._model = _sb3_model(env, seed, capacity, config)
        self._buffer = self._model.replay_buffer
        self.episode = 0
        """Episodes run so far."""

    @property
    def steps(self) -> int:
        """Number of steps taken so far, all of them in the replay buffer."""
        return int(self._buffer.pos)

    def run_episode(self, bar: Progress) -> None:
        """Run one complete episode, with one update per step.

        Before `learning_starts`, actions are uniformly random and there are no updates.
        """
        reset_seed = seed_all((self._seed, 1, self.episode))
        generator = np.random.default_rng(reset_seed)
        observations, _ = self._env.reset(seed=reset_seed)
        ended = False
        while not ended:
            state = observations.astype(np.float32)
            scaled = self._explore(state, generator)
            actions = self._model.policy.unscale_action(scaled)
            observations, rewards, terminated, truncated, info = self._env.step(actions)
            ended = bool(terminated[0] or truncated[0])
            next_state = info["final_obs"][0][None] if ended else observations
            timeout = {"TimeLimit.truncated": bool(truncated[0] and not terminated[0])}
            self._buffer.add(state, next_state, scaled, rewards, np.array([ended]), [timeout])
            if self.steps > self._config.learning_starts:
                self._model.train(1, self._config.batch_size)
            bar.update()
        self.episode += 1

    def _explore(self, observations: Float32Array, generator: np.random.Generator) -> Float32Array:
        """Return an action of shape (1, A), scaled to [−1, 1]."""
        if self.steps < self._config.learning_starts:
            shape = (1, *(self._env.single_action_space.shape or ()))
            return generator.uniform(-1, 1, shape).astype(np.float32)
        action, _ = self._model.predict(observations, deterministic=False)
        return np.asarray(self._model.policy.scale_action(action), dtype=np.float32)

    def replay(self, steps: int) -> dict[str, Array]:
        """The first N = `steps` steps with D4RL's column names: (N, S), (N, A) in the units of the
        environment, or (N,)."""
        columns = {name: getattr(self._buffer, name)[:steps, 0] for name in _COLUMNS}
        columns["actions"] = self._model.policy.unscale_action(columns["actions"])
        columns["timeouts"] = columns["timeouts"] > 0
        columns["terminals"] = (columns.pop("dones") > 0) & ~columns["timeouts"]
        return columns

    def save_policy(self, path: Path, metadata: dict[str, Any]) -> None:
        """Write the policy's weights."""
        save_tensors(path, dict(self._model.actor.state_dict()), metadata)

    def load_policy(self, path: Path) -> dict[str, Any]:
        """Replace the policy's weights by those that `save_policy` wrote; returns its metadata."""
        tensors, metadata = load_tensors(path)
        self._model.actor.load_state_dict(tensors)
        return metadata

    def save(self, path: Path, evaluations: list[dict[str, Any]]) -> None:
        """Write a checkpoint from which training can resume, atomically, and `evaluations`."""
        columns = {name: getattr(self._buffer, name)[: self.steps] for name in _COLUMNS}
        state = {
            "parameters": self._model.get_parameters(),
            "log_ent_coef": self._model.log_ent_coef.detach(),
            "replay": {name: torch.from_numpy(rows) for name, rows in columns.items()},
            "episode": self.episode,
            "evaluations": evaluations,
        }
        with atomic_file(path) as scratch:
            torch.save(state, scratch)

    def load(self, path: Path) -> list[dict[str, Any]]:
        """Restore a checkpoint that `save` wrote, in place; returns the evaluations in it."""
        state = torch.load(path, weights_only=True)
        for name, rows in state["replay"].items():
            getattr(self._buffer, name)[: len(rows)] = rows.numpy()
            self._buffer.pos = len(rows)
        self._model.log_ent_coef.data.copy_(state["log_ent_coef"])
        self._model.set_parameters(state["parameters"])
        self.episode = state["episode"]
        evaluations: list[dict[str, Any]] = state["evaluations"]
        return evaluations

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Float32Array, None]:
        """Actions (N, A) in the units of the environment, sampled as in training, and None."""
        return self._model.predict(observations.astype(np.float32), deterministic=False)[0], None


def seed_all(key: tuple[int, ...]) -> int:
    """Seed the global random generators of numpy and torch, which Stable-Baselines3 uses, by a seed
    derived from `key`; returns it for components with their own generator."""
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    return seed


class _Spaces(gymnasium.Env[Float32Array, Float32Array]):
    """Environment with spaces only, for Stable-Baselines3; the episodes run in another one."""

    def __init__(self, env: AnyEnv) -> None:
        shape = env.single_observation_space.shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, dtype=np.float32)
        self.action_space = env.single_action_space


def _sb3_model(env: AnyEnv, seed: int, capacity: int, config: SacConfig) -> Any:
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
