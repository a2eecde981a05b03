"""Sessions in a learned model of users: they do what the model says and the log showed."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.episodes.exposure import Likeness, Shown
from ucfrec.episodes.main_tags import MainTags
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.fatigue import Fatigue
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import reward_model_sizes
from ucfrec.user_model.simulator import LoggedEnds, SessionEnd, UserSimulator

ITEMS = 12


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    return tagged_store(tmp_path_factory.mktemp("learned"))


def model_of(store: EpisodeStore, effects: torch.Tensor) -> ItemRewardModel:
    model = ItemRewardModel(reward_model_sizes(store))
    model.binary.fill_(True)
    model.likeness.start_from(store.item_states)
    model.item.copy_(effects)
    return model


def never(store: EpisodeStore) -> SessionEnd:
    """A model of ends fitted to sessions that never end."""
    logged = LoggedEnds.of(store, 3, 100, 0)
    return SessionEnd(
        Likeness.of(store.item_states),
        LoggedEnds(logged.shown, logged.items, logged.rewards, logged.steps, logged.ended & False),
    )


def test_rewards_are_drawn_with_the_models_calibrated_probabilities(store: EpisodeStore) -> None:
    effects = torch.linspace(-2, 2, len(store.item_states.embeddings))
    environment = UserSimulator(store, model_of(store, effects), (0.5, 1.0), never(store), 4000, 50)
    environment.reset(seed=3)
    for item in (0, 11, 23):
        _, rewards, terminated, truncated, _ = environment.step(np.full(4000, item))
        expected = torch.sigmoid(0.5 * effects[item] + 1.0)
        assert rewards.mean() == pytest.approx(float(expected), abs=0.03)
        assert set(np.unique(rewards)) <= {0.0, 1.0}
        assert not terminated.any()
        assert not truncated.any()


def test_users_who_liked_one_main_tag_on_end_reward_less_for_a_while(store: EpisodeStore) -> None:
    effects = torch.full((len(store.item_states.embeddings),), 40.0)
    given = store, model_of(store, effects), (1.0, 0.0), never(store)
    tired, one = UserSimulator(*given, 3000, 50, 1, Fatigue(3, 2, 0.25)), np.zeros(3000)
    tags = MainTags.of(store.item_states).tags
    other = one + int((tags != tags[0]).nonzero()[0])
    tired.reset(seed=3)
    shares = [float(tired.step(item)[1].mean()) for item in [one, one, one, one, other, one, one]]
    assert shares[:3] == [1.0] * 3
    assert shares[3:5] == pytest.approx([0.25] * 2, abs=0.05)
    # A fourth like tires for two steps, too; then the run is broken.
    assert shares[5:] == pytest.approx([1 - 0.25 * 0.75, 1.0], abs=0.03)
    untired = UserSimulator(*given, 3000, 50)
    untired.reset(seed=3)
    assert all(untired.step(one)[1].all() for _ in range(6))


def test_sessions_end_at_the_longest_length_and_begin_anew(store: EpisodeStore) -> None:
    effects = torch.zeros(len(store.item_states.embeddings))
    environment = UserSimulator(store, model_of(store, effects), (1.0, 0.0), never(store), 5, 3)
    _, info = environment.reset(seed=0)
    first = info["user_id"].copy()
    for step in range(3):
        *_, truncated, info = environment.step(np.arange(5))
        assert truncated.all() == (step == 2)
    users = store.episode_values("user")
    np.testing.assert_array_equal(first, users[:5])
    np.testing.assert_array_equal(info["user_id"], users[5:10])
    assert info["_final_obs"].all()


def test_equal_seeds_give_equal_sessions(store: EpisodeStore) -> None:
    effects = torch.zeros(len(store.item_states.embeddings))
    end = SessionEnd(Likeness.of(store.item_states), LoggedEnds.of(store, 10, 10_000, 0))
    environment = UserSimulator(store, model_of(store, effects), (1.0, 0.0), end, 50, 20)
    played = []
    for seed in (7, 7, 8):
        environment.reset(seed)
        steps = [environment.step(np.full(50, i))[1:4] for i in range(6)]
        played.append(np.concatenate([np.concatenate(step) for step in steps]))
    assert np.array_equal(played[0], played[1])
    assert not np.array_equal(played[0], played[2])


def planted_ends(rows: int = 6000) -> tuple[Likeness, LoggedEnds]:
    """Sessions that end with a step, mostly if its item repeats the one before."""
    rng = np.random.default_rng(0)
    shown, items = rng.integers(-1, ITEMS, (rows, 4)), rng.integers(ITEMS, size=rows)
    repeats = rng.random(rows) < 0.3
    items = np.where(repeats & (shown[:, 0] >= 0), shown[:, 0], items)
    again = items == shown[:, 0]
    states = ItemStates(torch.eye(ITEMS), torch.zeros(0, 0), 0.0, 1.0)
    before = Shown(torch.from_numpy(shown), torch.zeros(rows, 4))
    steps = rng.integers(8, size=rows)
    ended = rng.random(rows) < np.where(again, 0.8, 0.1)
    rewards = rng.random(rows).round()
    return Likeness.of(states), LoggedEnds(before, torch.from_numpy(items), rewards, steps, ended)


def test_the_model_of_ends_finds_that_repetition_ends_sessions() -> None:
    likeness, logged = planted_ends()
    end = SessionEnd(likeness, logged)
    found = end.probabilities(logged.shown, logged.items, logged.rewards, logged.steps)
    again = (logged.items == logged.shown.items[:, 0]).numpy()
    assert found[again].mean() == pytest.approx(0.8, abs=0.05)
    assert found[~again].mean() == pytest.approx(0.1, abs=0.03)


def test_the_last_step_of_a_users_last_session_tells_nothing(tmp_path: Path) -> None:
    columns = {
        "item": np.zeros(9, dtype=np.int64),
        "reward": np.arange(9, dtype=np.float32),
    }
    states = ItemStates(torch.eye(2), torch.zeros(2, 0), 0.0, 1.0)
    episodes = {
        "user": np.array([0, 0, 1, 1]),
        "terminated": np.array([True, True, False, True]),
    }
    lengths = np.array([2, 3, 2, 2])
    store = EpisodeStore.from_arrays(columns, lengths, episodes, states)
    logged = LoggedEnds.of(store, 2, 100, 0)
    # Left out: step 4 (user 0's last session), 6 (cut, not terminated) and 8 (user 1's last).
    assert logged.rewards.tolist() == [0, 1, 2, 3, 5, 7]
    assert logged.ended.tolist() == [False, True, False, False, False, False]


@pytest.mark.parametrize("seed", range(4))
def test_drawn_ends_are_a_sample_of_all(seed: int) -> None:
    generator = np.random.default_rng(seed)
    lengths = generator.integers(1, 4, 60)
    n = int(lengths.sum())
    columns = {"item": np.zeros(n, dtype=np.int64), "reward": np.arange(n, dtype=np.float32)}
    states = ItemStates(torch.eye(2), torch.zeros(2, 0), 0.0, 1.0)
    episodes = {
        "user": np.sort(generator.integers(9, size=60)),
        "terminated": generator.random(60) < 0.5,
    }
    store = EpisodeStore.from_arrays(columns, lengths, episodes, states)
    known = LoggedEnds.of(store, 2, n, seed)
    drawn = LoggedEnds.of(store, 2, 20, seed)
    chosen = np.sort(np.random.default_rng(seed).choice(len(known.rewards), 20, replace=False))
    for name in ("rewards", "steps", "ended"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(known, name)[chosen])
    episode = np.searchsorted(np.cumsum(lengths), known.rewards, side="right")
    np.testing.assert_array_equal(known.ended, known.steps == lengths[episode] - 1)
