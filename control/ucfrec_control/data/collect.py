"""Collect datasets with SAC by D4RL's protocol (Fu et al., 2020, section 5) or a saved agent."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from pydantic import Field

from ucfrec.acting.rollout import Actor, Memoryless, Step, rollout
from ucfrec.arrays import Array, BoolArray, Float32Array
from ucfrec.errors import InputError
from ucfrec.files.atomic import lock_path, read_json, remove_leftovers, write_json
from ucfrec.processes import progress, random_state_kept
from ucfrec.provenance import provenance
from ucfrec.settings import Count, require, settings_table
from ucfrec_control.data.agents import read_agent
from ucfrec_control.data.d4rl import write_d4rl
from ucfrec_control.data.sac import SacConfig, SacTraining, seed_all
from ucfrec_control.data.trajectories import PACKAGES, Trajectories
from ucfrec_control.environments.environments import SIDE_BY_SIDE, AnyEnv, make_env

SHOWN: Final = ("dataset", "trajectories", "steps", "mean_return")
_COLUMNS: Final = ("observations", "actions", "rewards")


@settings_table("")
class CollectConfig:
    """What is trained and how much is rolled out."""

    steps: Count = 1_000_000
    """Training steps, rounded up to whole episodes."""
    every: Count = 10_000
    """Steps between evaluations; each also keeps the policy and a checkpoint to resume from."""
    episodes: Count = 20
    """Episodes of an evaluation."""
    fraction: Annotated[float, Field(gt=0, lt=1)] = 1 / 3
    """Of the way from the random policy's return to the expert's, where `medium` is taken."""
    size: Count = 1_000_000
    """Steps rolled out of `medium` and of `expert`, rounded up to whole episodes."""
    sac: SacConfig = field(default_factory=SacConfig)
    """Of the training."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        require(
            self.steps > self.sac.learning_starts,
            f"steps is {self.steps}, all of them uniform actions; learning starts after "
            f"{self.sac.learning_starts}",
            "steps",
            "sac.learning_starts",
        )


@random_state_kept()
def collect(env_id: str, out: Path, seed: int, config: CollectConfig) -> list[dict[str, Any]]:
    """Train SAC and write `medium`, `medium-replay`, `expert` and `medium-expert` to `out`.

    The *expert* is the evaluated policy with the highest mean return. The *medium* policy is the
    first whose mean return is at least random + `fraction` · (expert − random). As in D4RL's
    scores, the random policy is the zero of this scale, because a fraction of a negative return
    would be meaningless. Evaluations and rollouts sample from the policy, as training does.

    `medium-replay` contains every training step up to the medium policy, and `medium-expert` is
    `medium` followed by `expert`. Training settings, policies and checkpoints are kept in
    `out/training`: repeating the call resumes an interrupted training from its last evaluation,
    with the same results. `out/MANIFEST.json` is written last.

    Returns:
        One row per dataset: `file`, `dataset`, numbers of `trajectories` and `steps`, and
        undiscounted `mean_return`.

    Raises:
        InputError: `out` is complete, was started with other settings or is being filled by another
            process, the environment cannot be created or has no step limit, its action space is not
            a `Box`, Stable-Baselines3 is not installed, or no policy beat the random policy.
    """
    with _lock_incomplete(out):
        training = _train(env_id, out / "training", seed, config)
        medium, expert = _choose(training.evaluations, training.random_return, config.fraction)
        replay = training.sac.replay(training.evaluations[medium]["steps"])
        parts = {
            "medium": training.roll_out(medium, env_id, seed, config.size),
            "medium-replay": _trajectories(replay, replay["terminals"], replay["timeouts"], env_id),
            "expert": training.roll_out(expert, env_id, seed, config.size),
        }
        parts["medium-expert"] = _join([parts["medium"], parts["expert"]])
        recorded = {"env_id": env_id, "algorithm": "SAC", "seed": seed}
        recorded |= {"fraction": config.fraction, "random_return": training.random_return}
        for name, index in (("medium", medium), ("expert", expert)):
            for key, value in training.evaluations[index].items():
                recorded[f"{name}_{key}"] = value
        names = {f"{_task(env_id)}_{kind}-sac": part for kind, part in parts.items()}
        return _write(out, names, recorded, (*PACKAGES, "stable-baselines3"))


def collect_agent(
    agent: Path, env_id: str, out: Path, *, noise: float, size: int, seed: int
) -> dict[str, Any]:
    """Let a saved agent act and write a dataset in D4RL's layout.

    Args:
        agent: file that Stable-Baselines3 or its contrib package saved.
        out: gets `TASK_AGENT.hdf5` and `MANIFEST.json`.
        noise: standard deviation of Gaussian noise on the agent's deterministic actions, in halves
            of the action space's range.
        size: steps, rounded up to whole episodes.

    Returns:
        A row as of `collect`.

    Raises:
        InputError: the agent cannot be read as data or does not fit the environment, which cannot
            be made; `noise` is negative or not finite, or `size` below 1; or `out` is complete
            already.
    """
    if not 0 <= noise < np.inf or size < 1:
        raise InputError(f"--noise {noise:g} and --size {size}: give at least 0, and at least 1")
    with _lock_incomplete(out):
        env = make_env(env_id, 1)
        shape, space = env.single_observation_space.shape or (), env.single_action_space
        env.close()
        if len(shape) != 1 or not isinstance(space, Box) or len(space.shape) != 1:
            raise InputError(f"{env_id} has no vector observations and actions")
        actor = read_agent(agent, shape[0], space, noise, seed_all((seed, 5)))
        trajectories = roll_out(actor, env_id, size, (seed, 6), f"roll out {agent.stem}")
        name = f"{_task(env_id)}_{agent.stem}" + (f"-noise{noise:g}" if noise else "")
        recorded = {"env_id": env_id, "agent": agent.name, "noise": noise, "seed": seed}
        (row,) = _write(out, {name: trajectories}, recorded, PACKAGES)
        return row


@contextmanager
def _lock_incomplete(out: Path) -> Iterator[None]:
    """Lock a folder that is not complete, without what an interrupted call left in it."""
    with lock_path(out, "filled"):
        remove_leftovers(out, within=True)
        if (out / "MANIFEST.json").exists():
            raise InputError(f"{out} is complete already; remove it or name another output folder")
        yield


def _task(env_id: str) -> str:
    return env_id.split("/")[-1].rsplit("-v", 1)[0].lower()


def _write(
    out: Path,
    parts: Mapping[str, Trajectories],
    recorded: Mapping[str, Any],
    packages: Sequence[str],
) -> list[dict[str, Any]]:
    """Write one file per dataset and the manifest, and return one row per dataset."""
    run_provenance = provenance(packages)
    rows = []
    for name, trajectories in parts.items():
        row: dict[str, Any] = {
            "file": f"{name}.hdf5",
            "dataset": name,
            "trajectories": len(trajectories.lengths),
            "steps": len(trajectories.rewards),
            "mean_return": float(trajectories.returns.mean()),
        }
        metadata = {**recorded, **row, "versions": json.dumps(run_provenance["versions"])}
        write_d4rl(trajectories, out / row["file"], metadata)
        rows.append(row)
    write_json(out / "MANIFEST.json", {**run_provenance, **recorded, "files": rows})
    return rows


@dataclass(frozen=True)
class _Training:
    sac: SacTraining
    folder: Path
    random_return: float
    evaluations: list[dict[str, Any]]
    """Training `steps` and mean `return` of every saved policy."""

    def policy(self, index: int) -> Path:
        return self.folder / f"policy-{index:04d}.safetensors"

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoint.pt"

    def roll_out(self, index: int, env_id: str, seed: int, size: int) -> Trajectories:
        """Roll out a saved policy."""
        self.sac.load_policy(self.policy(index))
        return roll_out(self.sac, env_id, size, (seed, 4, index), f"roll out policy {index}")


def _train(env_id: str, folder: Path, seed: int, config: CollectConfig) -> _Training:
    env = make_env(env_id, 1)
    limit = gymnasium.spec(env_id).max_episode_steps
    if limit is None:
        raise InputError(f"{env_id} has no step limit, so its episodes may never end")
    sac = SacTraining(env, seed, config.steps + limit, config.sac)
    claimed, settings = folder / "config.json", {"env": env_id, "seed": seed, **asdict(config)}
    if not claimed.exists():
        write_json(claimed, settings)
    elif read_json(claimed) != settings:
        raise InputError(
            f"{folder} was started with other settings; repeat those of {claimed.name}, or name "
            "another output folder"
        )
    evaluation_env = make_env(env_id, min(config.episodes, SIDE_BY_SIDE))
    uniform = _Uniform(evaluation_env, seed)
    random_return = _mean_return(evaluation_env, uniform, config.episodes, (seed, 2))
    training = _Training(sac, folder, random_return, [])
    if training.checkpoint.exists():
        training.evaluations.extend(sac.load(training.checkpoint))
    with progress(config.steps, "train SAC", "steps", done=sac.steps) as bar:
        while sac.steps < config.steps:
            steps_before = sac.steps
            sac.run_episode(bar)
            due = sac.steps // config.every > steps_before // config.every
            if due or sac.steps >= config.steps:
                _evaluate(training, evaluation_env, seed, config.episodes)
                bar.set_postfix(mean_return=training.evaluations[-1]["return"], refresh=False)
    env.close()
    evaluation_env.close()
    return training


def _evaluate(training: _Training, env: AnyEnv, seed: int, episodes: int) -> None:
    """Evaluate and save the current policy, and save a checkpoint of the sac."""
    sac, index = training.sac, len(training.evaluations)
    mean_return = _mean_return(env, sac, episodes, (seed, 3, index))
    training.evaluations.append({"steps": sac.steps, "return": mean_return})
    sac.save_policy(training.policy(index), training.evaluations[-1])
    sac.save(training.checkpoint, training.evaluations)


def _mean_return(env: AnyEnv, actor: Actor, episodes: int, key: tuple[int, ...]) -> float:
    return float(rollout(env, actor, episodes, seed_all(key), describe="evaluate").returns.mean())


class _Uniform(Memoryless):
    """Actor that chooses uniformly random actions."""

    def __init__(self, env: AnyEnv, seed: int) -> None:
        self._space = env.action_space
        self._space.seed(seed)

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, None]:
        """Return (N, A) random actions, and None."""
        return self._space.sample(), None


def _choose(
    evaluations: list[dict[str, Any]], random_return: float, fraction: float
) -> tuple[int, int]:
    """Return the indices of the medium and the expert policy in `evaluations`."""
    returns = np.array([row["return"] for row in evaluations])
    expert = int(returns.argmax())
    if returns[expert] <= random_return:
        raise InputError(
            f"the best policy returns {returns[expert]:.1f}, random actions {random_return:.1f}; "
            "train for more --steps into another folder"
        )
    threshold = random_return + fraction * (returns[expert] - random_return)
    return int((returns >= threshold).argmax()), expert


def _trajectories(
    columns: Mapping[str, Array], terminated: BoolArray, truncated: BoolArray, env_id: str
) -> Trajectories:
    """Steps of whole episodes, one after another."""
    ends = np.flatnonzero(terminated | truncated)
    return Trajectories(
        **{name: columns[name].astype(np.float32) for name in _COLUMNS},
        lengths=np.diff(ends, prepend=-1),
        terminated=terminated[ends],
        final_observations=columns["next_observations"][ends].astype(np.float32),
        source={"where": f"episodes of {env_id}", "env_id": env_id},
    )


def roll_out(
    actor: Actor, env_id: str, size: int, key: tuple[int, ...], describe: str
) -> Trajectories:
    """Roll out whole episodes, with at least `size` steps in total.

    Every round has a fixed number of episodes, so that short episodes are not overrepresented.

    Raises:
        InputError: the environment cannot be made.
    """
    # A small `size` needs few parallel episodes: the usual step limit of these tasks is 1000.
    env = make_env(env_id, min(SIDE_BY_SIDE, max(1, size // 1000)))
    rounds: list[Trajectories] = []
    names = ("episodes", *_COLUMNS, "next_observations", "terminated", "truncated")
    with progress(size, describe, "steps") as bar:
        while sum(len(part.rewards) for part in rounds) < size:
            seed = seed_all((*key, len(rounds)))
            steps: list[Step] = []
            rollout(env, actor, env.num_envs, seed, steps.append, describe="episodes")
            columns = _concatenate(steps, names)
            # The episodes ran in parallel; each becomes contiguous.
            order = np.argsort(columns["episodes"], kind="stable")
            sorted_columns = {name: values[order] for name, values in columns.items()}
            ends = sorted_columns["terminated"], sorted_columns["truncated"]
            rounds.append(_trajectories(sorted_columns, ends[0], ends[1], env_id))
            bar.update(len(rounds[-1].rewards))
    env.close()
    return _join(rounds)


def _concatenate(parts: Sequence[object], names: Sequence[str]) -> dict[str, Any]:
    """Arrays of the same attributes of several objects, one after another."""
    return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}


def _join(parts: Sequence[Trajectories]) -> Trajectories:
    """Concatenate trajectories; the source is that of the first."""
    columns = _concatenate(parts, (*_COLUMNS, "lengths", "terminated", "final_observations"))
    return Trajectories(**columns, source=parts[0].source)
