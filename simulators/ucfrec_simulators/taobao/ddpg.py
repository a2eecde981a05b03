"""DDPG behavior policies in the Taobao environments: one that is being trained, its snapshots, the
last one.

Stable-Baselines3 (extra `collect`) provides the networks, the replay buffer and the update. The
sessions are run by `ucfrec.acting.rollout`, so that the steps learned from are those logged.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
import torch
from torch import nn

from ucfrec.acting.rollout import Actor, Memoryless, Step, Uniform, rollout
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, load_weights, save_tensors
from ucfrec.processes import random_state_kept
from ucfrec.provenance import versions
from ucfrec_simulators.behaviors import SessionMixture, truncated_normal
from ucfrec_simulators.session_env import AnyEnv
from ucfrec_simulators.taobao.environment import (
    ACTION_DIM,
    MAX_CLICKS,
    TaobaoEnv,
    best_constant_actor,
    taobao,
    zero_actor,
)


@dataclass(frozen=True)
class DdpgConfig:
    """Settings of the training; one step is one step of one session."""

    sessions: int = 40_000
    """Training sessions."""
    snapshots: int = 10
    """Number of snapshots, taken after equal shares of the training sessions."""
    warm_up: int = 25_600
    """Steps with uniform actions before the first update."""
    updates: float = 1 / 16
    """Gradient updates per step after the warm-up."""
    batch_size: int = 256
    buffer_size: int = 1_000_000
    hidden: int = 128
    learning_rate: float = 1e-3
    discount: float = 0.2
    """Discount γ; small, since actions hardly affect later steps in these environments."""
    target_rate: float = 0.02
    """Polyak rate τ of the target networks."""
    noise: float = 0.1
    """Standard deviation of the exploration noise, before truncation; also used by snapshots."""


DEFAULT: Final = DdpgConfig()


class Noisy(Memoryless):
    """A deterministic policy network with truncated normal exploration noise."""

    def __init__(
        self, network: nn.Module, high: Float32Array, noise: float, seed: list[int]
    ) -> None:
        self._network, self._high, self._noise = network, high, noise
        self._generator = np.random.default_rng(seed)

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array]:
        """Draw actions (N, A); returns them and their densities (N,)."""
        mean = _forward(self._network, observations / self._high)
        return truncated_normal(mean, self._noise, self._generator)


class Training:
    """DDPG (Lillicrap et al., 2016) as an actor that learns from every step taken.

    The logged sessions are its training sessions. After a uniform warm-up, it serves all N sessions
    with its current network and noise; the propensity is the density of the action. It learns from
    the live rows only, which are those that are logged. The value after the end of a session is 0,
    whether it terminated or was truncated. InputError if `env` is not a Taobao environment, or
    Stable-Baselines3 is not installed.
    """

    def __init__(self, env: AnyEnv, seed: int, config: DdpgConfig = DEFAULT) -> None:
        taobao(env)
        self._high = _high(env)
        self._config = config
        self._generator = np.random.default_rng([seed, 51])
        self._model = _sb3_model(env, seed, config)
        self._ended = np.zeros(env.num_envs, dtype=np.bool_)
        self._taken: _Taken | None = None
        self._steps, self._due = 0, 0.0

    @property
    def network(self) -> nn.Module:
        """The current policy network: scaled observations (N, O) to actions (N, A)."""
        network: nn.Module = self._model.actor.mu
        return network

    def begin(self, rows: IntArray) -> None:
        """Mark that the previous sessions in `rows` have ended."""
        self._ended[rows] = True

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array]:
        """Learn from the previous step, whose next observations are `observations`; then act.

        Returns:
            Actions (N, A) and their densities (N,).
        """
        scaled = observations / self._high
        if self._taken is not None:
            self._learn(self._taken, scaled)
        self._ended[:] = False
        if self._steps < self._config.warm_up:
            box = (len(observations), ACTION_DIM)
            actions: Float32Array = self._generator.uniform(-1, 1, box).astype(np.float32)
            density = np.full(len(observations), 0.5**ACTION_DIM, dtype=np.float32)
        else:
            mean = _forward(self.network, scaled)
            actions, density = truncated_normal(mean, self._config.noise, self._generator)
        self._taken = _Taken(scaled, np.flatnonzero(live))
        return actions, density

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Keep the step until its next observations are known."""
        assert self._taken is not None
        self._taken.actions, self._taken.rewards = actions, rewards / np.float32(MAX_CLICKS)

    def _learn(self, taken: "_Taken", next_observations: Float32Array) -> None:
        buffer, rows, config = self._model.replay_buffer, taken.rows, self._config
        # `ReplayBuffer.add` takes steps of all N sessions; only the M live ones may enter.
        slots = (buffer.pos + np.arange(len(rows))) % buffer.buffer_size
        buffer.observations[slots, 0] = taken.observations[rows]
        buffer.next_observations[slots, 0] = next_observations[rows]
        buffer.actions[slots, 0] = taken.actions[rows]
        buffer.rewards[slots, 0] = taken.rewards[rows]
        buffer.dones[slots, 0] = self._ended[rows]
        buffer.full |= buffer.pos + len(rows) >= buffer.buffer_size
        buffer.pos = (buffer.pos + len(rows)) % buffer.buffer_size
        self._steps += len(rows)
        if self._steps >= config.warm_up:
            self._due += config.updates * len(rows)
            if self._due >= 1:
                self._model.train(int(self._due), config.batch_size)
            self._due %= 1


@dataclass
class _Taken:
    """A step whose next observations are not known yet."""

    observations: Float32Array
    """(N, O), scaled."""
    rows: IntArray
    """(M,) live rows."""
    actions: Array = field(init=False)
    rewards: Float32Array = field(init=False)


class _Spaces(gymnasium.Env[Float32Array, Array]):
    """The spaces that Stable-Baselines3 needs; the sessions themselves are run by `rollout`."""

    def __init__(self, env: AnyEnv) -> None:
        self.observation_space = gymnasium.spaces.Box(-1, 1, env.single_observation_space.shape)
        self.action_space = env.single_action_space


def _sb3_model(env: AnyEnv, seed: int, config: DdpgConfig) -> Any:
    """A `stable_baselines3.DDPG`."""
    try:
        from stable_baselines3 import DDPG
        from stable_baselines3.common.logger import Logger
    except ImportError:
        raise InputError("stable-baselines3 is not installed; install ucfrec[collect]") from None

    model = DDPG(
        "MlpPolicy",
        _Spaces(env),
        learning_rate=config.learning_rate,
        buffer_size=config.buffer_size,
        replay_buffer_kwargs={"handle_timeout_termination": False},
        tau=config.target_rate,
        gamma=config.discount,
        policy_kwargs={"net_arch": [config.hidden] * 2},
        seed=seed,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    return model


def _network(observation_size: int, hidden: int) -> nn.Sequential:
    """The network of Stable-Baselines3's DDPG actor, with the same layers and parameter names."""
    first, second = nn.Linear(observation_size, hidden), nn.Linear(hidden, hidden)
    last = nn.Linear(hidden, ACTION_DIM)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last, nn.Tanh())


def _forward(network: nn.Module, scaled: Float32Array) -> Float32Array:
    with torch.no_grad():
        actions: Float32Array = network(torch.from_numpy(scaled)).numpy()
    return actions


def _high(env: AnyEnv) -> Float32Array:
    """(O,) upper bounds of the observations, which scale them to [−1, 1]."""
    space = env.single_observation_space
    assert isinstance(space, gymnasium.spaces.Box)
    return np.asarray(space.high, dtype=np.float32)


@random_state_kept()
def snapshots(env: AnyEnv, seed: int, config: DdpgConfig) -> list[nn.Module]:
    """Policy networks of one training after equal shares of its sessions, earliest first.

    They are trained at the first use and cached as safetensors in `$UCFREC_CACHE`
    (`~/.cache/ucfrec`). The file's name is a hash of responses of the environment, the
    configuration, the seed and the libraries' versions. No logged session is a training session.
    InputError if `env` is not a Taobao environment, or Stable-Baselines3 is not installed.
    """
    folder = Path(os.environ.get("UCFREC_CACHE", Path.home() / ".cache" / "ucfrec"))
    file = folder / f"ddpg-{_fingerprint(taobao(env), seed, config)}.safetensors"
    if not file.exists():
        states = _train(env, seed, config)
        tensors = {f"{i}.{k}": v for i, state in enumerate(states) for k, v in state.items()}
        save_tensors(file, tensors, asdict(config) | {"seed": seed})
    tensors, _ = load_tensors(file)
    networks: list[nn.Module] = []
    for index in range(config.snapshots):
        parameters = {
            k.partition(".")[2]: v for k, v in tensors.items() if k.startswith(f"{index}.")
        }
        networks.append(_network(_high(env).size, config.hidden))
        load_weights(file, networks[-1], parameters)
    return networks


def _train(env: AnyEnv, seed: int, config: DdpgConfig) -> list[dict[str, torch.Tensor]]:
    ongoing = Training(env, seed, config)
    taken: list[dict[str, torch.Tensor]] = []
    ended = 0

    def watch(step: Step) -> None:
        nonlocal ended
        ended += int((step.terminated | step.truncated).sum())
        while ended * config.snapshots >= (len(taken) + 1) * config.sessions:
            taken.append({k: v.clone() for k, v in ongoing.network.state_dict().items()})

    # A separate random stream, so that no logged session is a training session.
    users_seed = int(np.random.SeedSequence([seed, 52]).generate_state(1)[0])
    rollout(env, ongoing, config.sessions, users_seed, watch, describe="train DDPG")
    return taken


def _fingerprint(environment: TaobaoEnv, seed: int, config: DdpgConfig) -> str:
    generator = np.random.default_rng(53)
    users, lengths = environment.sample_users(256, generator)
    actions = generator.uniform(-1, 1, (256, ACTION_DIM)).astype(np.float32)
    clicks = environment.expected_clicks(users, np.zeros(256, dtype=np.int64), actions)
    identity = {
        "environment": [type(environment).__name__, environment.num_envs, lengths.tolist()],
        "answers": clicks.round(4).tolist(),
        "config": asdict(config) | {"seed": seed},
        "versions": versions(["stable-baselines3"]),
    }
    return hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:16]


def snapshot_mixture(env: AnyEnv, seed: int, config: DdpgConfig = DEFAULT) -> SessionMixture:
    """Each session is served by one snapshot, drawn uniformly when the session starts."""
    high, networks = _high(env), snapshots(env, seed, config)
    actors = [Noisy(n, high, config.noise, [seed, 54, i]) for i, n in enumerate(networks)]
    return SessionMixture(actors, [1.0] * len(actors), seed)


def expert(env: AnyEnv, seed: int, config: DdpgConfig = DEFAULT) -> Noisy:
    """The last snapshot, with the same noise as in training."""
    return Noisy(snapshots(env, seed, config)[-1], _high(env), config.noise, [seed, 55])


BEHAVIORS: Final[Mapping[str, Callable[[AnyEnv, int], Actor]]] = {
    "ddpg-training": Training,
    "ddpg-snapshots": snapshot_mixture,
    "ddpg-expert": expert,
}
"""Behavior policies by DDPG."""
COMMON: Final[Mapping[str, Callable[[AnyEnv, int], Actor]]] = {
    "random": Uniform,
    "zero": zero_actor,
    "best-constant": best_constant_actor,
    **BEHAVIORS,
}
"""Behavior policies of every Taobao environment."""
