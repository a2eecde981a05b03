"""IQL and CQL of d3rlpy (extra `rl`) on control stores, with CORL's settings (reference §3)."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ucfrec import schema
from ucfrec.checkpoint import load_tensors, load_weights, save_tensors
from ucfrec.errors import InputError
from ucfrec.files import atomic_folder, read_json, write_json
from ucfrec.results import versions
from ucfrec.rollout import BoolArray, FloatArray, IntArray
from ucfrec.store import EpisodeStore
from ucfrec.trained import RUN
from ucfrec_control.scores import find_kind, find_task
from ucfrec_control.trajectories import PACKAGES

ALGORITHMS = ("iql", "cql")
_ACTOR = "actor.safetensors"
_HOPPER_NARROW = ("medium", "medium-replay", "mixed")


@dataclass(frozen=True)
class RLConfig:
    """All that decides a training, with its data."""

    algorithm: str
    steps: int
    task: str
    kind: str
    batch_size: int = 256


class RLPolicy:
    """An actor read back from its run folder; plays without a target return."""

    def __init__(self, run: Path) -> None:
        """Raises:
        InputError: `run` is unfinished, or d3rlpy is not installed.
        """
        self.record: dict[str, Any] = read_json(run / RUN)
        self.name: str = self.record["config"]["policy_name"]
        tensors, _ = load_tensors(run / _ACTOR)
        self._mean, self._std = (tensors.pop(f"state.{name}").numpy() for name in ("mean", "std"))
        self._learner = _learner(RLConfig(**self.record["config"]["policy"]))
        sizes = self.record["sizes"]
        self._learner.create_impl((sizes["state"],), sizes["action"])
        load_weights(run / _ACTOR, self._learner.impl.modules.policy, tensors)

    def actor(self, episodes: int, target_return: float | None) -> "RLPolicy":
        """Itself: it remembers nothing, and asks for nothing."""
        return self

    def begin(self, rows: IntArray) -> None:
        """See `ucfrec.rollout.Actor`."""

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[npt.NDArray[Any], None]:
        """The policy's mean actions."""
        return self._learner.predict(_normalised(observations, self._mean, self._std)), None

    def observe(self, actions: npt.NDArray[Any], rewards: FloatArray) -> None:
        """See `ucfrec.rollout.Actor`."""


def is_rl(record: Mapping[str, Any]) -> bool:
    """Whether `record` is of a run of `train_rl`."""
    return record["config"]["policy_name"] in ALGORITHMS


def rl_config(
    dataset: Mapping[str, Any], algorithm: str, steps: int, batch_size: int = 256
) -> RLConfig:
    """The settings for the data that `ucfrec_control.train.dataset_of` describes."""
    task = find_task(dataset["env_id"], dataset["dataset"])
    kind = find_kind(dataset["dataset"])
    return RLConfig(algorithm, steps, task.name if task else "", kind, batch_size)


def plain_config(config: RLConfig, seed: int) -> dict[str, Any]:
    """`config` as a run's record has it."""
    return {"policy_name": config.algorithm, "policy": asdict(config), "seed": seed}


def train_rl(store: EpisodeStore, out: Path, config: RLConfig, seed: int) -> dict[str, Any]:
    """Train on the training trajectories; returns the record of the run.

    The run folder appears when training has ended; one that exists is read, not repeated.

    Raises:
        InputError: d3rlpy is not installed, or `out` is of another configuration or other data.
    """
    plain, fingerprint = plain_config(config, seed), store.meta["fingerprint"]
    if (out / RUN).exists():
        record: dict[str, Any] = read_json(out / RUN)
        if (record["config"], record["fingerprint"]) != (plain, fingerprint):
            raise InputError(f"{out} was trained otherwise; remove it or name another run folder")
        return record
    d3rlpy = _d3rlpy()
    d3rlpy.seed(seed)
    train = store.split("train")
    mean, std = train.state_statistics
    begun = perf_counter()
    with atomic_folder(out) as scratch:
        learner = _learner(config, "cuda:0" if torch.cuda.is_available() else "cpu:0")
        learner.fit(
            _dataset(d3rlpy, train, mean.numpy(), std.numpy()),
            n_steps=config.steps,
            n_steps_per_epoch=config.steps,
            logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
            show_progress=False,
        )
        actor = learner.impl.modules.policy.state_dict()
        save_tensors(scratch / _ACTOR, {**actor, "state.mean": mean, "state.std": std}, {})
        record = {
            "config": plain,
            "seed": seed,
            "sizes": {"state": store.state_size, "action": learner.action_size},
            "policy": {"steps": config.steps, "best_step": None},
            "fingerprint": fingerprint,
            "dataset": dict(store.meta["source"]),
            "versions": versions((*PACKAGES, "d3rlpy")),
            "threads": torch.get_num_threads(),
            "wall_time_s": perf_counter() - begun,
        }
        write_json(scratch / RUN, record)
    return record


def _dataset(
    d3rlpy: Any, train: EpisodeStore, mean: npt.NDArray[Any], std: npt.NDArray[Any]
) -> Any:
    episodes, steps = train.all_steps()
    last = steps == train.lengths[episodes] - 1
    terminated = train.episode_values(schema.TERMINATED).astype(bool)[episodes]
    observations = train.step_values(schema.OBSERVATION, episodes, steps)
    return d3rlpy.dataset.MDPDataset(
        _normalised(observations, mean, std),
        train.step_values(schema.ACTION, episodes, steps),
        train.step_values(schema.REWARD, episodes, steps),
        terminals=(last & terminated).astype(np.float32),
        timeouts=(last & ~terminated).astype(np.float32),
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
    )


def _learner(config: RLConfig, device: str = "cpu:0") -> Any:
    d3rlpy = _d3rlpy()
    make = {"iql": _iql, "cql": _cql}[config.algorithm]
    return make(d3rlpy, config).create(device=device)


def _iql(d3rlpy: Any, config: RLConfig) -> Any:
    layers = d3rlpy.models.VectorEncoderFactory([256, 256])
    cosine = d3rlpy.optimizers.CosineAnnealingLRFactory(T_max=config.steps)
    settings: dict[str, Any] = {"expectile": 0.7, "weight_temp": 3.0, "tau": 0.005}
    scaler = None
    if config.task == "antmaze":
        settings |= {"expectile": 0.9, "weight_temp": 10.0}
        scaler = d3rlpy.preprocessing.ConstantShiftRewardScaler(-1.0)
    elif config.task == "hopper" and config.kind == "medium-expert":
        settings |= {"expectile": 0.5, "weight_temp": 6.0}
    elif config.task == "hopper" and config.kind in _HOPPER_NARROW:
        settings |= {"tau": 0.001}
        scaler = d3rlpy.preprocessing.ReturnBasedRewardScaler(multiplier=1000.0)
    return d3rlpy.algos.IQLConfig(
        batch_size=config.batch_size,
        max_weight=100.0,
        reward_scaler=scaler,
        actor_optim_factory=d3rlpy.optimizers.AdamFactory(lr_scheduler_factory=cosine),
        actor_encoder_factory=layers,
        critic_encoder_factory=layers,
        value_encoder_factory=layers,
        **settings,
    )


def _cql(d3rlpy: Any, config: RLConfig) -> Any:
    layers = d3rlpy.models.VectorEncoderFactory([256, 256, 256])
    settings: dict[str, Any] = {
        "actor_learning_rate": 3e-5,
        "conservative_weight": 10.0,
        "alpha_learning_rate": 0.0,
    }
    if config.task == "antmaze":
        settings = {
            "actor_learning_rate": 1e-4,
            "conservative_weight": 5.0,
            "alpha_threshold": 0.8,
            "max_q_backup": True,
            "reward_scaler": d3rlpy.preprocessing.ConstantShiftRewardScaler(-5.0, 10.0, True),
        }
    return d3rlpy.algos.CQLConfig(
        batch_size=config.batch_size,
        critic_learning_rate=3e-4,
        n_action_samples=10,
        actor_encoder_factory=layers,
        critic_encoder_factory=layers,
        **settings,
    )


def _normalised(
    states: npt.NDArray[Any], mean: npt.NDArray[Any], std: npt.NDArray[Any]
) -> FloatArray:
    normalised: FloatArray = ((states - mean) / (std + 1e-6)).astype(np.float32)
    return normalised


def _d3rlpy() -> Any:
    try:
        import d3rlpy
        import structlog
    except ImportError:
        raise InputError(
            "IQL and CQL need d3rlpy, which is not installed; install ucfrec[control,rl]"
        ) from None
    # What it says of every training, on stdout, is not what was asked for.
    level = structlog.make_filtering_bound_logger(logging.WARNING)
    structlog.configure(wrapper_class=level)
    return d3rlpy
