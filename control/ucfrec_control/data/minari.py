"""Read Minari datasets, local or downloaded by Minari itself, and write local ones."""

import os
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from minari.namespace import NAMESPACE_METADATA_FILENAME

from ucfrec.arrays import Array, Float32Array
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, atomic_folder
from ucfrec_control.data.d4rl import convert_singles, first_line, require_inside
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.environments.environments import antmaze_settings, is_antmaze
from ucfrec_control.environments.scores import check_sizes, dataset_name, find_task

_ROOT = "MINARI_DATASETS_PATH"
"""Environment variable with the folder in which Minari keeps its datasets."""
_IDENTIFIER = re.compile(r"([\w./-]+/)?[\w-]+-v\d+")


def is_minari(source: str) -> bool:
    """Whether `source` is a folder of a Minari dataset, or an identifier such as
    `mujoco/hopper/medium-v0` and no existing path."""
    folder = Path(source)
    return (folder / "data").is_dir() or (
        not folder.exists() and _IDENTIFIER.fullmatch(source) is not None
    )


def read_minari(source: str, env_id: str | None = None, download: bool = False) -> Trajectories:
    """Read a Minari dataset.

    Episodes that were neither terminated nor truncated are unfinished and are dropped. Goal-based
    observations become the achieved position followed by the other observations, as in D4RL; the
    desired goal is excluded.

    Args:
        env_id: environment that the data comes from; None for the one recorded in the dataset.
        download: download the dataset with Minari if it is not available locally.

    Raises:
        InputError: the dataset is missing or damaged, its observations or actions are not vectors,
            or they have other sizes than those of `env_id`.
    """
    dataset = _load(source, download)
    try:
        episodes = list(dataset.iterate_episodes())
    except Exception as error:  # Minari raises arbitrary types
        raise InputError(f"{source}: an episode cannot be read ({error}); fetch it again") from None
    complete = [e for e in episodes if len(e) and (e.terminations[-1] or e.truncations[-1])]
    observations = [_vectors(e.observations, source, "observations") for e in complete]
    for episode, seen in zip(complete, observations, strict=True):
        if len(seen) != len(episode) + 1:
            raise InputError(
                f"{source}: episode {episode.id} has {len(seen)} observations for {len(episode)} "
                "steps instead of one more"
            )
    spec = dataset.env_spec
    settings = {} if env_id or spec is None else spec.kwargs
    seen_before = _join([seen[:-1] for seen in observations], source, "observations")
    acted = [_vectors(e.actions, source, "actions") for e in complete]
    actions = _join(acted, source, "actions")
    if complete and not is_antmaze(env_id or ""):
        # Of gymnasium-robotics, newer AntMazes have other sizes than D4RL's.
        sizes = (seen_before.shape[1], actions.shape[1])
        check_sizes(find_task(env_id or ""), sizes, source)
    return Trajectories(
        observations=seen_before,
        actions=actions,
        rewards=_join([e.rewards for e in complete], source, "rewards").reshape(-1),
        lengths=np.array([len(e) for e in complete], dtype=np.int64),
        terminated=np.array([bool(e.terminations[-1]) for e in complete]),
        final_observations=_join([seen[-1:] for seen in observations], source, "observations"),
        source={
            "where": source,
            "format": "minari",
            "dataset": dataset_name(dataset.id),
            "env_id": env_id or (spec.id if spec is not None else None),
            # What configures the environment, such as the maze of AntMaze.
            "env_settings": {name: v for name, v in settings.items() if name != "render_mode"},
            "versions": _made_with(dataset.storage.metadata),
            "dropped": {
                "unfinished_steps": sum(map(len, episodes)) - sum(map(len, complete)),
                "one_step_trajectories": 0,
            },
        },
    )


def write_minari(trajectories: Trajectories, identifier: str) -> Path:
    """Write a local Minari dataset, atomically.

    Minari stores the observation after an episode's last action. If `trajectories` does not contain
    it, the last known observation is repeated, and the dataset's description says so.

    Args:
        identifier: Minari identifier of the new dataset, such as `mujoco/hopper/medium-v0`.

    Raises:
        InputError: `identifier` is invalid or already exists, or the environment is not registered.
    """
    if _IDENTIFIER.fullmatch(identifier) is None:
        raise InputError(
            f"{identifier!r} is not a Minari identifier, such as mujoco/hopper/medium-v0"
        )
    folder = _root() / identifier
    if folder.exists():
        raise InputError(f"{folder} exists already; remove it or name another dataset")
    env = gymnasium.Env[Any, Any]()  # of which Minari reads the specification alone
    env.spec = _spec(trajectories.source["env_id"])
    versions = trajectories.source["versions"].items()
    unknown = trajectories.final_observations is None
    with atomic_folder(folder) as scratch, warnings.catch_warnings():
        # Minari warns about missing authors and evaluation environments, which are unknown.
        warnings.filterwarnings("ignore", category=UserWarning, module="minari")
        datasets = scratch / "datasets"
        with _root_is(datasets):
            minari.create_dataset_from_buffers(
                identifier,
                _buffers(trajectories),
                env=env,
                observation_space=_box(trajectories.observations.shape[1]),
                action_space=_box(trajectories.actions.shape[1]),
                description=f"Converted by ucfrec from {trajectories.source['where']}."
                + (" Final observations are unknown and repeat the last one." if unknown else ""),
                requirements=[f"{name}=={version}" for name, version in versions],
            )
        for metadata in sorted(datasets.rglob(NAMESPACE_METADATA_FILENAME)):
            place = _root() / metadata.relative_to(datasets)
            if not place.exists():
                with atomic_file(place) as half:
                    shutil.copyfile(metadata, half)
        for part in sorted((datasets / identifier).iterdir()):
            part.rename(scratch / part.name)
        shutil.rmtree(datasets)
    return folder


def _buffers(trajectories: Trajectories) -> list[EpisodeBuffer]:
    finals, buffers = trajectories.final_observations, []
    ends = np.cumsum(trajectories.lengths)
    for number, (end, length) in enumerate(zip(ends, trajectories.lengths, strict=True)):
        rows, earlier = slice(end - length, end), [False] * (length - 1)
        seen, terminated = trajectories.observations[rows], bool(trajectories.terminated[number])
        last = seen[-1:] if finals is None else finals[number]
        steps: dict[str, Any] = {"actions": trajectories.actions[rows], "infos": {}}
        steps |= {"rewards": trajectories.rewards[rows].tolist(), "id": number}
        how = {"terminations": terminated, "truncations": not terminated}
        steps |= {name: [*earlier, last_step] for name, last_step in how.items()}
        buffers.append(EpisodeBuffer(observations=np.vstack([seen, last]), **steps))
    return buffers


def _load(source: str, download: bool) -> minari.MinariDataset:
    folder = Path(source) if (Path(source) / "data").is_dir() else _root() / source
    try:
        if download and not folder.is_dir():
            if find_spec("huggingface_hub") is None:
                raise InputError(
                    f"{source} is not in {_root()}, and Minari's downloads need huggingface_hub, "
                    "which is not installed; install ucfrec[minari]"
                )
            minari.download_dataset(source)
        if not folder.is_dir():
            raise InputError(
                f"the Minari dataset {source} is not in {_root()}; fetch it with --download"
            )
        for file in sorted((folder / "data").rglob("*.hdf5")):
            require_inside(file)
        metadata = MinariStorage.read_raw_metadata(folder / "data")
        if not {"observation_space", "action_space"} <= metadata.keys():
            # Without the spaces, Minari would import and start any environment that the file names.
            raise InputError(f"{source}: its metadata states no observation and action space")
        return minari.MinariDataset(folder / "data")
    except InputError:
        raise
    except Exception as error:  # Minari and its downloads raise arbitrary types
        reason = first_line(error)
        raise InputError(f"the Minari dataset {source} cannot be opened ({reason})") from None


def _root() -> Path:
    return Path(os.environ.get(_ROOT) or Path.home() / ".minari" / "datasets")


@contextmanager
def _root_is(folder: Path) -> Iterator[None]:
    """Have Minari write its datasets to another folder."""
    previous = dict(os.environ)
    folder.mkdir()
    os.environ[_ROOT] = str(folder)
    try:
        yield
    finally:
        del os.environ[_ROOT]
        os.environ.update(previous)


def _spec(env_id: str | None) -> EnvSpec | None:
    if env_id is None:
        return None
    if is_antmaze(env_id):
        antmaze_settings(env_id)
    try:
        # Data does not choose what code runs: the module that a name begins with stays unread.
        return EnvSpec(env_id) if ":" in env_id else gymnasium.spec(env_id)
    except gymnasium.error.Error as error:
        raise InputError(
            f"the environment {env_id} is not known ({error}); name it with --env, your own as "
            "MODULE:NAME"
        ) from None


def _box(size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def _vectors(values: Any, source: str, name: str) -> Array:
    if isinstance(values, Mapping) and {"achieved_goal", "observation"} <= values.keys():
        values = np.concatenate([values["achieved_goal"], values["observation"]], axis=1)
    if not isinstance(values, np.ndarray) or values.ndim != 2:
        form = "a dict" if isinstance(values, Mapping) else f"of shape {np.shape(values)[1:]}"
        raise InputError(f"{source}: its {name} are {form}, not vectors; convert them first")
    return values


def _join(parts: list[Array], source: str, name: str) -> Float32Array:
    return convert_singles(np.concatenate(parts or [np.zeros((0, 0))]), source, name)


def _made_with(metadata: Mapping[str, Any]) -> dict[str, str]:
    requirements = [str(text).partition("==") for text in metadata.get("requirements", [])]
    return {"minari": str(metadata["minari_version"])} | {
        name: version for name, separator, version in requirements if separator
    }
