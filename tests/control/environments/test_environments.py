"""AntMaze: D4RL's vectors, D4RL's environment, success times a hundred."""

import sys
import warnings
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer

from tests.support.control_files import TINY, control, hopper_like, refused, set_options, write_hdf5
from ucfrec.acting.rollout import Memoryless, rollout
from ucfrec.arrays import Float32Array, Float64Array
from ucfrec.episodes.record import Source
from ucfrec.results.rows import read_results
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.minari import read_minari
from ucfrec_control.environments.environments import antmaze_settings, make_env, mismatches
from ucfrec_control.environments.scores import find_task
from ucfrec_control.training.evaluate import load_run, open_environment

needs_robotics = pytest.mark.skipif(
    find_spec("gymnasium_robotics") is None, reason="the extra antmaze is not installed"
)
REBUILT = "d4rl/antmaze-umaze-v2"
ENVIRONMENTS = (REBUILT, "AntMaze_UMaze-v4")
D4RL_MAZES = {
    "umaze": "##### #S..# ###.# #G..# #####",
    "medium": "######## #S.##..# #..#...# ##...### #..#...# #.#..#.# #...#.G# ########",
    "large": "############ #S...#.....# #.##.#.#.#.# #......#...# #.####.###.# #..#.#.....# "
    "##.#.#.#.### #..#...#.G.# ############",
}


def simulated(env: Any) -> Float64Array:
    """What D4RL shows of every environment: qpos, then qvel of the ant."""
    seen = []
    for one in env.envs:
        data = one.unwrapped.ant_env.data
        position = data.qpos[:2] - getattr(one.unwrapped, "origin", 0.0)
        seen.append(np.concatenate([position, data.qpos[2:15], data.qvel[:14]]))
    return np.array(seen)


def ant_columns(lengths: tuple[int, ...]) -> dict[str, Float32Array]:
    rng, n, hopper = np.random.default_rng(0), sum(lengths), hopper_like(lengths)
    columns = {name: hopper[name] for name in ("terminals", "timeouts")}
    columns |= {"rewards": columns["terminals"], "observations": rng.normal(size=(n, 29))}
    columns["actions"] = rng.uniform(-1, 1, size=(n, 8))
    return {name: values.astype(np.float32) for name, values in columns.items()}


@needs_robotics
@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_observations_are_laid_out_as_the_adapter_stores_them(env_id: str, tmp_path: Path) -> None:
    env = make_env(env_id, 2)
    rng = np.random.default_rng(0)
    shown, d4rl, actions = [env.reset(seed=0)[0]], [simulated(env)], []
    for _ in range(6):
        actions.append(rng.uniform(-1, 1, (2, 8)).astype(np.float32))
        shown.append(env.step(actions[-1])[0])
        d4rl.append(simulated(env))
    env.close()
    columns = dict.fromkeys(("rewards", "terminals"), np.zeros(12))
    columns["timeouts"] = (np.arange(12) % 6 == 5).astype(float)
    for name, values in (("observations", d4rl[:-1]), ("actions", actions)):
        columns[name] = np.concatenate(np.array(values).swapaxes(0, 1))
    file = write_hdf5(tmp_path / "antmaze-umaze-v2.hdf5", columns, env_id=None)
    store = read_d4rl(file).write_store(tmp_path / "store")
    stored = store.windows(np.arange(2), np.full(2, 5), 6).states.numpy()
    np.testing.assert_array_equal(stored, np.array(shown)[:-1].swapaxes(0, 1).astype(np.float32))


@needs_robotics
@pytest.mark.parametrize(("maze", "limit"), [("umaze", 700), ("medium", 1000), ("large", 1000)])
def test_the_rebuilt_maze_is_where_d4rl_has_it(maze: str, limit: int) -> None:
    env_id = f"d4rl/antmaze-{maze}-v2"
    env: Any = make_env(env_id, 1)
    environment = env.envs[0].unwrapped
    model = environment.ant_env.model
    # D4RL: the cell of row i and column j is at (4j − 4, 4i − 4), so that the start is at (0, 0).
    cells = {
        (4 * j - 4, 4 * i - 4): cell
        for i, row in enumerate(D4RL_MAZES[maze].split())
        for j, cell in enumerate(row)
    }
    wanted = {at for at, cell in cells.items() if cell == "#"}
    blocks = [i for i in range(model.ngeom) if model.geom(i).name.startswith("block")]
    found = model.geom_pos[blocks, :2] - environment.origin
    assert {(round(x), round(y)) for x, y in found} == wanted
    assert gymnasium.spec(env_id).max_episode_steps == limit
    assert (model.opt.timestep, set(model.actuator_gear[:, 0])) == (0.02, {30.0})
    starts, goals = [], []
    for seed in range(30):
        starts.append(env.reset(seed=seed)[0][0, :2])
        goals.append(environment.goal - environment.origin)
    env.close()
    (goal,) = (at for at, cell in cells.items() if cell == "G")
    off = np.array(goals) - goal
    assert 0 <= off.min() <= off.max() <= 1.5
    assert np.ptp(off, axis=0).min() > 1
    assert 0.05 < np.abs(starts).max() <= 0.1


class Teleported(Memoryless):
    def __init__(self, env: Any) -> None:
        self._env, self._steps = env, 0

    def act(self, observations: object, live: object) -> tuple[Float32Array, None]:
        self._steps += 1
        if self._steps == 3:
            for one in self._env.envs[::2]:
                ant = one.unwrapped.ant_env
                there = np.concatenate([one.unwrapped.goal, ant.data.qpos[2:]])
                ant.set_state(there, ant.data.qvel)
        return np.zeros((self._env.num_envs, 8), dtype=np.float32), None


@needs_robotics
@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_success_ends_the_episode_and_scores_a_hundred(env_id: str) -> None:
    env = make_env(env_id, 4, settings={"max_episode_steps": 8})
    played = rollout(env, Teleported(env), 4, seed=0)
    env.close()
    assert played.returns.tolist() == [1, 0, 1, 0]
    assert played.lengths.tolist() == [3, 8, 3, 8]
    assert find_task(env_id).score(played.returns).tolist() == [100, 0, 100, 0]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("antmaze")
    file = write_hdf5(folder / "antmaze-umaze-v2.hdf5", ant_columns((9, 1, 8) * 12), env_id=None)
    read_d4rl(file).write_store(folder / "store")
    where = (folder / "store", "--out", folder / "run", "--policy", "dt")
    control("train", *where, *set_options(TINY))
    return folder / "run"


@needs_robotics
def test_runs_on_d4rl_files_are_judged_in_d4rls_environment(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    asked = ("evaluate", run, "--checkpoint", "last", "--target", 1, "--episodes", 1)
    assert f"warning: {REBUILT} is rebuilt" in control(*asked, "--json", out)[1]
    (row,) = read_results(out)
    assert (row.environment, row["length"], row["score"]) == (REBUILT, 700, 0)
    assert "have sizes (107, 8)" in refused(*asked, "--env", "AntMaze_UMaze-v5")


@needs_robotics
def test_mazes_are_of_the_data(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    antmaze_settings("AntMaze_UMaze-v4")
    maze = [[1] * 5, [1, "g", 0, 0, 1], [1, 1, 1, 0, 1], [1, "r", 0, 0, 1], [1] * 5]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make("AntMaze_UMaze-v4", maze_map=maze, continuing_task=True)
        seen = [env.reset(seed=0)[0]]
        seen += [env.step(np.zeros(8))[0] for _ in range(3)]
        columns = {name: np.array([s[name] for s in seen]) for name in seen[0]}
        ends = {"terminations": [False] * 3, "truncations": [False, False, True], "infos": {}}
        steps = {"actions": np.zeros((3, 8)), "rewards": [0.0] * 3, **ends}
        buffer = EpisodeBuffer(observations=columns, **steps)
        minari.create_dataset_from_buffers(
            "D4RL/antmaze/umaze-v1", [buffer], env=env, requirements=["gymnasium-robotics==1.2.0"]
        )
        env.close()
    trajectories = read_minari("D4RL/antmaze/umaze-v1")
    source = trajectories.source
    assert (source["env_id"], source["env_settings"]["maze_map"]) == ("AntMaze_UMaze-v4", maze)
    assert any("gymnasium-robotics 1.2.0" in text for text in mismatches(source, source["env_id"]))
    policy = load_run(run, "last")
    data = Source.model_validate(source)
    policy = replace(policy, record=policy.record.copy_with(data=data))
    environment = open_environment(policy, source["env_id"], 1)
    starts = [environment.reset(seed=seed)[0][0] for seed in range(5)]
    np.testing.assert_array_equal(starts[0], trajectories.observations[0])
    # The cell of "r", three rows down at the left, whatever the seed.
    assert np.abs(np.array(starts)[:, :2] - (-4, -4)).max() <= 1
    environment.close()


def test_without_robotics_the_extra_is_named(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    needs = f"{REBUILT} needs gymnasium-robotics, which is not installed; install ucfrec[antmaze]"
    assert needs in refused("evaluate", run)


@needs_robotics
def test_d4rl_files_keep_their_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    file = write_hdf5(tmp_path / "antmaze-umaze-v2.hdf5", ant_columns((9, 8)), env_id=None)
    control("convert", file, "antmaze/mine-v0")
    read = read_minari("antmaze/mine-v0")
    assert (read.source["env_id"], read.source["env_settings"]) == (REBUILT, {"maze": "umaze"})
    np.testing.assert_array_equal(read.observations, read_d4rl(file).observations)
