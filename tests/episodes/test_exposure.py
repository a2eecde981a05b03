"""Terms added to logits by what was shown lately: against loops, and what they must not see."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ucfrec.episodes import exposure
from ucfrec.episodes.exposure import ExposureTerm, Likeness, quantiles
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed, Windows

B, K, ITEMS, TAGS, LAGS, KNOTS = 4, 6, 9, 5, 3, 4
LOW, HIGH = 1.0, 5.0
kinds = st.sampled_from(["tags", "embeddings"])
seeds = st.integers(0, 10**6)


def item_states(kind: str, seed: int = 0) -> ItemStates:
    """Items with up to three tags or none at all, or with embeddings of which one is zero."""
    generator = torch.Generator().manual_seed(seed)
    embeddings = torch.randn(ITEMS, 4, generator=generator)
    embeddings[-1] = 0.0
    states = ItemStates(embeddings, torch.zeros(0, 0), LOW, HIGH)
    if kind == "embeddings":
        return states
    tags = torch.full((ITEMS, 3), -1)
    for item in range(1, ITEMS):
        own = torch.randperm(TAGS, generator=generator)[: 1 + item % 3]
        tags[item, : len(own)] = own
    return replace(states, tags=tags)


def term(kind: str, seed: int, knots: int = KNOTS) -> ExposureTerm:
    """With random weights, and knots at random returns."""
    generator = torch.Generator().manual_seed(seed)
    states = item_states(kind, seed)
    made = ExposureTerm(LAGS, knots, Likeness.of(states))
    made.start_from(states, torch.randn(50, generator=generator))
    for parameter in made.parameters():
        parameter.data = torch.randn(parameter.shape, generator=generator) / 10
    return made


def exposed(steps: int, seed: int) -> Exposed:
    """With rewards on the scale of the items, and some below and above it."""
    generator = torch.Generator().manual_seed(seed)
    items = torch.randint(-1, ITEMS, (steps, LAGS), generator=generator)
    rewards = LOW - 1 + (HIGH - LOW + 2) * torch.rand(steps, LAGS, generator=generator)
    return Exposed(items, rewards, 2 * torch.randn(steps, generator=generator))


def weights_by_hand(made: ExposureTerm, returns: float, rewards: list[float]) -> list[list[float]]:
    """Weights of repetition and of likeness by lag, from the documentation of `ExposureTerm`."""
    knots = made.knots.tolist()
    table = 10 * (made.common + made.by_lag).detach().double()
    at = min(max(returns, knots[0]), knots[-1])
    right = next(n for n in range(1, len(knots)) if at <= knots[n])
    share = (at - knots[right - 1]) / (knots[right] - knots[right - 1])
    found = (1 - share) * table[:, right - 1] + share * table[:, right]
    liked = [min(max((reward - LOW) / (HIGH - LOW), 0.0), 1.0) for reward in rewards]
    return [[float(found[i, n] + found[i + 1, n] * liked[n]) for n in range(LAGS)] for i in (0, 2)]


def alike(states: ItemStates, one: int, other: int) -> float:
    if states.tags.shape[1]:
        first, second = (set(states.tags[item].tolist()) - {-1} for item in (one, other))
        return len(first & second)
    a, b = states.embeddings[one].double(), states.embeddings[other].double()
    lengths = a.norm() * b.norm()
    return float(a @ b / lengths) if lengths > 0 else 0.0


def slowly(made: ExposureTerm, states: ItemStates, shown: Exposed) -> Tensor:
    """The terms added to all logits, one at a time."""
    added = torch.zeros(len(shown.items), ITEMS, dtype=torch.float64)
    given = (values.tolist() for values in (shown.items, shown.rewards, shown.returns))
    for row, (items, rewards, returns) in enumerate(zip(*given, strict=True)):
        repeated, likeness = weights_by_hand(made, returns, rewards)
        for (lag, item), other in product(enumerate(items), range(ITEMS)):
            if item >= 0:
                added[row, other] += likeness[lag] * alike(states, other, item)
                added[row, other] += repeated[lag] * (other == item)
    return added.float()


def added(made: ExposureTerm, shown: Exposed, items: Tensor | None = None) -> Tensor:
    """What the term adds to the logits of `items`, or of all."""
    zeros = torch.zeros(len(shown.items), ITEMS if items is None else len(items))
    return made.added_to(zeros, shown, items)


@given(kinds, seeds)
def test_additions_are_those_of_loops_over_items_and_lags(kind: str, seed: int) -> None:
    made, shown = term(kind, seed), exposed(7, seed)
    expected = slowly(made, item_states(kind, seed), shown)
    everything = added(made, shown).detach()
    torch.testing.assert_close(everything, expected, rtol=1e-4, atol=1e-4)
    some = torch.tensor([0, 4, ITEMS - 1])
    torch.testing.assert_close(added(made, shown, some).detach(), everything[:, some])
    own = torch.arange(7) % ITEMS
    one_each = made.to_items(shown, own.unsqueeze(1)).detach()
    torch.testing.assert_close(one_each, everything[torch.arange(7), own])


@pytest.mark.parametrize("kind", ["tags", "embeddings"])
def test_a_large_catalogue_is_sparse(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made, shown = term(kind, 3), exposed(20, 3)
    dense = added(made, shown)
    assert kind == "embeddings" or not made.likeness._tag_matrix().is_sparse
    some = torch.tensor([1, 2, ITEMS - 2])
    torch.testing.assert_close(added(made, shown, some), dense[:, some])
    monkeypatch.setattr(exposure, "_DENSE", ITEMS * TAGS - 1)
    monkeypatch.setattr(exposure, "_FEW_TAGS", TAGS - 1)
    large = term(kind, 3)
    found = added(large, shown)
    assert kind == "embeddings" or large.likeness._tag_matrix().is_sparse
    torch.testing.assert_close(found, dense)
    torch.testing.assert_close(added(large, shown, some), dense[:, some])
    gradients = [
        torch.autograd.grad(out.square().sum(), [*term_.parameters()])
        for out, term_ in ((dense, made), (found, large))
    ]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("returns", [[0.0] * 9, [0.0] * 8 + [5.0], [-3.0, 2.0, 7.5, 1e6], [4.0]])
def test_knots_rise_and_cover_the_returns(returns: list[float]) -> None:
    made = term("tags", 0)
    made.start_from(item_states("tags"), torch.tensor(returns))
    assert (made.knots.diff() > 0).all()
    assert float(made.knots[0]) == pytest.approx(min(returns))
    assert float(made.knots[-1]) >= max(returns)
    at = torch.tensor([-1e9, *returns, 1e9])
    items, liked = torch.zeros(len(at), LAGS, dtype=torch.int64), torch.full((len(at), LAGS), HIGH)
    weights = torch.stack(made.weights(Exposed(items, liked, at)))
    assert torch.isfinite(weights).all()
    table = 10 * (made.common + made.by_lag)
    for end in (0, -1):
        torch.testing.assert_close(weights[:, end], (table[[0, 2]] + table[[1, 3]])[:, end])


def windows(seed: int, padding: tuple[int, ...] = (0, 1, 4, 5)) -> Windows:
    generator = torch.Generator().manual_seed(seed)
    return Windows(
        states=torch.randn(B, K, 2, generator=generator),
        actions=torch.randint(ITEMS, (B, K), generator=generator),
        rewards=LOW + (HIGH - LOW) * torch.rand(B, K, generator=generator),
        returns_to_go=torch.rand(B, K, generator=generator),
        timesteps=torch.zeros(B, K, dtype=torch.int64),
        mask=torch.arange(K) >= torch.tensor(padding).unsqueeze(1),
    )


@given(seeds, st.integers(1, K + 3))
def test_steps_before_a_step_are_found_one_by_one(seed: int, lags: int) -> None:
    given_windows = windows(seed)
    found = Exposed.before(given_windows, lags)
    assert found.items.shape == found.rewards.shape == (B * K, lags)
    torch.testing.assert_close(found.returns.view(B, K), given_windows.returns_to_go)
    for b, t, lag in product(range(B), range(K), range(1, lags + 1)):
        there = t - lag >= 0 and bool(given_windows.mask[b, t - lag])
        expected = int(given_windows.actions[b, t - lag]) if there else -1
        assert found.items.view(B, K, lags)[b, t, lag - 1] == expected
        reward = found.rewards.view(B, K, lags)[b, t, lag - 1]
        assert not there or reward == given_windows.rewards[b, t - lag]
    chosen, rows = Exposed.before(given_windows, lags, given_windows.mask), given_windows.mask
    for name in ("items", "rewards", "returns"):
        values = getattr(chosen, name)
        assert torch.equal(values, getattr(found, name)[rows.flatten()])
    last = Exposed.before_last(given_windows, lags)
    assert torch.equal(last.items, found.items[K - 1 :: K])


def test_a_term_read_back_is_the_one_saved() -> None:
    made, shown = term("tags", 2), exposed(6, 2)
    expected = added(made, shown)
    other = ExposureTerm(LAGS, KNOTS, Likeness(ITEMS, 4, 3))
    added(other, shown)  # a matrix of tags has been made before the weights are read
    other.load_state_dict(made.state_dict())
    torch.testing.assert_close(added(other, shown), expected)


@given(
    values=st.lists(st.floats(-(2.0**90), 2.0**90, width=32), min_size=1, max_size=60),
    levels=st.lists(st.floats(0, 1), min_size=1, max_size=8),
)
def test_quantiles_are_numpys_to_the_last_bit(values: list[float], levels: list[float]) -> None:
    found = quantiles(np.array(values, dtype=np.float32), np.array(levels))
    np.testing.assert_array_equal(found, np.quantile(np.array(values), levels))
