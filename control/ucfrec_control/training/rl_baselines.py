"""IQL and CQL of d3rlpy (extra `rl`) on control stores, with CORL's settings (reference §3)."""

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, PlainSerializer, PlainValidator
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import Memoryless
from ucfrec.arrays import Array, BoolArray, Float32Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import atomic_file, atomic_folder, lock_path, remove_leftovers
from ucfrec.files.record import Count as Steps
from ucfrec.files.record import Entry
from ucfrec.fitting.checkpoint import MetricsLog, load_tensors, load_weights, save_tensors
from ucfrec.processes import progress, random_state_kept
from ucfrec.provenance import command_line, versions
from ucfrec.runs.record import RUN, RunRecord, TrainingRecord
from ucfrec.settings import BatchSize, Count, settings_table
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.environments.scores import find_kind, find_task

ALGORITHMS = ("iql", "cql")
CHECKPOINT_EVERY = 5000
"""Steps between checkpoints and log lines."""
_ACTOR, _CHECKPOINT = "actor.safetensors", "checkpoint.pt"
_HOPPER_NARROW = ("medium", "medium-replay", "mixed")


@settings_table("rl")
class RLConfig:
    """Settings of a training."""

    algorithm: Literal["iql", "cql"]
    """Algorithm of d3rlpy."""
    steps: Count
    """Number of updates."""
    task: str
    """Name of a `ucfrec_control.environments.scores.Task`, or ""; selects CORL's settings."""
    kind: str
    """Kind of dataset (`ucfrec_control.environments.scores.find_kind`); selects CORL's settings."""
    batch_size: BatchSize = 256
    """Transitions of an update."""
    learning_rate: Annotated[float, Field(gt=0, lt=1)] = 3e-4
    """Of the critics; CORL's by default. All other rates keep CORL's proportion to it."""


def _rl_config(value: object) -> RLConfig:
    if isinstance(value, RLConfig):
        return value
    if not isinstance(value, dict):
        raise InputError("its settings are not a table")
    return RLConfig(**value)


class RLRun(Entry):
    """Settings and seed of a run."""

    policy_name: Literal["iql", "cql"]
    policy: Annotated[RLConfig, PlainValidator(_rl_config), PlainSerializer(asdict)]
    seed: int


class RLFit(Entry):
    """The outcome of a training; no checkpoint but the last is kept."""

    steps: Steps
    best_step: None = None
    best_validation: None = None


class RLRecord(TrainingRecord):
    """The content of `run.json` of a run of `train_rl`."""

    library: Literal["d3rlpy"]
    config: RLRun
    policy: RLFit | None = None
    threads: int
    augmentation: None = None

    @property
    def name(self) -> str:
        """Name of the method."""
        return self.config.policy_name

    @property
    def settings(self) -> dict[str, Any]:
        """The configuration as JSON."""
        return self.config.model_dump()

    @property
    def finished(self) -> RLFit:
        """The report of the training. InputError if the training has not ended."""
        if self.policy is None:
            raise InputError("the training of the run has not ended; train it to its end first")
        return self.policy


def read_run(run: Path) -> RunRecord | RLRecord:
    """The record of a run of ucfrec or of d3rlpy. InputError if `run` is not a run folder, or is
    damaged."""
    rl = TrainingRecord.read(run).library == "d3rlpy"
    return RLRecord.read(run) if rl else RunRecord.read(run)


class RLPolicy(Memoryless):
    """The trained actor of a run folder; it takes no target return."""

    def __init__(self, run: Path) -> None:
        """Raises:
        InputError: `run` is unfinished, or d3rlpy is not installed.
        """
        self.record = RLRecord.read(run)
        self.name: str = self.record.name
        tensors, _ = load_tensors(run / _ACTOR)
        with damage_explained(run, "train it again"):
            mean, std = (tensors.pop(f"state.{name}") for name in ("mean", "std"))
            sizes = self.record.sizes
            if not mean.shape == std.shape == (sizes["state"],):
                raise ValueError(f"statistics of {tuple(mean.shape)} states")
            self._mean, self._std = mean.numpy(), std.numpy()
            with random_state_kept():
                self._algorithm = _algorithm(self.record.config.policy)
                self._algorithm.create_impl((sizes["state"],), sizes["action"])
        load_weights(run / _ACTOR, self._algorithm.impl.modules.policy, tensors)

    def actor(self, episodes: int, rule: DecisionRule | None) -> "RLPolicy":
        """Itself: it has no memory and ignores the target return."""
        return self

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, None]:
        """The policy's mean actions (N, A)."""
        return self._algorithm.predict(_normalise(observations, self._mean, self._std)), None


def rl_config(dataset: Mapping[str, Any], algorithm: Any, **settings: Any) -> RLConfig:
    """The settings for the data that `ucfrec_control.training.train.dataset_of` describes.

    Args:
        algorithm: one of `ALGORITHMS`.
        settings: the other fields of `RLConfig`.
    """
    task = find_task(dataset["env_id"] or dataset["dataset"])
    kind = find_kind(dataset["dataset"])
    return RLConfig(algorithm=algorithm, task=task.name if task else "", kind=kind, **settings)


def plain_config(config: RLConfig, seed: int) -> dict[str, Any]:
    """`config` and `seed` in the form of a run's record."""
    return {"policy_name": config.algorithm, "policy": asdict(config), "seed": seed}


@random_state_kept()
def train_rl(store: EpisodeStore, out: Path, config: RLConfig, seed: int) -> RLRecord:
    """Train on the training trajectories, or go on from the checkpoint in `out`; returns the record
    of the run.

    A finished run is read, not repeated. One that was killed and is started again ends with the
    same actor as one left alone (same machine and device). The global random state is as before on
    return. InputError if d3rlpy is not installed, `out` is of another configuration or other data,
    or another process is training in it.
    """
    with lock_path(out, "trained"):
        remove_leftovers(out, within=True)
        if not (out / RUN).exists():
            return _train(store, out, config, seed)
        existing = RLRecord.read(out)
        expected = (plain_config(config, seed), store.record.fingerprint)
        if (existing.settings, existing.fingerprint) != expected:
            raise InputError(
                f"{out} has a run with other settings or data; remove it or name another folder"
            )
        return _train(store, out, config, seed) if existing.policy is None else existing


def _train(store: EpisodeStore, out: Path, config: RLConfig, seed: int) -> RLRecord:
    """`train_rl` of a run that no other process trains and that has not ended."""
    d3rlpy, started = _d3rlpy(), perf_counter()
    d3rlpy.seed(seed)
    train = store.split("train")
    if not train.n_episodes:
        raise InputError(
            f"{store.path} has no training trajectories; prepare it with a later split"
        )
    mean, std = _statistics(train, config)
    dataset = _dataset(d3rlpy, train, mean.numpy(), std.numpy())
    algorithm = _algorithm(config, "cuda:0" if torch.cuda.is_available() else "cpu:0")
    if not (out / RUN).exists():
        _begin(store, out, config, seed)
    record, checkpoint = RLRecord.read(out), out / _CHECKPOINT
    step, seconds = _resume(checkpoint, algorithm, dataset)
    log = MetricsLog(out, step)
    quiet = {"logger_adapter": d3rlpy.logging.NoopAdapterFactory(), "show_progress": False}
    with progress(config.steps, config.algorithm, "steps", done=step) as bar:
        while step < config.steps:
            if step:  # a new seed after each checkpoint, so no generator's state is saved
                d3rlpy.seed(seed + step)
            steps = min(CHECKPOINT_EVERY, config.steps - step)
            size = {"n_steps": steps, "n_steps_per_epoch": steps}
            how = {"callback": lambda *_: bar.update(), **quiet}
            ((_, losses),) = algorithm.fit(dataset, **size, **how)
            step += steps
            log.add(step, losses)
            state: dict[str, Any] = {"step": step, "seconds": seconds + perf_counter() - started}
            state["parts"] = {name: part.state_dict() for name, part in _parts(algorithm).items()}
            with atomic_file(checkpoint) as scratch:
                torch.save(state, scratch)
    log.close()
    actor = algorithm.impl.modules.policy.state_dict()
    save_tensors(out / _ACTOR, {**actor, "state.mean": mean, "state.std": std}, {})
    record = record.copy_with(
        policy=RLFit(steps=config.steps), wall_time_s=seconds + perf_counter() - started
    )
    if checkpoint.exists():
        record.write(out)
        checkpoint.unlink()
    return record.seal(out)


def _begin(store: EpisodeStore, out: Path, config: RLConfig, seed: int) -> None:
    (action_size,) = store.record.columns[schema.ACTION]
    entries = {
        "files": {},
        "library": "d3rlpy",
        "command": command_line(),
        "config": plain_config(config, seed),
        "seed": seed,
        "sizes": {"state": store.state_size, "items": 0, "action": action_size},
        "fingerprint": store.record.fingerprint,
        "data": store.record.source,
        "versions": versions((*PACKAGES, "d3rlpy")),
        "threads": torch.get_num_threads(),
        "wall_time_s": 0.0,
    }
    with atomic_folder(out) as scratch:
        RLRecord.of(entries, out / RUN).seal(scratch)


def _resume(path: Path, algorithm: Any, dataset: Any) -> tuple[int, float]:
    """Put the checkpoint at `path`, if any, into `algorithm`; its step and the seconds spent."""
    if not path.exists():
        return 0, 0.0
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    algorithm.build_with_dataset(dataset)
    for name, part in _parts(algorithm).items():
        part.load_state_dict(checkpoint["parts"][name])
    algorithm.set_grad_step(checkpoint["step"])
    return checkpoint["step"], checkpoint["seconds"]


def _parts(algorithm: Any) -> Mapping[str, Any]:
    """Every network and optimizer, by name."""
    parts: Mapping[str, Any] = algorithm.impl.modules.create_checkpointer("cpu:0").modules
    return parts


def _dataset(d3rlpy: Any, train: EpisodeStore, mean: Array, std: Array) -> Any:
    episodes, steps = train.all_steps()
    last = steps == train.lengths[episodes] - 1
    terminated = train.episode_values(schema.TERMINATED).astype(bool)[episodes]
    observations = train.step_values(schema.OBSERVATION, episodes, steps)
    return d3rlpy.dataset.MDPDataset(
        _normalise(observations, mean, std),
        train.step_values(schema.ACTION, episodes, steps),
        train.step_values(schema.REWARD, episodes, steps),
        terminals=(last & terminated).astype(np.float32),
        timeouts=(last & ~terminated).astype(np.float32),
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
    )


def _statistics(train: EpisodeStore, config: RLConfig) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (S,) that states are normalised with; 0 and 1 where CORL does not
    normalise them."""
    mean, std = train.state_statistics
    if config.algorithm == "cql" and config.task == "antmaze":
        return torch.zeros_like(mean), torch.ones_like(std)
    return mean, std + 1e-6


def _algorithm(config: RLConfig, device: str = "cpu:0") -> Any:
    d3rlpy = _d3rlpy()
    if config.algorithm == "iql":
        return _iql(d3rlpy, config).create(device=device)
    return _cql(d3rlpy, config).create(device=device)


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
        **{f"{part}_encoder_factory": layers for part in ("actor", "critic", "value")},
        actor_learning_rate=config.learning_rate,
        critic_learning_rate=config.learning_rate,
        **settings,
    )


def _cql(d3rlpy: Any, config: RLConfig) -> Any:
    encoder, rate = d3rlpy.models.VectorEncoderFactory, config.learning_rate
    antmaze = config.task == "antmaze"
    slower = rate / (3 if antmaze else 10)
    settings: dict[str, Any] = {"conservative_weight": 10.0, "alpha_learning_rate": 0.0}
    if config.task == "hopper" and config.kind == "medium":
        settings["reward_scaler"] = d3rlpy.preprocessing.ReturnBasedRewardScaler(multiplier=1000.0)
    if antmaze:
        settings = {
            "alpha_learning_rate": rate,
            # CORL starts the logarithm of its multiplier at 1.
            "initial_alpha": math.e,
            "conservative_weight": 5.0,
            "alpha_threshold": 0.8,
            "max_q_backup": True,
            "reward_scaler": d3rlpy.preprocessing.ConstantShiftRewardScaler(-5.0, 10.0, True),
        }
    return d3rlpy.algos.CQLConfig(
        batch_size=config.batch_size,
        critic_learning_rate=rate,
        actor_learning_rate=slower,
        temp_learning_rate=slower,
        n_action_samples=10,
        actor_encoder_factory=encoder([256] * 3),
        critic_encoder_factory=encoder([256] * (5 if antmaze else 3)),
        **settings,
    )


def _normalise(states: Array, mean: Array, std: Array) -> Float32Array:
    return np.asarray(((states - mean) / std).astype(np.float32))


def _d3rlpy() -> Any:
    try:
        import d3rlpy
        import structlog
    except ImportError:
        raise InputError(
            "IQL and CQL need d3rlpy, which is not installed; install ucfrec[rl]"
        ) from None
    # It logs every training to stdout, and warns that networks exist already, which is intended
    # after a checkpoint.
    level = structlog.make_filtering_bound_logger(logging.ERROR)
    structlog.configure(wrapper_class=level)
    return d3rlpy
