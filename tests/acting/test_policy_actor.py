"""Windows gathered from the logs of a policy's own sessions give the actions that it took."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.rollout import Step, rollout
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.plugins import load_plugin
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.baselines import ItemKNNConfig, ItemKNNPolicy
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.policies.ucf import UCFConfig, UCFPolicy

TARGET, EPISODES, SIDE_BY_SIDE, K = 20.0, 30, 8, 2


def build(name: str, sizes: dict[str, int]) -> SequencePolicy:
    if name == "dt":
        return DTPolicy(DTConfig(context=K, dim=16), sizes)
    if name == "item-knn":
        policy = ItemKNNPolicy(ItemKNNConfig(context=K, neighbors=5), sizes)
        policy.cosines.uniform_(0.1, 1)
        policy.reward_low.fill_(-1)  # pages without a click count too, or sessions repeat
        policy.neighbors.random_(0, sizes["items"])
        return policy
    return UCFPolicy(UCFConfig(context=K, dim=16), sizes)


def written(
    folder: Path, steps: list[Step], action: str, states: ItemStates | None
) -> EpisodeStore:
    """The sessions simulated, as a store in the order of their numbers."""
    episodes = np.concatenate([step.episodes for step in steps])
    order = np.argsort(episodes, kind="stable")
    names = {action: "actions", "reward": "rewards", "observation": "observations"}
    columns = {
        column: np.concatenate([getattr(step, name) for step in steps])[order]
        for column, name in names.items()
    }
    EpisodeStore.write(folder, columns, np.bincount(episodes))
    if states is not None:
        states.save(folder / ITEM_STATES)
    return EpisodeStore.open(folder)


@pytest.mark.parametrize(
    ("environment", "name"),
    [
        ("synthetic-taobao", "ucf"),
        ("synthetic-taobao", "dt"),
        ("synthetic-catalog", "ucf"),
        ("synthetic-catalog", "dt"),
        # The only one that reads the rewards of the steps before.
        ("synthetic-catalog", "item-knn"),
    ],
)
def test_logged_windows_give_actions_played(environment: str, name: str, tmp_path: Path) -> None:
    env = load_plugin("simulators", environment).make(SIDE_BY_SIDE, None)
    observed = env.single_observation_space.shape[0]
    states = None
    if environment == "synthetic-catalog":
        items = int(env.single_action_space.n)
        embeddings = torch.randn(items, 6, generator=torch.Generator().manual_seed(0))
        states = ItemStates(embeddings, torch.zeros(0, 0), 0.0, 1.0)
        policy = build(name, {"state": states.size + observed, "action": 6, "items": items})
        policy.head.start_from(embeddings, torch.ones(items))
        ids = np.arange(items)
    else:
        policy = build(name, {"state": observed, "action": 27, "items": 0})
        ids = None
    torch.manual_seed(1)
    for parameter in policy.eval().parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    scorer = Scorer(policy, DecisionRule(TARGET), states)
    actor = PolicyActor(scorer, SIDE_BY_SIDE, observed, states, ids)
    steps: list[Step] = []
    played = rollout(env, actor, EPISODES, seed=4, on_step=steps.append)
    assert played.lengths.max() > K, "some session must outgrow the context"
    store = written(tmp_path / "store", steps, "action" if ids is None else "item", states)
    np.testing.assert_allclose(store.returns, played.returns, rtol=1e-5)
    episodes, ends = store.all_steps()
    windows = store.windows(episodes, ends, K)
    earned = torch.from_numpy(store.returns[episodes])[:, None] - windows.returns_to_go
    asked = replace(windows, returns_to_go=(TARGET - earned).masked_fill(~windows.mask, 0.0))
    with torch.no_grad():
        predicted = policy.act(asked)
    if ids is None:
        torch.testing.assert_close(predicted, windows.actions[:, -1], rtol=1e-3, atol=1e-4)
    else:
        assert torch.equal(predicted.argmax(-1), windows.actions[:, -1])
