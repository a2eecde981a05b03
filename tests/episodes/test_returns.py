"""Returns-to-go against brute force, and training against acting."""

import math

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.episodes.returns import ReturnToGo

eighths = st.integers(-64, 64).map(lambda n: n / 8)
"""Exact in binary, as are their sums."""
episodes_of_eighths = st.lists(st.lists(eighths, min_size=1, max_size=9), min_size=1, max_size=9)


def flat(episodes: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    lengths = [len(e) for e in episodes]
    return np.concatenate(episodes), np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


def test_a_long_store_keeps_its_digits() -> None:
    """Prefix sums are differenced: in float32 they would have lost the last episodes."""
    rng = np.random.default_rng(0)
    rewards = rng.random(2_000_000, dtype=np.float32) + 100
    offsets = np.arange(0, 2_000_001, 20)
    got = ReturnToGo().of_logs(rewards, offsets).reshape(-1, 20)
    suffixes = rewards.reshape(-1, 20)[:, ::-1].cumsum(1, dtype=np.float64)[:, ::-1]
    np.testing.assert_allclose(got, suffixes, rtol=2e-7)


definitions = st.sampled_from(
    [ReturnToGo(), *(ReturnToGo("horizon", steps) for steps in range(1, 13))]
)


def slowly(definition: ReturnToGo, rewards: list[float], step: int) -> float:
    """Ĝ of one step, from the documentation of `ReturnToGo`."""
    if definition.definition == "session":
        return sum(rewards[step:])
    return sum(rewards[step : step + definition.horizon])


@given(definitions, episodes_of_eighths)
def test_definitions_equal_brute_force(definition: ReturnToGo, episodes: list[list[float]]) -> None:
    got = definition.of_logs(*flat(episodes))
    assert got.dtype == np.float32
    expected = [slowly(definition, e, t) for e in episodes for t in range(len(e))]
    assert got.tolist() == expected


@given(episodes_of_eighths)
def test_acting_with_the_logged_return_as_target_is_training(episodes: list[list[float]]) -> None:
    """With an episode's return as target return and its rewards, acting repeats its values."""
    returns, seen = ReturnToGo(), list[float]()
    for episode in episodes:
        collected = torch.tensor([sum(episode[:t]) for t in range(len(episode))]).double()
        seen += returns.target_returns(sum(episode), collected).float().tolist()
    assert seen == returns.of_logs(*flat(episodes)).tolist()


def test_only_a_target_of_a_session_is_lowered_by_rewards() -> None:
    collected = torch.tensor([0.0, 2.0, -1.0]).double()
    assert ReturnToGo().per_session
    assert ReturnToGo().target_returns(5.0, collected).tolist() == [5, 3, 6]
    assert not ReturnToGo("horizon", 3).per_session
    assert ReturnToGo("horizon", 3).target_returns(5.0, collected).tolist() == [5, 5, 5]


@given(definitions, st.lists(eighths, min_size=1, max_size=12), st.integers(1, 12))
def test_the_past_of_a_window_is_as_in_training(
    definition: ReturnToGo, rewards: list[float], length: int
) -> None:
    """If the future brings the target, acting sees what training would have shown. A horizon's is
    taken to come evenly: the rewards from the last step on are equal here."""
    last = len(rewards) - 1
    if definition.definition == "horizon":
        rewards = rewards[:-1] + [rewards[-1]] * definition.horizon
    shown = definition.of_logs(*flat([rewards]))[: last + 1]
    window = torch.zeros(1, length, dtype=torch.float32)
    kept = min(length, last + 1)
    window[0, length - kept :] = torch.tensor(rewards[last + 1 - kept : last + 1])
    window[0, -1] = math.nan  # the reward of the step to decide is not known
    asked = torch.tensor([slowly(definition, rewards, last)]).double()
    got = definition.before(asked, window)
    assert got.dtype == torch.float32
    np.testing.assert_allclose(got[0, length - kept :], shown[last + 1 - kept :], atol=1e-5)


@given(definitions, st.integers(0, 99))
def test_windows_are_counted_one_by_one(definition: ReturnToGo, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    rewards = torch.randint(-8, 9, (4, 6), generator=generator) / 8
    asked = torch.randint(-80, 80, (4,), generator=generator).double() / 8
    apart = [definition.before(asked[b : b + 1], rewards[b : b + 1]) for b in range(4)]
    torch.testing.assert_close(definition.before(asked, rewards), torch.cat(apart))
    assert (definition.before(asked, rewards)[:, -1] == asked).all()
