"""Datasets collected by D4RL's protocol: what is in the files, and that a seed decides it."""

import dataclasses
import json
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import pytest

from ucfrec.errors import InputError
from ucfrec.processes import progress

pytest.importorskip("mujoco", reason="needs ucfrec[control]")
pytest.importorskip("stable_baselines3", reason="needs ucfrec[collect]")

from ucfrec_control.data import collect as module
from ucfrec_control.data.collect import CollectConfig, collect
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.sac import SacConfig, SacTraining
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.environments.scores import find_kind

ENV = "InvertedPendulum-v5"
SAC = SacConfig(learning_starts=60, batch_size=64, hidden=32, learning_rate=3e-3)
CONFIG = CollectConfig(steps=360, every=90, episodes=20, size=400, fraction=0.5, sac=SAC)
NAMES = ("medium", "medium-replay", "expert", "medium-expert")
FIELDS = ("observations", "actions", "rewards", "lengths", "terminated", "final_observations")


def read(folder: Path, kind: str) -> Trajectories:
    return read_d4rl(folder / f"invertedpendulum_{kind}-sac.hdf5")


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collected") / "out"
    collect(ENV, folder, 3, CONFIG)
    return folder


def test_medium_is_the_first_past_the_threshold_and_replay_all_before_it(collected: Path) -> None:
    said = json.loads((collected / "MANIFEST.json").read_text())
    sac = SacTraining(module.make_env(ENV, 1), 3, 10, CONFIG.sac)
    files = sorted((collected / "training").glob("policy-*.safetensors"))
    about = [sac.load_policy(file) for file in files]
    assert said["expert_return"] == max(row["return"] for row in about)
    threshold = 0.5 * (said["random_return"] + said["expert_return"])
    before = [row["return"] for row in about if row["steps"] < said["medium_steps"]]
    assert said["medium_return"] >= threshold > max(before, default=-np.inf)
    assert said["expert_return"] > said["random_return"]
    replay = read(collected, "medium-replay")
    assert len(replay.rewards) == replay.lengths.sum() == said["medium_steps"]
    # The first steps are uniform, over the pendulum's own range of ±3.
    assert 2.5 < np.abs(replay.actions[: CONFIG.sac.learning_starts]).max() <= 3


def test_recorded_steps_are_what_the_environment_does(collected: Path) -> None:
    env = module.make_env(ENV, 1).envs[0].unwrapped
    env.reset(seed=0)
    for kind in ("medium-replay", "expert"):
        data, start = read(collected, kind), 0
        for index, length in enumerate(data.lengths[:5]):
            states = data.observations[start : start + length]
            after = np.vstack([states[1:], data.final_observations[index : index + 1]])
            for state, action, then in zip(states, data.actions[start:], after, strict=False):
                env.set_state(state[:2].astype(np.float64), state[2:].astype(np.float64))
                stepped, *_ = env.step(action)
                np.testing.assert_allclose(stepped, then, atol=1e-4)
            # It fell, unless it stood to the last of a thousand steps.
            assert data.terminated[index] == (abs(after[-1, 1]) > 0.2) == (length < 1000)
            start += length


def test_files_say_what_they_are(collected: Path) -> None:
    said = json.loads((collected / "MANIFEST.json").read_text())
    assert [find_kind(row["dataset"]) for row in said["files"]] == list(NAMES)
    for kind, row in zip(NAMES, said["files"], strict=True):
        data = read(collected, kind)
        assert data.source["env_id"] == ENV
        assert data.source["versions"] == said["versions"]
        assert (len(data.rewards), len(data.lengths)) == (row["steps"], row["trajectories"])
        assert data.returns.mean() == pytest.approx(row["mean_return"])
        with h5py.File(collected / row["file"]) as file:
            assert file["metadata/seed"][()] == 3
            assert file["metadata/expert_return"][()] == said["expert_return"]
            ends = file["terminals"][:] | file["timeouts"][:]
            inside = np.flatnonzero(~ends)
            following = file["next_observations"][:]
            np.testing.assert_array_equal(following[inside], file["observations"][:][inside + 1])
    medium, expert, both = (read(collected, kind) for kind in ("medium", "expert", "medium-expert"))
    assert min(len(medium.rewards), len(expert.rewards)) >= CONFIG.size
    for name in FIELDS:
        joined = np.concatenate([getattr(medium, name), getattr(expert, name)])
        np.testing.assert_array_equal(getattr(both, name), joined)


def test_an_episode_cut_by_the_step_limit_is_a_timeout() -> None:
    sac = SacTraining(module.make_env("Pendulum-v1", 1), 0, 1000, SacConfig())
    with progress(None, "play", "steps") as bar:
        for _ in range(2):
            sac.run_episode(bar)
    replay = sac.replay(sac.steps)
    assert np.flatnonzero(replay["timeouts"]).tolist() == [199, 399]
    assert not replay["terminals"].any()
    # What the last action led to is the old episode's; what follows is a new start.
    states, after = replay["observations"], replay["next_observations"]
    goes_on = (after[:-1] == states[1:]).all(axis=1)
    assert np.flatnonzero(~goes_on).tolist() == [199]


@pytest.mark.parametrize("fraction", [0.1, 1 / 3, 0.9])
def test_the_threshold_lies_between_random_and_expert_also_below_zero(fraction: float) -> None:
    returns = [-1200.0, -900.0, -1100.0, -300.0, -200.0, -600.0]
    rows = [{"return": value} for value in returns]
    medium, expert = module._choose(rows, -1250.0, fraction)
    assert expert == 4
    assert [(value + 1250) / 1050 >= fraction for value in returns].index(True) == medium
    with pytest.raises(InputError, match=r"random actions -100\.0; train for more"):
        module._choose(rows, -100.0, fraction)


def test_an_interrupted_collection_ends_as_an_uninterrupted_one(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, evaluated = iter(range(5)), module._evaluate

    def interrupted(*given: object) -> None:
        if next(calls) == 2:
            raise KeyboardInterrupt
        evaluated(*given)

    monkeypatch.setattr(module, "_evaluate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collect(ENV, tmp_path / "out", 3, CONFIG)
    assert not list((tmp_path / "out").glob("*.hdf5"))
    collect(ENV, tmp_path / "out", 3, CONFIG)
    assert next(calls, None) is None
    for kind, name in product(NAMES, FIELDS):
        whole, resumed = (getattr(read(at, kind), name) for at in (collected, tmp_path / "out"))
        np.testing.assert_array_equal(whole, resumed, err_msg=name)


def test_bad_input_is_refused(collected: Path, tmp_path: Path) -> None:
    for says, env, out, changes in (
        ("complete already", ENV, collected, {}),
        ("fraction is 1", ENV, tmp_path / "out", {"fraction": 1}),
        ("learning starts after 60", ENV, tmp_path / "out", {"steps": 60}),
        ("actions in a box", "CartPole-v1", tmp_path / "cart", {}),
    ):
        with pytest.raises(InputError, match=says):
            collect(env, out, 3, dataclasses.replace(CONFIG, **changes))
    assert list(tmp_path.iterdir()) == []
    (collected / "MANIFEST.json").rename(tmp_path / "MANIFEST.json")
    with pytest.raises(InputError, match="started with other settings"):
        collect(ENV, collected, 4, CONFIG)
    (tmp_path / "MANIFEST.json").rename(collected / "MANIFEST.json")
