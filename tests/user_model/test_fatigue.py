"""Fatigue is found only where users have it; later steps show nothing of earlier ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.episodes import N_ITEMS, Logged, some_states, write_store
from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Shown
from ucfrec.user_model.fatigue import Fatigue, LoggedRuns, MainTags, fit_fatigue

LAGS = 10


def sessions(factor: float, seed: int, count: int = 150, length: int = 40) -> LoggedRuns:
    """Sessions of two tags; users have fatigue for 4 steps after 3 likes of a tag in a row."""
    rng, runs, liked = np.random.default_rng(seed), [], []
    for _ in range(count):
        tags, likes = np.zeros(0, dtype=int), np.zeros(0, dtype=bool)
        taste = rng.uniform(0.4, 0.9)
        for _step in range(length):
            back = [on_end(tags[: len(tags) - n], likes[: len(tags) - n]) for n in range(LAGS)]
            runs.append(back)
            tired = any(each >= 3 for each in back[:4])
            likes = np.append(likes, rng.random() < taste * (factor if tired else 1.0))
            tags = np.append(tags, rng.random() < 0.3)
        liked.append(likes)
    numbers = np.repeat(np.arange(count), length)
    return LoggedRuns(torch.tensor(runs), np.concatenate(liked), numbers)


def on_end(tags: IntArray, likes: BoolArray) -> int:
    """Steps in a row, up to the last, with its tag and liked; as `MainTags.runs` counts them."""
    length = 0
    while length < len(tags) and likes[-1 - length] and tags[-1 - length] == tags[-1]:
        length += 1
    return length


def test_fatigue_is_found_where_held_out_sessions_show_it_too() -> None:
    tires, not_at_all = sessions(0.1, seed=0), sessions(1.0, seed=1)
    found = fit_fatigue(tires, sessions(0.1, seed=1))
    assert found is not None
    assert (found.length, found.steps) == (3, 4)
    assert found.factor == pytest.approx(0.1, abs=0.03)
    for held_out in (not_at_all, sessions(0.1, seed=1, count=1)):
        assert fit_fatigue(tires, held_out) is None
    for factor in (0.8, 1.0):
        assert fit_fatigue(sessions(factor, seed=0), sessions(factor, seed=1)) is None


def test_users_are_tired_for_so_many_steps_after_a_run() -> None:
    runs = torch.tensor([[3, 2, 1, 0], [0, 3, 2, 1], [0, 0, 3, 2], [2, 1, 0, 0]])
    assert Fatigue(3, 2, 0.0).is_tired(runs).tolist() == [True, True, False, False]


def test_runs_of_a_log_know_nothing_of_the_step_or_later(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    given = rng.integers(N_ITEMS, size=(5, 8))
    tags = MainTags(torch.arange(N_ITEMS) % 3, 0.0, 1.0)

    def runs(last: float, name: str) -> LoggedRuns:
        rewards = [1.0] * 5 + [last] * 3
        nothing = np.zeros((8, 0), np.float32)
        logged = [Logged(rewards, nothing, items=items.tolist()) for items in given]
        store = write_store(tmp_path / name, logged, some_states(users=1))
        return LoggedRuns.of(store, tags, LAGS, 10_000)

    liked, not_liked = runs(1.0, "liked"), runs(0.0, "not")
    steps = np.arange(40) % 8
    assert torch.equal(liked.runs[steps <= 5], not_liked.runs[steps <= 5])
    assert not torch.equal(liked.runs, not_liked.runs)
    assert not_liked.liked.tolist() == (steps < 5).tolist()
    all_liked = np.ones(8, dtype=bool)
    by_hand = [on_end(tags[:n], all_liked[:n]) for tags in given % 3 for n in range(8)]
    assert liked.runs[:, 0].tolist() == by_hand


TAGS = MainTags(torch.tensor([0, 0, 1, 1, 2, -1]), 0.0, 2.0)
steps = st.lists(st.tuples(st.integers(0, 5), st.sampled_from([0.0, 1.0, 1.2, 2.0])), max_size=9)


def shown_of(history: list[tuple[int, float]], reach: int) -> Shown:
    """The last `reach` steps of a session (oldest first), most recent first, padded."""
    items, rewards = zip(*[*history[::-1], *[(-1, 0.0)] * reach][:reach], strict=True)
    return Shown(torch.tensor([items]), torch.tensor([rewards]))


def run_by_hand(history: list[tuple[int, float]]) -> int:
    """Length of the run of one main tag that ends with the last step."""
    tags = np.array([int(TAGS.tags[item]) for item, _ in history])
    likes = np.array([reward >= 1.2 for _, reward in history], dtype=bool)
    return on_end(tags, likes & (tags >= 0))


@given(steps)
def test_runs_are_those_counted_by_hand(history: list[tuple[int, float]]) -> None:
    reach = 10
    found = TAGS.runs(shown_of(history, reach))[0].tolist()
    for back in range(reach):
        assert found[back] == (run_by_hand(history[: len(history) - back]) if history[back:] else 0)


@given(steps, st.integers(1, 6))
def test_a_tag_tires_after_a_run_of_it(history: list[tuple[int, float]], run: int) -> None:
    expected = int(TAGS.tags[history[-1][0]]) if run_by_hand(history) >= run else -1
    assert TAGS.find_tired(shown_of(history, 10), run).tolist() == [expected]
    # What is not remembered tires nobody.
    assert TAGS.find_tired(shown_of([(0, 2.0)] * 3, 3), 4).tolist() == [-1]


def test_an_item_of_two_tags_has_the_one_whose_items_it_resembles() -> None:
    vectors = torch.tensor([[1.0, 0], [1, 0.1], [0, 1], [0.1, 1], [1, 0.4], [0.4, 1], [1, 1]])
    tags = torch.tensor([[0, -1], [0, -1], [1, -1], [1, -1], [1, 0], [0, 1], [-1, -1]])
    states = replace(ItemStates(vectors, torch.zeros(0, 0), -1.0, 1.0), tags=tags)
    found = MainTags.of(states)
    assert found.tags.tolist() == [0, 0, 1, 1, 0, 1, -1]
    assert found.liked(torch.tensor([-1.0, 0.19, 0.21, 1.0])).tolist() == [False, False, True, True]
    without = MainTags.of(replace(states, tags=torch.zeros(0, 0, dtype=torch.int64)))
    assert without.tags.tolist() == [-1] * 7
    assert without.runs(shown_of([(0, 1.0)] * 4, 4)).tolist() == [[0] * 4]
