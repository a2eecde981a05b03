"""Scores of running sessions are those of `Decider.scores`, up to rounding."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.served import FULL, learn_tastes, trained_run
from tests.support.tagged import tagged_store
from ucfrec import Recommender, schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.logged_decisions import session_scores
from ucfrec.acting.sessions import Sessions
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.runs.trained_policy import TrainedPolicy

RULES = {
    "own": None,
    "plain": DecisionRule(2.0),
    "full": FULL,
    "weighted": DecisionRule(1.0, floor=0.5, reward_weight=3.0),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scored")


@pytest.fixture(scope="module")
def trained(folder: Path) -> TrainedPolicy:
    trained = trained_run(folder)
    with torch.no_grad():  # a policy of 20 steps has hardly any opinion
        for parameter in trained.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    learn_tastes(trained)
    return trained


def drawn_steps(store: EpisodeStore, count: int) -> tuple[np.ndarray, np.ndarray]:
    return store.draw_steps(np.random.default_rng(count), count)


def sessions_at(store: EpisodeStore, episodes: np.ndarray, steps: np.ndarray) -> Sessions:
    owner, items = store.items_before(episodes, steps)
    rewards = np.concatenate(
        [store.step_values(schema.REWARD, e, np.arange(s)) for e, s in zip(episodes, steps)]  # noqa: B905
    )
    users = store.episode_values(schema.USER).astype(np.int64)[episodes]
    return Sessions.of_rows(owner, items, rewards.astype(np.float32), users, 40)


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("count", [1, 5, 70])
def test_scores_are_those_of_the_decider(
    folder: Path, trained: TrainedPolicy, name: str, count: int
) -> None:
    store = EpisodeStore.open(folder / "store")
    episodes, steps = drawn_steps(store, count)
    sessions, decider = sessions_at(store, episodes, steps), trained.decider(RULES[name])
    left_out = torch.tensor([0, count - 1]), torch.tensor([3, 5])
    if decider.rule.exclude_seen:
        owner, items = map(torch.from_numpy, store.items_before(episodes, steps))
        left_out = torch.cat([left_out[0], owner]), torch.cat([left_out[1], items])
    forbidden = torch.zeros(count, 24, dtype=torch.bool)
    forbidden[0, 3] = forbidden[count - 1, 5] = True
    expected = session_scores(decider, store, episodes, steps, forbidden).log_softmax(-1)
    found = trained.scorer(RULES[name]).scores(sessions, left_out).log_softmax(-1)
    assert torch.equal(found.isneginf(), expected.isneginf())
    left = ~expected.isneginf()
    torch.testing.assert_close(found[left], expected[left], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("policy", ["popular", "dt"])
def test_any_learner_can_be_asked(folder: Path, tmp_path: Path, policy: str) -> None:
    store = tagged_store(tmp_path)
    settings = ["train.steps=2", "policy.context=3", "rule.choose=false"]
    if policy == "dt":
        settings += ["policy.dim=8", "policy.exposure=true"]
    trained = Recommender(policy, settings=settings).fit(store).trained
    before = {name: each.clone() for name, each in trained.policy.state_dict().items()}
    episodes, steps = drawn_steps(store, 9)
    left_out = torch.tensor([2]), torch.tensor([7])
    found = trained.scorer().scores(sessions_at(store, episodes, steps), left_out).clone()
    assert found[2, 7] == -torch.inf
    found[2, 7] = 0.0
    expected = session_scores(trained.decider(), store, episodes, steps)
    expected[2, 7] = 0.0
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    for name, each in trained.policy.state_dict().items():
        assert torch.equal(each, before[name])


def test_a_scorer_is_kept_until_rule_or_weights_change(
    folder: Path, trained: TrainedPolicy
) -> None:
    store = EpisodeStore.open(folder / "store")
    sessions = sessions_at(store, *drawn_steps(store, 2))
    first = trained.scorer(RULES["plain"])
    assert trained.scorer(RULES["plain"]) is first
    assert trained.scorer(RULES["weighted"]) is not first
    before = trained.scorer(RULES["plain"]).scores(sessions)
    with torch.no_grad():
        trained.policy.head.bias[4] += 1.5  # type: ignore[index,operator]
    after = trained.scorer(RULES["plain"]).scores(sessions)
    torch.testing.assert_close(after[:, 4] - before[:, 4], torch.tensor([1.5, 1.5]))


def test_everything_may_be_left_out_and_nothing_may_be_nan(
    folder: Path, trained: TrainedPolicy
) -> None:
    store = EpisodeStore.open(folder / "store")
    sessions = sessions_at(store, *drawn_steps(store, 2))
    excluded = torch.stack([torch.ones(24, dtype=torch.bool), torch.arange(24) != 6])
    found = trained.scorer().scores(sessions, excluded=excluded)
    assert found[0].isneginf().all()
    assert torch.nonzero(~found[1].isneginf()).tolist() == [[6]]
    bias: torch.Tensor = trained.policy.head.bias  # type: ignore[assignment]
    kept = bias.detach().clone()
    with torch.no_grad():
        bias[0] = torch.nan
    with pytest.raises(InputError, match="in 2 of 2 decisions scores are no numbers"):
        trained.scorer().scores(sessions)
    with torch.no_grad():
        bias.copy_(kept)
