"""Control datasets made up for tests, and commands on them."""

import shutil
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import h5py
import numpy as np

from tests.support.records import MISSING, damaged
from ucfrec.arrays import Array
from ucfrec.files.atomic import read_json
from ucfrec_control.cli import main

Columns = dict[str, Array]
MADE = "hopper_medium-made"
TINY = ("train.steps=4", "train.validate_every=2", "policy.dim=16", "policy.context=5")


def hopper_like(lengths: tuple[int, ...] = (4, 1, 6, 3), seed: int = 0) -> Columns:
    """Columns of a Hopper-sized file; every second trajectory ends by the step limit."""
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    ends = np.cumsum(lengths) - 1
    terminals, timeouts = (np.isin(np.arange(n), ends[first::2]) for first in (0, 1))
    observations = rng.normal(size=(n, 11)).astype(np.float32)
    finals = rng.normal(size=(len(lengths), 11)).astype(np.float32)
    following = np.vstack([observations[1:], observations[:1]])
    following[ends] = finals
    return {
        "observations": observations,
        "actions": rng.uniform(-1, 1, size=(n, 3)).astype(np.float32),
        "rewards": rng.normal(size=n).astype(np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
        "next_observations": following,
        "infos/final_observations": finals,
    }


def write_hdf5(path: Path, columns: Columns, env_id: str | None = "Hopper-v5") -> Path:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
        if env_id is not None:
            file.attrs["env_id"] = env_id
    return path


def write_made(folder: Path, name: str = MADE) -> Path:
    """A file of 24 trajectories."""
    return write_hdf5(folder / f"{name}.hdf5", hopper_like((30, 8, 25) * 8))


def set_options(settings: Iterable[str] = TINY) -> list[str]:
    return [part for setting in settings for part in ("--set", setting)]


def control(*arguments: object, status: int = 0) -> tuple[str, str]:
    """What `ucfrec-control` prints to the output and as errors."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as errors:
        try:
            ended = main([str(argument) for argument in arguments])
        except SystemExit as error:
            ended = int(error.code or 0)
    assert ended == status, errors.getvalue()
    return out.getvalue(), errors.getvalue()


def refused(*arguments: object) -> str:
    """The one line that a refused command says, after the usage where an option is wrong."""
    lines = control(*arguments, status=2)[1].strip().splitlines()
    assert len(lines) == 1 or lines[0].startswith("usage: ")
    return lines[-1]


def changed(run: Path, to: Path, entry: tuple[str, ...], value: object) -> Path:
    """A copy of a run with another value of an entry of its record; None takes it out."""
    shutil.copytree(run, to)
    damage = MISSING if value is None else value
    damaged(to / "run.json", read_json(run / "run.json"), entry, damage)
    return to
