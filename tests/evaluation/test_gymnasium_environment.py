"""Any Gymnasium environment is an environment: its actions, observations, users, logs and seeds."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces

from tests.support.gymnasium_environments import ITEMS, LENGTH
from ucfrec.acting.rollout import Step, Uniform, rollout
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.evaluation.gymnasium_environment import GymnasiumEnvironment, item_table
from ucfrec.evaluation.simulator import Environment, environment_items
from ucfrec.results.rows import read_results
from ucfrec.schema import USER_IDS

MODULE = "tests.support.gymnasium_environments"


def environment(
    name: str, num_envs: int = 3, observe: tuple[str, ...] = ()
) -> GymnasiumEnvironment:
    return GymnasiumEnvironment(f"{MODULE}:ucfrec-test/{name}-v0", num_envs, observe)


@pytest.mark.parametrize(
    ("name", "first"), [("Discrete", 0), ("Discrete-from-3", 3), ("MultiDiscrete", 0)]
)
def test_single_items_are_numbered_from_0(name: str, first: int) -> None:
    env = environment(name)
    assert env.single_action_space == spaces.Discrete(ITEMS)
    assert environment_items(env).tolist() == [0, 1, 2, 3]
    env.reset(seed=0)
    _, rewards, _, _, _ = env.step(np.array([0, 3, 1]))
    np.testing.assert_array_equal(rewards, first + np.array([0, 3, 1]))
    for actions in ([0, 1], [[0]] * 3, [0, 1, ITEMS], [-1, 0, 1], [0.5, 0, 1]):
        with pytest.raises(InputError, match=r"3 sessions take one action of Discrete\(4\) each"):
            env.step(np.array(actions))


def test_vectors_are_played_within_their_bounds() -> None:
    env = environment("Box", 2, ("secret",))
    env.reset(seed=0)
    _, rewards, _, _, _ = env.step(np.array([[0.5, -9, 9], [0, 0, 0]], dtype=np.float32))
    np.testing.assert_allclose(rewards, [0.5 - 1 + 2, 0])
    with pytest.raises(InputError, match=r"2 sessions take .* of shape \(3, 3\)"):
        env.step(np.zeros((3, 3), dtype=np.float32))


def test_named_entries_are_observed_in_their_order() -> None:
    env = environment("Discrete", 3, ("secret", "step"))
    observations, _ = env.reset(seed=0)
    assert observations.shape == (3, 2 + LENGTH + 1)
    assert observations.dtype == np.float32
    np.testing.assert_array_equal(observations[:, 0], observations[:, 1])
    assert len(np.unique(observations[:, 0])) == 3, "sessions are not copies of each other"
    np.testing.assert_array_equal(observations[:, 2:], np.eye(LENGTH + 1)[[0, 0, 0]])
    swapped, _ = environment("Discrete", 3, ("step", "secret")).reset(seed=0)
    np.testing.assert_array_equal(swapped, np.roll(observations, LENGTH + 1, axis=1))
    # Neighbouring seeds share no session.
    env = environment("Discrete", 50, ("secret",))
    secrets = [env.reset(seed=seed)[0][:, 0] for seed in (0, 1, 0)]
    np.testing.assert_array_equal(secrets[0], secrets[2])
    assert not set(secrets[0]) & set(secrets[1])


def test_without_names_a_dict_is_not_observed_and_a_category_is_one_hot() -> None:
    observations, _ = environment("Discrete").reset(seed=0)
    assert observations.shape == (3, 0)
    env = environment("Whole")
    observations, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observations, np.eye(LENGTH + 1)[[0, 0, 0]])
    observations, *_ = env.step(np.array([0, 1, 2]))
    np.testing.assert_array_equal(observations, np.eye(LENGTH + 1)[[1, 1, 1]])


def test_sessions_end_in_the_step_that_ends_them() -> None:
    steps: list[Step] = []
    env = environment("Discrete", 3, ("step",))
    played = rollout(env, Uniform(env, 0), 7, 0, steps.append)
    assert played.lengths.tolist() == [LENGTH] * 7
    last = [step for step in steps if step.truncated.any()]
    for step in last:
        # The last observation of the session, not the first of the next.
        np.testing.assert_array_equal(step.next_observations.argmax(1), LENGTH)
        np.testing.assert_array_equal(step.observations.argmax(1), LENGTH - 1)
    rewards = np.concatenate([step.rewards for step in steps])
    assert played.returns.sum() == rewards.sum()


def test_users_are_passed_on_and_must_be_numbers() -> None:
    env = environment("Users")
    _, info = env.reset(seed=0)
    assert info[USER_IDS].tolist() == [77, 77, 77]
    _, _, _, _, info = env.step(np.array([0, 1, 2]))
    assert info[USER_IDS].tolist() == [77, 77, 77]
    with pytest.raises(InputError, match=r"info\['user_id'\] is 'Ann'; it must be a whole number"):
        environment("Names").reset(seed=0)


def test_the_user_that_reset_gives_is_that_of_the_whole_session() -> None:
    env, steps = environment("Visitors"), list[Step]()
    rollout(env, Uniform(env, 0), 7, 0, steps.append)
    of = set[tuple[int, int]]()
    for step in steps:
        of |= set(zip(step.episodes.tolist(), step.user_ids.tolist(), strict=True))
    # Each of the three copies plays its first, second and third visitor.
    assert of == {(episode, 1000 + episode // 3) for episode in range(7)}
    env = environment("Some-visitors")
    with pytest.raises(InputError, match="only some sessions or steps have info"):
        rollout(env, Uniform(env, 0), 4, 0)


@pytest.mark.parametrize(
    ("name", "observe", "said"),
    [
        ("Slate", (), "takes actions of MultiDiscrete.*takes one item"),
        ("Discrete", ("secrets",), "--observe secrets: .* has the entries secret, step"),
        ("Whole", ("step",), "--observe step: .* has no named entries"),
        ("Notes", ("step", "notes"), "name entries of a fixed size with --observe"),
        ("Absent", (), "cannot be made .*gymnasium:MODULE:ID"),
    ],
)
def test_what_cannot_be_played_is_said(name: str, observe: tuple[str, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        environment(name, 1, observe)


def test_a_namespace_is_imported_as_the_package_that_registers_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = f"import gymnasium, {MODULE} as m\ngymnasium.register('spaced/One-v0', lambda: m.Echo("
    (tmp_path / "spaced.py").write_text(f"{code}m.ACTIONS['Discrete']))")
    monkeypatch.syspath_prepend(tmp_path)
    assert GymnasiumEnvironment("spaced/One-v0", 1).single_action_space == spaces.Discrete(ITEMS)
    for name in ("spaced/Two-v0", "absent/One-v0", "absent:spaced/One-v0", "a:b:One-v0"):
        with pytest.raises(InputError, match=rf"^gymnasium:{name} cannot be made \(.*MODULE:ID$"):
            GymnasiumEnvironment(name, 1)


def test_a_missing_module_and_options_of_other_environments_are_refused() -> None:
    with pytest.raises(InputError, match="are for gymnasium:ID; leave them out for synthetic-cat"):
        Environment("synthetic-catalog", observe=("step",)).simulator()
    name = f"gymnasium:{MODULE}:ucfrec-test/Box-v0"
    vectors = Environment(name, observe=("secret",), item_features="vectors").simulator()
    with pytest.raises(InputError, match="takes vectors, not items"):
        vectors.make(1, None)


def test_from_collect_to_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"gymnasium:{MODULE}:ucfrec-test/Discrete-v0"
    env = ["--env", name, "--observe", "secret"]
    logs, store, run = (str(tmp_path / each) for each in ("logs", "store", "run"))
    features = ["--item-features", "vectors"]
    assert main(["collect", *env, *features, "--sessions", "40", "--out", logs]) == 0
    said = capsys.readouterr().out
    assert "40 sessions of random, 200 steps" in said
    assert "reward column reward; observation of 2 numbers" in said
    record = json.loads((tmp_path / "logs" / "collect.json").read_text())
    assert record["env"] == f"{name} --observe secret --item-features vectors"
    log = pq.read_table(tmp_path / "logs" / "sessions.parquet").to_pandas()
    assert (log["reward"] == log["item_id"]).all()
    assert (log["propensity"] == np.float32(1 / ITEMS)).all()
    assert main(["prepare", logs, "--out", store]) == 0
    small = ["train.steps=2", "policy.dim=8", "train.validate_every=2"]
    settings = [argument for setting in small for argument in ("--set", setting)]
    assert main(["train", store, "--policy", "bc", "--out", run, *settings]) == 0
    rows = tmp_path / "rows.json"
    evaluated = ["--episodes", "8", "--behavior", "random", "--json", str(rows)]
    assert main(["evaluate", run, *env, *evaluated]) == 0
    found = read_results(rows)
    assert [row.method for row in found] == ["bc", "random"]
    assert {row.metrics["length"] for row in found} == {LENGTH}
    assert {row.environment for row in found} == {f"{name} --observe secret"}
    capsys.readouterr()
    assert main(["evaluate", run, "--env", name, "--episodes", "8"]) == 2
    assert "collected with the same --observe" in capsys.readouterr().err


@pytest.fixture
def env() -> gymnasium.Env[Any, Any]:
    return gymnasium.make(f"{MODULE}:ucfrec-test/Discrete-v0")


def test_features_of_attributes_and_files(env: gymnasium.Env[Any, Any], tmp_path: Path) -> None:
    expected = {"item_id": [0, 1, 2, 3], "features": [[0, 1], [2, 3], [4, 5], [6, 7]]}
    for source in ("vectors", "unwrapped.vectors", "unwrapped.vectors.T.T"):
        assert item_table(source, env, ITEMS).to_pydict() == expected
    path = tmp_path / "items.npy"
    np.save(path, np.array([3, 1, 4, 1]))
    assert item_table(str(path), env, ITEMS)["features"].to_pylist() == [3, 1, 4, 1]
    np.save(path, np.array([[1, 0, 1], [0, 0, 0], [0, 1, 0], [1, 1, 1]], dtype=np.bool_))
    tags = item_table(str(path), env, ITEMS)["tags"]
    assert tags.to_pylist() == [[0, 2], [], [1], [0, 1, 2]]
    assert pa.types.is_integer(tags.type.value_type)
    path = tmp_path / "items.parquet"
    pq.write_table(pa.table({"kind": ["c", "a", "d", "b"], "item_id": [2, 0, 3, 1]}), path)
    table = item_table(str(path), env, ITEMS)
    assert table.to_pydict() == {"kind": ["a", "b", "c", "d"], "item_id": [0, 1, 2, 3]}


def test_unusable_features_are_refused(env: gymnasium.Env[Any, Any], tmp_path: Path) -> None:
    def refused(source: str | Path, said: str) -> None:
        with pytest.raises(InputError, match=said):
            item_table(str(source), env, ITEMS)

    refused("absent", "absent is neither a .npy or .parquet file nor an attribute")
    refused("played", r"an array of float64 of shape \(0,\); give numbers with one row for each")
    refused(tmp_path / "absent.npy", "does not exist")
    path = tmp_path / "x.npy"
    np.save(path, np.array([{}, 1, 2, 3], dtype=object))
    refused(path, "cannot be read")
    np.save(path, np.array([0.0, np.nan, 1, 2]))
    refused(path, "not finite")
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"item_id": [0, 1, 1, 3]}), path)
    refused(path, "has 4 rows; give each item_id from 0 to 3 once")
