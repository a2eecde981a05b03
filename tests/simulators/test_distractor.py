"""The distractor: goes with rewards in the logs, causes nothing in the environments."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.simulators.kuai.test_kuairand import QUICK, planted_store
from tests.support.single_session import check_environment
from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import Step, rollout
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.writer import reward_bit
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Environment
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.distractor import DistractorEnv, DistractorEnvironment, plant_distractor
from ucfrec_simulators.kuai.completion import complete

TINY = ["train.steps=2", "train.validate_every=2", "policy.dim=16", "policy.context=4"]


@pytest.fixture(scope="module")
def kuairand_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KuaiRand-like clicks as a store, `log/store`, and their environment, `environment`."""
    folder = tmp_path_factory.mktemp("distractor")
    complete(planted_store(folder / "log"), {}, folder / "environment", QUICK)
    return folder


@pytest.fixture(scope="module")
def stores(kuairand_folder: Path) -> dict[str, EpisodeStore]:
    """One store an environment, without a distractor."""
    logs, taobao = str(kuairand_folder / "logs"), str(kuairand_folder / "taobao")
    played = ["--env", "synthetic-taobao", "--behavior", "mixture", "--sessions", "300"]
    assert main(["collect", *played, "--out", logs]) == 0
    rewards = ["--reward", "clicks", "--session-by", "session_id"]
    assert main(["prepare", f"{logs}/sessions.parquet", *rewards, "--out", taobao]) == 0
    paths = {"synthetic-taobao": taobao, "kuairand": kuairand_folder / "log" / "store"}
    return {name: EpisodeStore.open(path) for name, path in paths.items()}


@pytest.mark.parametrize("name", ["synthetic-taobao", "kuairand"])
@pytest.mark.parametrize(("flip", "agreement"), [(0.0, 1.0), (0.15, 0.85)])
def test_the_distractor_goes_with_the_reward_and_nothing_else_changes(
    stores: dict[str, EpisodeStore], tmp_path: Path, name: str, flip: float, agreement: float
) -> None:
    store = stores[name]
    planted = plant_distractor(store, tmp_path / "planted", flip, seed=1)
    rewards = store.step_values(schema.REWARD, *store.all_steps())
    high = rewards == 1 if name == "kuairand" else rewards > np.median(rewards)
    observed = planted.step_values(schema.OBSERVATION, *planted.all_steps())
    assert observed.shape[1] == planted.observation_size == store.observation_size + 1
    agreed = float((observed[:, 0] == high).mean())
    assert agreed == pytest.approx(agreement, abs=0.03 if flip else 0)
    if store.observation_size:
        before = store.step_values(schema.OBSERVATION, *store.all_steps())
        np.testing.assert_array_equal(observed[:, 1:], before)
    own = {"meta.json", "observation.npy"}
    for file in store.path.rglob("*"):
        if file.is_file() and file.name not in own:
            assert file.read_bytes() == (planted.path / file.relative_to(store.path)).read_bytes()
    assert planted.record.fingerprint != store.record.fingerprint
    own_entries = {"columns": {}, "fingerprint": "", "source": None, "files": {}}
    assert planted.record.copy_with(**own_entries) == store.record.copy_with(**own_entries)


def test_clicks_that_are_the_rule_are_high_and_equal_rewards_are_refused(tmp_path: Path) -> None:
    for clicks in ([1, 1, 1, 0], [1, 0, 0, 0], [1, 1, 1, 1]):
        steps = {"action": np.zeros((4, 1)), "reward": np.array(clicks, dtype=float)}
        store = EpisodeStore.write(tmp_path / str(clicks), steps, np.array([4]))
        if 0 in clicks:
            np.testing.assert_array_equal(reward_bit(store), clicks)
    with pytest.raises(InputError, match="no distractor can correlate"):
        reward_bit(store)
    with pytest.raises(InputError, match=r"must be in \[0, 1\]"):
        reward_bit(store, flip=1.5)


@pytest.mark.parametrize("name", ["synthetic-taobao", "kuairand"])
def test_the_distractor_causes_nothing(kuairand_folder: Path, name: str) -> None:
    folder = kuairand_folder / "environment"
    plain = Environment(name, folder).simulator().make(16, folder)
    plain.action_space.seed(3)
    actions = [plain.action_space.sample() for _ in range(40)]
    seen, _ = plain.reset(seed=5)
    steps = [plain.step(action) for action in actions]
    for rate in (0.0, 1.0, 0.4):
        env = DistractorEnvironment(name, folder, rate).simulator().make(16, folder)
        first, _ = env.reset(seed=5)
        np.testing.assert_array_equal(first[:, 1:], seen)
        distractors = [first[:, 0]]
        for action, (observed, *outcome, info) in zip(actions, steps, strict=True):
            mine = env.step(action)
            np.testing.assert_array_equal(mine[0][:, 1:], observed)
            np.testing.assert_array_equal(mine[1:4], outcome)
            for row in np.flatnonzero(info.get("_final_obs", [])):
                final = mine[4]["final_obs"][row]
                np.testing.assert_array_equal(final[1:], info["final_obs"][row])
                assert final in env.single_observation_space
            distractors.append(mine[0][:, 0])
        assert np.mean(distractors) == pytest.approx(rate, abs=0.08 if 0 < rate < 1 else 0)
    check_environment(DistractorEnvironment(name, folder, 1.0).simulator().make(1, folder))
    with pytest.raises(InputError, match=r"lie in \[0, 1\]"):
        DistractorEnv(plain, 2.0)


@pytest.mark.parametrize("name", ["synthetic-taobao", "kuairand"])
def test_a_policy_is_shown_the_distractor_where_it_was_trained_on_it(
    stores: dict[str, EpisodeStore], kuairand_folder: Path, tmp_path: Path, name: str
) -> None:
    planted = plant_distractor(stores[name], tmp_path / "planted")
    train_run(planted, tmp_path / "run", resolve_config("bc", overrides=TINY))
    trained = TrainedPolicy.load(tmp_path / "run")
    episodes, steps = planted.all_steps()
    states = planted.windows(episodes, steps, 1).states[:, 0]
    distractor = torch.from_numpy(reward_bit(planted))
    (where,) = (states == distractor.unsqueeze(1)).all(0).nonzero().flatten().tolist()
    folder = kuairand_folder / "environment"
    for rate in (0.0, 1.0):
        env = DistractorEnvironment(name, folder, rate).simulator().make(8, folder)
        ids = np.arange(len(trained.item_ids)) if trained.item_ids is not None else None
        actor, shown = trained.actor(8, DecisionRule(1.0), ids), list[torch.Tensor]()

        def watch(step: Step, actor: Any = actor, shown: list[torch.Tensor] = shown) -> None:
            shown.append(actor._sessions.states[step.rows, -1, where].clone())

        played = rollout(env, actor, 16, 0, on_step=watch)
        values = torch.cat(shown)
        assert len(values) == played.lengths.sum()
        assert (values == rate).all()
