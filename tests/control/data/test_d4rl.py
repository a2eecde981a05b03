"""D4RL and Minari files to stores: quirks, refusals, and nothing lost between the formats."""

import json
import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from tests.support.control_files import control, hopper_like, refused, write_hdf5
from tests.support.real_data import data_folder
from ucfrec import schema
from ucfrec.arrays import Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import LOCK, SCRATCH
from ucfrec_control.data.d4rl import read_d4rl, require_inside, write_d4rl
from ucfrec_control.data.minari import read_minari, write_minari
from ucfrec_control.environments.scores import find_kind, find_task

LENGTHS, FINAL = (4, 1, 6, 3), "infos/final_observations"
SEEN = ("observations", "next_observations", FINAL)


@pytest.fixture(autouse=True)
def minari_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_hdf5(tmp_path / "hopper_medium.hdf5", hopper_like(LENGTHS))


def test_trajectories_become_episodes(file: Path, tmp_path: Path) -> None:
    columns = hopper_like(LENGTHS)
    store = read_d4rl(file).write_store(tmp_path / "store")
    assert store.lengths.tolist() == list(LENGTHS)
    assert store.episode_values(schema.TERMINATED).tolist() == [1, 0, 1, 0]
    window = store.windows(np.array([2]), np.array([3]), 4)
    pairs = {"observations": window.states, "actions": window.actions, "rewards": window.rewards}
    for name, values in pairs.items():
        np.testing.assert_array_equal(values[0], columns[name][5:9])
    np.testing.assert_allclose(store.returns[2], columns["rewards"][5:11].sum(), rtol=1e-5)
    assert store.record.source.others["env_id"] == "Hopper-v5"
    # medium-replay has float64; AntMaze stores its flags as floats.
    wide = {name: values.astype(np.float64) for name, values in columns.items()}
    read = read_d4rl(write_hdf5(tmp_path / "b.hdf5", wide))
    assert read.observations.dtype == read.rewards.dtype == np.float32
    assert read.terminated.dtype == bool
    assert read.write_store(tmp_path / "wide").record.fingerprint == store.record.fingerprint


def test_an_unfinished_last_trajectory_is_dropped_and_counted(tmp_path: Path) -> None:
    columns = hopper_like(LENGTHS)
    columns["terminals"][-1] = columns["timeouts"][-1] = False
    columns[FINAL] = columns[FINAL][:-1]
    read = read_d4rl(write_hdf5(tmp_path / "a.hdf5", columns))
    assert read.lengths.tolist() == [4, 1, 6]
    assert read.source["dropped"]["unfinished_steps"] == 3


def test_steps_on_the_goal_are_dropped_of_antmaze_alone(tmp_path: Path) -> None:
    columns = hopper_like(LENGTHS)
    ant = {name: columns[name] for name in ("rewards", "terminals", "timeouts")}
    ant |= {"observations": np.zeros((14, 29)), "actions": np.zeros((14, 8))}
    read = read_d4rl(write_hdf5(tmp_path / "antmaze-umaze-v2.hdf5", ant, env_id=None))
    assert read.lengths.tolist() == [4, 6, 3]
    assert read.source["dropped"]["one_step_trajectories"] == 1
    assert read.source["env_id"] == "d4rl/antmaze-umaze-v2"
    assert read.final_observations is None
    np.testing.assert_array_equal(read.rewards, np.delete(columns["rewards"], 4))
    assert len(read_d4rl(write_hdf5(tmp_path / "hopper.hdf5", columns)).lengths) == 4


def test_ends_are_derived_where_timeouts_are_missing(tmp_path: Path) -> None:
    columns = hopper_like(LENGTHS)
    # What comes after the last row is not known, so it is no timeout.
    columns["terminals"][-1] = True
    whole = read_d4rl(write_hdf5(tmp_path / "a.hdf5", columns))
    del columns["timeouts"]
    derived = read_d4rl(write_hdf5(tmp_path / "b.hdf5", columns))
    assert derived.lengths.tolist() == whole.lengths.tolist()
    assert derived.terminated.tolist() == whole.terminated.tolist()
    np.testing.assert_array_equal(derived.final_observations, columns[FINAL])
    del columns["next_observations"]
    with pytest.raises(InputError, match="neither timeouts nor next_observations"):
        read_d4rl(write_hdf5(tmp_path / "c.hdf5", columns))


def test_names_tell_environments_and_kinds(tmp_path: Path) -> None:
    for name, stated, given, env_id in (
        ("hopper_medium_expert-v2", None, None, "Hopper-v4"),
        ("halfcheetah", None, "Hopper-v5", "Hopper-v5"),
        ("walker2d", np.bytes_("Hopper-v5"), None, "Hopper-v5"),
        ("mine", None, None, None),
    ):
        file = write_hdf5(tmp_path / f"{name}.hdf5", hopper_like(), env_id=stated)
        assert read_d4rl(file, given).source["env_id"] == env_id
    file = "Ant_maze_{}-maze_noisy_multistart_True_multigoal_True_sparse_fixed"
    for maze, *names in (
        ("umaze", "antmaze-umaze-v2", "antmaze-umaze-diverse-v2", file.format("u")),
        ("medium", "antmaze-medium-play-v2", file.format("big")),
        ("large", "antmaze-large-diverse-v2", file.format("hardest")),
    ):
        assert {find_task(n).d4rl_env(n) for n in names} == {f"d4rl/antmaze-{maze}-v2"}
    assert find_task("antmaze").d4rl_env("antmaze-mine") is None
    assert find_kind("hopper_medium_expert-v2") == "medium-expert"
    assert find_kind("mujoco/hopper/medium-v0") == "medium"
    assert find_task("HalfCheetah-v5").score(12135.0) == 100
    assert find_task("walker2d_mixed-zoo").score([1.629008, 4592.3]).tolist() == [0, 100]
    others = ("Ant-v5", "HopperBot-v0", "grasshopper2", "mine:Hopper-v4", "MyAntMaze-v0")
    assert {find_task(name) for name in others} == {None}


def with_one(value: float) -> Callable[[Array], Array]:
    return lambda values: np.append(values.flat[1:], value).reshape(values.shape)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rewards": None}, "has no rewards"),
        ({"actions": lambda v: v[:-2]}, "actions have 12 rows, rewards have 14"),
        ({"next_observations": lambda v: v[:, :10]}, "have 10 columns, observations have 11"),
        ({"terminals": lambda v: v + 2.0}, "14 of its terminals are neither 0 nor 1"),
        ({"observations": with_one(np.nan)}, "1 number of its observations is not finite"),
        ({"rewards": with_one(-1e300)}, "1 number of its rewards is beyond single precision"),
        (dict.fromkeys(("terminals", "timeouts"), np.zeros_like), "no trajectory ends in it"),
        ({"next_observations": None, FINAL: lambda v: v[1:]}, "has 3 rows for 4 trajectories"),
        (dict.fromkeys(SEEN, lambda v: v[:, :5]), r"sizes \(5, 3\), those of hopper are \(11, 3\)"),
    ],
)
def test_other_layouts_are_refused(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    columns = hopper_like(LENGTHS)
    for name, change in changes.items():
        own = columns.pop(name)
        if change is not None:
            columns[name] = change(own)
    file = write_hdf5(tmp_path / "hopper.hdf5", columns)
    said = refused("prepare", file, "--out", tmp_path / "store")
    assert re.search(says, said)
    assert str(file) in said
    assert not (tmp_path / "store").exists()


def virtual(other: str) -> h5py.VirtualLayout:
    layout = h5py.VirtualLayout((14,), "f4")
    layout[:] = h5py.VirtualSource(other, "rewards", (14,))
    return layout


ELSEWHERE = "values of rewards lie in another file"
HUGE = {"shape": (10**13,), "chunks": (1024,), "compression": "gzip", "dtype": "f4"}


@pytest.mark.parametrize(
    ("add", "says"),
    [
        (lambda f, o: f.update(rewards=h5py.ExternalLink(o, "rewards")), "a link to another file"),
        (lambda f, _: f.update(rewards=h5py.SoftLink("/actions")), "a link to another name"),
        (lambda f, o: f.create_dataset("rewards", 14, "f4", external=[(o, 0, 56)]), ELSEWHERE),
        (lambda f, o: f.create_virtual_dataset("rewards", virtual(o)), ELSEWHERE),
        (lambda f, _: f.create_dataset("rewards", **HUGE), "claims the shape .* only 0 bytes"),
        (lambda f, _: f.create_group("rewards"), "rewards is a group"),
        (lambda f, _: f.update(rewards=np.zeros((14, 1, 1), "f4")), "not 1 or 2 dimensions"),
        (lambda f, _: f.update(rewards=["a\nb"] * 14), "not numbers"),
    ],
)
def test_what_is_not_within_the_file_is_refused(
    tmp_path: Path, add: Callable[[h5py.File, str], object], says: str
) -> None:
    columns = hopper_like()
    other = write_hdf5(tmp_path / "other.hdf5", columns)
    del columns["rewards"]
    path = write_hdf5(tmp_path / "hopper.hdf5", columns)
    with h5py.File(path, "r+") as file:
        add(file, str(other))
    with pytest.raises(InputError, match=says) as caught:
        read_d4rl(path)
    assert "\n" not in str(caught.value)


def test_links_in_groups_are_found_and_what_compresses_well_is_read(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "hopper.hdf5", hopper_like())
    with h5py.File(path, "r+") as file:
        file["infos/more"] = h5py.ExternalLink("/etc/passwd", "/")
    with pytest.raises(InputError, match="more is a link to another file"):
        require_inside(path)
    columns = hopper_like((1000,) * 50)
    columns["actions"][:] = 0
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=9)
    assert len(read_d4rl(path).rewards) == 50_000


def test_data_of_other_sizes_than_the_named_environment_is_refused(file: Path) -> None:
    write_minari(read_d4rl(file), "hopper/mine-v0")
    for source in (file, "hopper/mine-v0"):
        said = refused("prepare", source, "--out", file.parent / "s", "--env", "HalfCheetah-v5")
        assert "(11, 3), those of halfcheetah are (17, 6)" in said


def test_truncated_files_and_damaged_columns_are_refused(tmp_path: Path) -> None:
    trajectories = read_d4rl(write_hdf5(tmp_path / "a.hdf5", hopper_like((50, 60))))
    file = tmp_path / "hopper.hdf5"
    write_d4rl(trajectories, file)
    with h5py.File(file) as opened:
        chunk = opened["observations"].id.get_chunk_info(0)
    whole, (start, size) = file.read_bytes(), (chunk.byte_offset, chunk.size)
    damaged = whole[:start] + bytes(size) + whole[start + size :]
    for content in (b"", whole[:100], whole[:3000], damaged):
        file.write_bytes(content)
        says = "observations cannot be read" if content is damaged else "damaged or not HDF5"
        with pytest.raises(InputError, match=says):
            read_d4rl(file)


def test_both_formats_make_equal_stores(file: Path, tmp_path: Path, minari_folder: Path) -> None:
    back, stores = tmp_path / "back.hdf5", []
    control("convert", file, "hopper/mine-v0")
    assert "jax" not in sys.modules  # Minari's own recorder needs it
    control("convert", "hopper/mine-v0", back)
    sources = (file, "hopper/mine-v0", back, minari_folder / "hopper" / "mine-v0")
    for number, source in enumerate(sources):
        control("prepare", source, "--out", tmp_path / f"store{number}")
        stores.append(EpisodeStore.open(tmp_path / f"store{number}"))
    assert len({store.record.fingerprint for store in stores}) == 1
    assert [store.record.source.others["format"] for store in stores] == ["d4rl", "minari"] * 2
    finals = (read_d4rl(source).final_observations for source in (file, back))
    np.testing.assert_array_equal(*finals)


KILLED = """
import os, signal, sys
import minari
made = minari.create_dataset_from_buffers
def killed(*given, **named):
    made(*given, **named)
    os.kill(os.getpid(), signal.SIGKILL)
minari.create_dataset_from_buffers = killed
from ucfrec_control.cli import main
main(["convert", *sys.argv[1:]])
"""


def test_a_killed_conversion_leaves_no_dataset_or_scratch(file: Path, minari_folder: Path) -> None:
    command = [sys.executable, "-c", KILLED, file, "mine/hopper/mine-v0"]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert not (minari_folder / "mine" / "hopper" / "mine-v0").exists()
    assert [*minari_folder.rglob("main_data.hdf5")]
    folder = write_minari(read_d4rl(file), "mine/hopper/mine-v0")
    assert [path.parent.parent for path in minari_folder.rglob("main_data.hdf5")] == [folder]
    assert not [path for path in minari_folder.rglob(".*") if path.name.endswith((LOCK, SCRATCH))]
    assert "mine/hopper/mine-v0" in minari.list_local_datasets()
    assert read_minari("mine/hopper/mine-v0").lengths.tolist() == list(LENGTHS)


def test_minari_refusals(file: Path) -> None:
    trajectories, mine = read_d4rl(file), "hopper/mine-v0"

    def refuse(says: str, use: Callable[..., object], *given: object) -> None:
        with pytest.raises(InputError, match=says):
            use(*given)

    refuse("fetch it with --download", read_minari, "mujoco/hopper/medium-v0")
    refuse("not a Minari identifier", write_minari, trajectories, "no identifier")
    folder = write_minari(trajectories, mine)
    refuse("exists already", write_minari, trajectories, mine)
    own = trajectories.source | {"env_id": "mine:Own-v0"}  # whose module is not imported
    write_minari(replace(trajectories, source=own), "own/own-v0")
    assert read_minari("own/own-v0").source["env_id"] == "mine:Own-v0"
    metadata = folder / "data" / "metadata.json"
    stated = metadata.read_text()
    metadata.write_text(stated.replace("observation_space", "space"))
    refuse("states no observation and action space", read_minari, mine)
    metadata.write_text(stated)
    (folder / "data" / "main_data.hdf5").write_bytes(b"nothing")
    refuse(r"main_data\.hdf5 is damaged or not HDF5", read_minari, mine)


def test_minari_goals_are_left_out_and_unfinished_episodes_dropped(minari_folder: Path) -> None:
    """As D4RL has AntMaze: position, then the rest, without the goal."""
    box = {"dtype": np.float64, "low": -9.0, "high": 9.0}
    sizes = {"observation": 27, "achieved_goal": 2, "desired_goal": 2}
    rng = np.random.default_rng(0)
    seen = {k: rng.uniform(size=(5, n)) for k, n in sizes.items()}
    steps = {"rewards": [0.0] * 4, "terminations": [False] * 4, "infos": {}}
    steps |= {"observations": seen, "actions": rng.uniform(size=(4, 8))}
    ends = [False, False, False, True], [False] * 4
    buffers = [EpisodeBuffer(truncations=truncations, **steps) for truncations in ends]
    boxes = {name: spaces.Box(shape=(n,), **box) for name, n in sizes.items()}
    of = {"observation_space": spaces.Dict(boxes), "action_space": spaces.Box(shape=(8,), **box)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers("antmaze/made-v0", buffers, **of)
    read = read_minari("antmaze/made-v0", env_id="AntMaze_UMaze-v4")
    wanted = np.hstack([seen["achieved_goal"], seen["observation"]]).astype(np.float32)
    np.testing.assert_array_equal(read.observations, wanted[:4])
    np.testing.assert_array_equal(read.final_observations, wanted[4:])
    assert read.lengths.tolist() == [4]
    assert read.source["dropped"]["unfinished_steps"] == 4


@pytest.mark.realdata
def test_the_nine_files_score_what_their_manifest_states() -> None:
    folder = data_folder("control")
    files = json.loads((folder / "MANIFEST.json").read_text())["files"]
    assert len(files) == 9
    for stated in files:
        trajectories = read_d4rl(folder / stated["file"])
        source, returns = trajectories.source, trajectories.returns
        score = find_task(source["env_id"]).score
        assert (source["env_id"], source["versions"]["mujoco"]) == (stated["env_id"], "4.0.0")
        assert len(returns) == stated["trajectories"]
        assert len(trajectories.rewards) == stated["transitions"]
        for found, name, off in (
            (returns.mean(), "return_mean", 6e-4),
            (score(returns.mean()), "normalised_mean", 6e-4),
            (score(returns.max()), "normalised_max", 6e-4),
            (trajectories.terminated.mean(), "terminated_fraction", 6e-5),
        ):
            assert found == pytest.approx(stated[name], abs=off)
