"""From raw trajectories of one's own robot to an action, in Python and in onnxruntime."""

import json
import re
import runpy
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from tests.support.control_files import TINY, control, refused, set_options, write_hdf5
from tests.support.markdown import ROOT
from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.results.rows import read_results
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy
from ucfrec_control import ControlPolicy
from ucfrec_control.data.trajectories import Trajectories

EPISODES = ("--episodes", 2, "--checkpoint", "last")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`run` of a Pendulum, whose returns no reference is known for, from an HDF5 file."""
    made = tmp_path_factory.mktemp("pendulum")
    env, rng = gymnasium.make("Pendulum-v1", max_episode_steps=40), np.random.default_rng(0)
    names = ("observations", "actions", "rewards", "terminals", "timeouts")
    columns: dict[str, list[object]] = {name: [] for name in names}
    for seed in range(24):
        observation, ended = env.reset(seed=seed)[0], False
        while not ended:
            action = rng.uniform(-2, 2, 1).astype(np.float32)
            following, reward, terminated, truncated, _ = env.step(action)
            step = (observation, action, reward, terminated, truncated)
            for name, value in zip(names, step, strict=True):
                columns[name].append(value)
            observation, ended = following, terminated or truncated
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    file = write_hdf5(made / "pendulum.hdf5", arrays, env_id="Pendulum-v1")
    control("prepare", file, "--out", made / "store")
    for name, settings in (("ucf", TINY), ("bc", TINY[:3])):
        where = (made / "store", "--out", made / name, "--policy", name)
        said, notes = control("train", *where, *set_options(settings))
        assert "train.warmup_steps is 10000, of 4 train.steps" in notes
        returns = np.add.reduceat(arrays["rewards"], np.arange(0, 960, 40))
        assert f"behaviour     mean return {returns.mean():.4g} of 24" in said
        assert f"best quarter  mean return {np.sort(returns)[-6:].mean():.4g} of 6" in said
    (made / "run").symlink_to(made / "ucf")
    return made


Steps = list[np.ndarray]


def play(policy: ControlPolicy, steps: int) -> tuple[Steps, Steps, list[float]]:
    env = gymnasium.make("Pendulum-v1")
    observations, actions, rewards = [env.reset(seed=3)[0]], [], []
    policy.reset()
    for _ in range(steps):
        actions.append(policy.act(observations[-1], rewards[-1] if rewards else None))
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(float(reward))
    return observations, actions, rewards


@pytest.mark.parametrize("name", ["ucf", "bc"])
def test_onnxruntime_acts_as_python_does(folder: Path, tmp_path: Path, name: str) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="needs ucfrec[export]")
    control("export", folder / name, "--out", tmp_path / "graph")
    described = json.loads((tmp_path / "graph" / "model.json").read_text())
    session = onnxruntime.InferenceSession(str(tmp_path / "graph" / "model.onnx"))
    assert described["inputs"].keys() == {entry.name for entry in session.get_inputs()}
    policy, k = ControlPolicy.load(folder / name), described["context"]
    observations, actions, rewards = play(policy, 3 * k + 2)
    play(policy, 2)  # an episode before must not count
    assert [row.tolist() for row in play(policy, 5)[1]] == [row.tolist() for row in actions[:5]]
    for step, action in enumerate(actions):
        window = {
            "observations": np.zeros((1, k, 3), dtype=np.float32),
            "actions": np.zeros((1, k, 1), dtype=np.float32),
            "rewards": np.zeros((1, k), dtype=np.float32),
        }
        seen = min(k, step + 1)
        window["observations"][0, k - seen :] = observations[step + 1 - seen : step + 1]
        window["actions"][0, k - seen : -1] = actions[step + 1 - seen : step] or np.zeros((0, 1))
        window["rewards"][0, k - seen : -1] = rewards[step + 1 - seen : step]
        window["steps"] = np.array([step])
        left = (described["target_return"] or 0.0) - sum(rewards[:step])
        window["target_return"] = np.array([left], dtype=np.float32)
        inputs = {key: value for key, value in window.items() if key in described["inputs"]}
        np.testing.assert_allclose(session.run(None, inputs)[0][0], action, atol=1e-5)


def test_the_documented_lines_act(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    runpy.run_path(str(ROOT / "examples" / "control_loop.py"))
    total = float(capsys.readouterr().out.split()[1])
    control("evaluate", "run", "--episodes", 1, "--seed", 0, "--json", folder / "rows.json")
    assert total == pytest.approx(read_results(folder / "rows.json")[0]["return"], abs=0.06)


def test_returns_are_raw_without_references(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    control("evaluate", folder / "run", *EPISODES, "--json", out)
    (row,) = read_results(out)
    assert (row.metric, "score" in row.metrics) == ("return", False)
    assert row.interval is not None
    assert row.interval[0] <= row.value == row["return"] <= row.interval[1]
    control("evaluate", folder / "run", *EPISODES, "--reference", -900, -100, "--json", out)
    (scored,) = read_results(out)
    assert scored.value == pytest.approx((row.value + 900) / 8)
    for high in ("5", "inf"):
        said = refused("evaluate", folder / "run", *EPISODES, "--reference", 5, high)
        assert f"--reference 5 {high}: give two numbers, the higher one second" in said


def test_observations_that_do_not_fit_are_refused(folder: Path) -> None:
    policy = ControlPolicy.load(folder / "run", target=-100.0)
    assert getattr(policy.rule, "target", None) == -100
    for observation, says in (([0.0, 1.0], "vectors of 3"), ([0.0, np.nan, 1.0], "not finite")):
        with pytest.raises(InputError, match=says):
            policy.act(observation)


def test_the_return_is_estimated_with_reasons_against_it(folder: Path) -> None:
    said = control("ope", folder / "run", folder / "store", "--discount", 0.9)[0]
    # Torques drawn at random tell nothing of a policy that does not draw them.
    assert "do not rely on the estimate: the policy's actions are far" in said
    assert re.search(r"policy +-\d+.*\[-.*\nbehaviour +-\d+", said)
    rewards = EpisodeStore.open(folder / "store").column(schema.REWARD).reshape(24, 40)
    returns = np.sort(rewards @ 0.9 ** np.arange(40))
    assert f"behaviour     {returns.mean():.4g}, logged\n" in said
    assert f"best quarter  {returns[-6:].mean():.4g}, logged\nA time limit ended 24 traj" in said
    assert "discount is 1" in refused("ope", folder / "run", folder / "store", "--discount", 1)


def test_units_do_not_matter(folder: Path, tmp_path: Path) -> None:
    store = EpisodeStore.open(folder / "store")
    source = {"where": "here", "dataset": "small", "env_id": None, "versions": {}}
    names = (schema.OBSERVATION, schema.ACTION, schema.REWARD)
    seen, *others = (store.column(name) / 2**30 for name in names)
    ends = store.lengths, store.terminated.astype(bool), None
    with pytest.raises(InputError, match=r"shape \(960, 0\), so no numbers"):
        Trajectories(seen[:, :0], *others, *ends, source)
    trajectories = Trajectories(seen, *others, *ends, source)
    small = trajectories.write_store(tmp_path / "store")
    losses = []
    for data in (store, small):
        policy = new_policy(data.split("train"), resolve_config("dt", None, TINY)).eval()
        windows = data.split("train").windows(np.zeros(30, dtype=int), np.arange(30), 5)
        losses.append(float(policy.action_loss(windows)))
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
