"""The control adapter's tests need its extra; a store and runs on it that many of them use."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from ucfrec.episodes.store import EpisodeStore

_EXTRA = ("h5py", "matplotlib", "minari", "mujoco")
collect_ignore_glob = [] if all(map(find_spec, _EXTRA)) else ["*"]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small store of a made-up Hopper dataset, one with a distractor, and a run on each."""
    import torch

    from tests.support.control_files import control, set_options, write_made

    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("control")
    control("prepare", write_made(folder), "--out", folder / "store")
    control("distract", folder / "store", "--out", folder / "distracted", "--flip", 0.15)
    for data, policy in (("store", "dt"), ("distracted", "dc")):
        run = ("--out", folder / f"{data}-run", "--policy", policy, "--seed", 3)
        control("train", folder / data, *run, *set_options())
    return folder


@pytest.fixture(scope="session")
def store(folder: Path) -> EpisodeStore:
    return EpisodeStore.open(folder / "store")
