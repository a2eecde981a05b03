"""Simulated sessions: users do what the model says and the log showed."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.fatigue import Fatigue, MainTags
from ucfrec.user_model.model import LoggedRewards, UserModel, UserSimulator, longest_session
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import reward_model_sizes
from ucfrec.user_model.session_end import LoggedEnds, SessionEnd


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    return tagged_store(tmp_path_factory.mktemp("learned"))


def users_of(
    store: EpisodeStore,
    effects: torch.Tensor | float,
    calibration: tuple[float, float] = (1.0, 0.0),
    ends: float = 0.0,
    fatigue: Fatigue | None = None,
) -> UserModel:
    """Users who reward items by the log-odds `effects`, and leave after a share `ends` of steps."""
    model = ItemRewardModel(reward_model_sizes(store))
    model.binary.fill_(True)
    model.likeness.start_from(store.item_states)
    model.item.copy_(torch.as_tensor(effects))
    logged = LoggedEnds.of(store, model.likeness, 10, 10_000, 0)
    logged.ended[:] = np.random.default_rng(0).random(len(logged.ended)) < ends
    tags = MainTags.of(store.item_states)
    end, of_end = SessionEnd.fit(model.likeness, logged, logged, 0)
    report: Any = None
    return UserModel(model, report, None, calibration, end, of_end, fatigue, tags)


def test_rewards_are_drawn_with_the_models_calibrated_probabilities(store: EpisodeStore) -> None:
    effects = torch.linspace(-2, 2, len(store.item_states.embeddings))
    users = UserSimulator(users_of(store, effects, (0.5, 1.0)), store, 4000, 50, seed=3)
    for item in (0, 11, 23):
        rewards, going = users.step(np.full(4000, item))
        expected = torch.sigmoid(0.5 * effects[item] + 1.0)
        assert rewards.mean() == pytest.approx(float(expected), abs=0.03)
        assert set(np.unique(rewards)) <= {0.0, 1.0}
        assert len(going) == 4000


@pytest.mark.parametrize("kind", ["clicks", "shop", "watch time", "negative"])
def test_drawn_rewards_are_logged_ones_with_the_expected_mean(kind: str) -> None:
    """Paying the mean itself would end the sessions of a shop as often as after a purchase."""
    rng, n = np.random.default_rng(0), 20_000
    logged = {
        "clicks": rng.random(n) < 0.3,
        "shop": rng.choice([0, 1, 3, 8], n, p=[0.55, 0.3, 0.1, 0.05]),
        "watch time": rng.gamma(0.5, 3, n),
        "negative": rng.normal(-3, 1, n),
    }[kind]
    logged = logged.astype(np.float32)
    items = {"item": np.zeros(n, dtype=np.int64), "reward": logged}
    states = ItemStates(torch.ones(1, 2), torch.zeros(0, 0), 0.0, 1.0)
    rewards = LoggedRewards(EpisodeStore.from_arrays(items, np.full(n // 4, 4), None, states))
    low, high = np.quantile(rewards.values, [0.05, 0.95])
    for mean in np.linspace(low, high, 7):
        drawn = rewards.draw(np.full(100_000, mean), rng.random(100_000))
        assert drawn.mean() == pytest.approx(mean, abs=0.02 * np.ptp(rewards.values))
        assert set(drawn) <= set(rewards.values)
    same = rewards.draw(np.full(100_000, logged.mean()), rng.random(100_000))
    assert same.std() == pytest.approx(logged.std(), rel=0.1)


def test_users_who_liked_one_main_tag_on_end_reward_less_for_a_while(store: EpisodeStore) -> None:
    tired = users_of(store, 40.0, fatigue=Fatigue(3, 2, 0.25))
    users, one = UserSimulator(tired, store, 3000, 50, seed=3), np.zeros(3000)
    other = one + int((tired.main_tags.tags != tired.main_tags.tags[0]).nonzero()[0])
    shares = [float(users.step(item)[0].mean()) for item in [one, one, one, one, other, one, one]]
    assert shares[:3] == [1.0] * 3
    assert shares[3:5] == pytest.approx([0.25] * 2, abs=0.05)
    # A fourth like causes fatigue for two steps, too; then the run is broken.
    assert shares[5:] == pytest.approx([1 - 0.25 * 0.75, 1.0], abs=0.03)
    users = UserSimulator(users_of(store, 40.0), store, 3000, 50, seed=3)
    assert all(users.step(one)[0].all() for _ in range(6))


def test_what_users_think_of_an_item_depends_on_its_place_and_what_is_above(
    store: EpisodeStore,
) -> None:
    users = users_of(store, 0.0, (0.5, 1.0))
    users.reward.position[:2] = torch.tensor([-0.5, -1.5])
    users.reward.above.fill_(-2.0)
    simulator, tags = UserSimulator(users, store, 5, 50, 3, length=3), store.item_states.tags
    for _ in range(2):  # two lists
        odds = []
        for item in (3, 7, 3):
            simulator.step(np.full(5, item))
            odds.append(float(torch.logit(torch.tensor(simulator.expected[0]))))
        shared = [len({*tags[n].tolist()} & {*tags[3].tolist()} - {-1}) for n in (7, 3)]
        assert shared[0] > 0
        above = [0, shared[0], shared[0] + shared[1]]
        expected = [1 + 0.5 * (p - 2 * n) for p, n in zip((0, -0.5, -1.5), above, strict=True)]
        assert odds == pytest.approx(expected, abs=1e-4)


def test_sessions_that_go_on_are_what_they_would_be_with_the_others(store: EpisodeStore) -> None:
    """Each session draws numbers of its own, however many have ended; at 20 steps all have."""
    paid = []
    for times in (1, 2):
        users = UserSimulator(users_of(store, 0.0, ends=0.3), store, 50, 20, 7, times)
        # Other items, which end others, in the second half.
        items, alive = np.repeat([3, 9], 50)[: 50 * times], np.arange(50 * times)
        of_first = np.full((20, 50), np.nan)
        np.testing.assert_array_equal(users.users[:50], store.episode_values("user")[:50])
        for step in range(20):
            rewards, going = users.step(items[alive])
            of_first[step, alive[alive < 50]] = rewards[alive < 50]
            alive = alive[going]
        assert not len(alive)
        paid.append(of_first)
    assert len(np.unique(np.isnan(paid[0]).sum(0))) > 2
    np.testing.assert_array_equal(*paid)


@pytest.mark.parametrize(
    ("lengths", "longest"),
    [
        (np.random.default_rng(0).geometric(0.45, 8000), None),
        (np.minimum(np.random.default_rng(0).geometric(0.1, 2000), 20), 20),
        (np.full(50, 7), 7),
        (np.array([1, 1, 1]), 1),
        (np.arange(1, 60), 100),
        (np.arange(1, 500), 499),
    ],
)
def test_sessions_may_be_longer_than_logged_ones_unless_something_ends_them(
    lengths: np.ndarray, longest: int | None
) -> None:
    expected = 3 * lengths.max() if longest is None else longest
    assert longest_session(lengths) == expected
