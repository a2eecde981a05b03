"""Returns-to-go against brute force, and training against acting."""

import math

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.episodes.returns import remaining_return, returns_to_go

eighths = st.integers(-64, 64).map(lambda n: n / 8)
"""Exact in binary, as are their sums."""
episodes_of_eighths = st.lists(st.lists(eighths, min_size=1, max_size=9), min_size=1, max_size=9)


def flat(episodes: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    lengths = [len(e) for e in episodes]
    return np.concatenate(episodes), np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


def test_the_documented_example() -> None:
    got = returns_to_go(np.array([1.0, 0.0, 2.0, 5.0]), np.array([0, 3, 4]))
    assert got.tolist() == [3, 2, 2, 5]


@given(episodes_of_eighths)
def test_equals_brute_force(episodes: list[list[float]]) -> None:
    got = returns_to_go(*flat(episodes))
    assert got.dtype == np.float32
    assert got.tolist() == [sum(e[t:]) for e in episodes for t in range(len(e))]


@given(st.lists(st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=9), min_size=1))
def test_other_rewards_within_rounding(episodes: list[list[float]]) -> None:
    got = returns_to_go(*flat(episodes))
    expected = [math.fsum(e[t:]) for e in episodes for t in range(len(e))]
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7)


@given(episodes_of_eighths)
def test_episodes_do_not_touch_each_other(episodes: list[list[float]]) -> None:
    together = returns_to_go(*flat(episodes))
    apart = [returns_to_go(*flat([episode])) for episode in episodes]
    assert np.array_equal(together, np.concatenate(apart))


def test_a_long_store_keeps_its_digits() -> None:
    """Prefix sums are differenced: in float32 they would have lost the last episodes."""
    rng = np.random.default_rng(0)
    rewards = rng.random(2_000_000, dtype=np.float32) + 100
    offsets = np.arange(0, 2_000_001, 20)
    got = returns_to_go(rewards, offsets).reshape(-1, 20)
    suffixes = rewards.reshape(-1, 20)[:, ::-1].cumsum(1, dtype=np.float64)[:, ::-1]
    np.testing.assert_allclose(got, suffixes, rtol=2e-7)


@given(episodes_of_eighths)
def test_acting_with_the_logged_return_as_target_gives_the_training_returns_to_go(
    episodes: list[list[float]],
) -> None:
    """With an episode's return as target return and its rewards, acting repeats its values."""
    trained = returns_to_go(*flat(episodes)).tolist()
    seen: list[float] = []
    for episode in episodes:
        target = torch.tensor([sum(episode)], dtype=torch.float64)
        collected = torch.zeros(1).double()
        for reward in episode:
            seen += remaining_return(target, collected).float().tolist()
            collected += reward
    assert seen == trained
