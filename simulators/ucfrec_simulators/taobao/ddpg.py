"""A DDPG learner's sessions in a Taobao world: while it learns, of its snapshots, of its best.

Stable-Baselines3 (extra `collect`) holds the networks, the replay buffer and the update; the
sessions are played by `ucfrec.acting.rollout`, many side by side, so that what it learns from and
what is logged are the same steps.
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
from gymnasium.vector import VectorEnv
from torch import nn

from ucfrec.acting.rollout import Actor, BoolArray, FloatArray, IntArray, Step, rollout
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, load_weights, save_tensors
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.provenance import versions
from ucfrec_simulators.behaviors import Actions, Memoryless, SessionMixture, truncated_normal
from ucfrec_simulators.taobao.environment import ACTION_DIM, MAX_CLICKS, TaobaoEnv, taobao


@dataclass(frozen=True)
class DdpgConfig:
    """How the learner trains; a step is one of one session."""

    sessions: int = 40_000
    """Training sessions behind the snapshots and the expert."""
    snapshots: int = 10
    """Taken after equal shares of the training sessions."""
    warm_up: int = 25_600
    """Steps with uniform actions before the first update."""
    updates: float = 1 / 16
    """Gradient updates for each step after that."""
    batch_size: int = 256
    buffer_size: int = 1_000_000
    hidden: int = 128
    learning_rate: float = 1e-3
    discount: float = 0.2
    """Small, since actions hardly move what comes later in these worlds."""
    target_rate: float = 0.02
    noise: float = 0.1
    """Scale σ of the exploration noise, in training and of every snapshot."""


DEFAULT: Final = DdpgConfig()


class Noisy(Memoryless):
    """A deterministic network of observations, explored about by a truncated normal."""

    def __init__(self, network: nn.Module, high: FloatArray, noise: float, seed: list[int]) -> None:
        self._network, self._high, self._noise = network, high, noise
        self._generator = np.random.default_rng(seed)

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, FloatArray]:
        """Draw actions (N, A) and give their densities (N,)."""
        mean = _forward(self._network, observations / self._high)
        return truncated_normal(mean, self._noise, self._generator)


class Learner:
    """DDPG (Lillicrap et al., 2016) as an actor: each step played is a step learned from.

    It serves all N sessions with its present network and noise, after a uniform warm-up; the
    propensity is the density of the action. It learns from the live rows only, so from nothing that
    is not in the log.

    A session that ends has no value beyond its end, be it terminated or truncated.

    Raises:
        InputError: the world is no Taobao world, or Stable-Baselines3 is not installed.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig) -> None:
        taobao(env)
        self._high = _high(env)
        self._config = config
        self._generator = np.random.default_rng([seed, 51])
        self._model = _sb3_model(env, seed, config)
        self._ended = np.zeros(env.num_envs, dtype=np.bool_)
        self._played: _Played | None = None
        self._steps, self._due = 0, 0.0

    @property
    def network(self) -> nn.Module:
        """Scaled observations (N, O) to actions (N, A), as it is now."""
        network: nn.Module = self._model.actor.mu
        return network

    def begin(self, rows: IntArray) -> None:
        """The sessions that these followed have ended."""
        self._ended[rows] = True

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, FloatArray]:
        """Learn from the step before, which led to `observations`; then draw (N, A) actions."""
        scaled = observations / self._high
        if self._played is not None:
            self._learn(self._played, scaled)
        self._ended[:] = False
        if self._steps < self._config.warm_up:
            box = (len(observations), ACTION_DIM)
            actions: FloatArray = self._generator.uniform(-1, 1, box).astype(np.float32)
            density = np.full(len(observations), 0.5**ACTION_DIM, dtype=np.float32)
        else:
            mean = _forward(self.network, scaled)
            actions, density = truncated_normal(mean, self._config.noise, self._generator)
        self._played = _Played(scaled, np.flatnonzero(live))
        return actions, density

    def observe(self, actions: Actions, rewards: FloatArray) -> None:
        """Keep the step until it is known what it led to."""
        assert self._played is not None
        self._played.actions, self._played.rewards = actions, rewards / np.float32(MAX_CLICKS)

    def _learn(self, played: "_Played", after: FloatArray) -> None:
        buffer, rows, config = self._model.replay_buffer, played.rows, self._config
        # `ReplayBuffer.add` takes one step of each session; here the M live ones enter at once.
        places = (buffer.pos + np.arange(len(rows))) % buffer.buffer_size
        buffer.observations[places, 0] = played.observations[rows]
        buffer.next_observations[places, 0] = after[rows]
        buffer.actions[places, 0] = played.actions[rows]
        buffer.rewards[places, 0] = played.rewards[rows]
        buffer.dones[places, 0] = self._ended[rows]
        buffer.full |= buffer.pos + len(rows) >= buffer.buffer_size
        buffer.pos = (buffer.pos + len(rows)) % buffer.buffer_size
        self._steps += len(rows)
        if self._steps >= config.warm_up:
            self._due += config.updates * len(rows)
            if self._due >= 1:
                self._model.train(int(self._due), config.batch_size)
            self._due %= 1


@dataclass
class _Played:
    """A step whose outcome is not known yet."""

    observations: FloatArray
    """(N, O), scaled."""
    rows: IntArray
    """(M,) those that count."""
    actions: Actions = field(init=False)
    rewards: FloatArray = field(init=False)


class _Spaces(gymnasium.Env[FloatArray, Actions]):
    """All that Stable-Baselines3 needs of a world whose sessions `rollout` plays."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        self.observation_space = gymnasium.spaces.Box(-1, 1, env.single_observation_space.shape)
        self.action_space = env.single_action_space


def _sb3_model(env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig) -> Any:
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
    """The network of Stable-Baselines3's DDPG actor, as its own code lays it out."""
    return nn.Sequential(
        nn.Linear(observation_size, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.ReLU(),
        nn.Linear(hidden, ACTION_DIM),
        nn.Tanh(),
    )


def _forward(network: nn.Module, scaled: FloatArray) -> FloatArray:
    with torch.no_grad():
        actions: FloatArray = network(torch.from_numpy(scaled)).numpy()
    return actions


def _high(env: VectorEnv[Any, Any, Any]) -> FloatArray:
    """(O,) largest observations, which scale them to [−1, 1]."""
    space = env.single_observation_space
    assert isinstance(space, gymnasium.spaces.Box)
    return np.asarray(space.high, dtype=np.float32)


@random_state_kept()
def snapshots(env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig) -> list[nn.Module]:
    """Networks of one training, after equal shares of its sessions, weakest stage first.

    Trained at the first use and kept as safetensors in `$UCFREC_CACHE` (`~/.cache/ucfrec`), under
    a name made of the world's own answers, the configuration, the seed and the libraries'
    versions. The training is apart from every session that is logged later.
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
        prefix = f"{index}."
        chosen = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
        network = _network(_high(env).size, config.hidden)
        load_weights(file, network, chosen)
        networks.append(network)
    return networks


def _train(
    env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig
) -> list[dict[str, torch.Tensor]]:
    learner = Learner(env, seed, config)
    taken: list[dict[str, torch.Tensor]] = []
    ended = 0

    def watch(step: Step) -> None:
        nonlocal ended
        ended += int((step.terminated | step.truncated).sum())
        while ended * config.snapshots >= (len(taken) + 1) * config.sessions:
            taken.append({k: v.clone() for k, v in learner.network.state_dict().items()})

    # Users of a stream of their own, so that no logged session was trained on.
    users = int(np.random.SeedSequence([seed, 52]).generate_state(1)[0])
    rollout(env, learner, config.sessions, users, watch, describe="train DDPG")
    return taken


def _fingerprint(world: TaobaoEnv, seed: int, config: DdpgConfig) -> str:
    generator = np.random.default_rng(53)
    users, lengths = world.sample_users(256, generator)
    actions = generator.uniform(-1, 1, (256, ACTION_DIM)).astype(np.float32)
    answers = world.expected_clicks(users, np.zeros(256, dtype=np.int64), actions)
    known = {
        "world": [type(world).__name__, world.num_envs, lengths.tolist()],
        "answers": answers.round(4).tolist(),
        "config": asdict(config) | {"seed": seed},
        "versions": versions(["stable-baselines3"]),
    }
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()[:16]


def training(env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig = DEFAULT) -> Learner:
    """A learner's whole training: the sessions logged are those it learns from."""
    return Learner(env, seed, config)


def snapshot_mixture(
    env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig = DEFAULT
) -> SessionMixture:
    """Each session is served by one snapshot of a training, drawn evenly when it begins."""
    high, networks = _high(env), snapshots(env, seed, config)
    actors = [Noisy(n, high, config.noise, [seed, 54, i]) for i, n in enumerate(networks)]
    return SessionMixture(actors, [1.0] * len(actors), seed)


def expert(env: VectorEnv[Any, Any, Any], seed: int, config: DdpgConfig = DEFAULT) -> Noisy:
    """The last snapshot of a training, with the same noise as in training."""
    return Noisy(snapshots(env, seed, config)[-1], _high(env), config.noise, [seed, 55])


BEHAVIORS: Final[Mapping[str, Callable[[VectorEnv[Any, Any, Any], int], Actor]]] = {
    "ddpg-training": training,
    "ddpg-snapshots": snapshot_mixture,
    "ddpg-expert": expert,
}
"""Behavior policies of every Taobao world."""
