"""The reward model of items: what its scores depend on, and what they equal."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.windows import Shown
from ucfrec.user_model.reward import ItemRewardModel, UserPosterior, _solution, root_of_tastes

ITEMS, USERS, STATE, DIM = 30, 5, 6, 4


def planted(tags: bool, binary: bool = True) -> ItemRewardModel:
    """A model with random effects."""
    sizes = {"state": STATE, "action": DIM, "items": ITEMS, "users": USERS, "tags": 2 * tags}
    model = ItemRewardModel(sizes)
    random = torch.Generator().manual_seed(0)
    for name, buffer in model.named_buffers():
        if buffer.is_floating_point() and buffer.ndim and name != "state_std":
            buffer.copy_(torch.randn(buffer.shape, generator=random))
    if tags:
        model.likeness.tags.copy_(torch.randint(-1, 4, (ITEMS, 2), generator=random))
        model.likeness.n_tags.fill_(4)
    else:
        model.likeness.directions.copy_(F.normalize(model.likeness.directions, dim=1))
    model.binary.fill_(binary)
    model.reward_low.fill_(-1.0)
    model.reward_high.fill_(2.0)
    return model


def asked(rows: int, lags: int) -> tuple[Tensor, Shown, Tensor]:
    """Random states, items shown before and users."""
    random = torch.Generator().manual_seed(1)
    states = torch.randn(rows, STATE, generator=random)
    items = torch.randint(-1, ITEMS, (rows, lags), generator=random)
    rewards = 3 * torch.rand(rows, lags, generator=random) - 1
    shown = Shown(items, rewards.masked_fill(items < 0, 0.0))
    return states, shown, torch.randint(-1, USERS + 2, (rows,), generator=random)


def score_by_hand(model: ItemRewardModel, state: Tensor, shown: Shown, user: int, i: int) -> float:
    """The sum of the model's definition, term by term."""
    x = ((state - model.state_mean) / model.state_std).clamp(-5, 5)
    row = user if 0 <= user < USERS else USERS
    query = model.affinity[row] + x @ model.interaction
    total = model.item[i] + model.user[row] + x @ model.state + query @ model.vectors[i]
    likeness = model.likeness
    for lag, j in enumerate(shown.items.tolist()[: model.lags]):
        if j < 0:
            continue
        if likeness.tags.shape[1]:
            mine, other = likeness.tags[i].tolist(), likeness.tags[j].tolist()
            alike = sum(mine.count(tag) * other.count(tag) for tag in set(mine) if tag >= 0)
        else:
            alike = float(likeness.directions[i] @ likeness.directions[j])
        liked = (float(shown.rewards[lag]) - -1) / 3
        repeated, like, repeated_liked, like_liked = model.exposure[:, lag]
        total = total + (repeated + repeated_liked * liked) * (i == j)
        total = total + (like + like_liked * liked) * alike
    return float(total)


@pytest.mark.parametrize("tags", [True, False])
def test_scores_are_the_sum_of_the_effects_also_of_one_item_alone(tags: bool) -> None:
    model = planted(tags)
    states, shown, users = asked(7, model.lags)
    scores, items = model.scores(states, shown, users), torch.arange(7) * 3
    assert scores.shape == (7, ITEMS)
    alone = model.score(states, shown, users, items)
    torch.testing.assert_close(alone, scores[torch.arange(7), items])
    for row in range(7):
        for item in range(0, ITEMS, 7):
            expected = score_by_hand(model, states[row], shown.at(row), int(users[row]), item)
            assert float(scores[row, item]) == pytest.approx(expected, abs=1e-4)


def test_missing_lags_are_steps_before_the_session_and_unknown_users_are_alike() -> None:
    model = planted(tags=True)
    states, shown, _ = asked(4, model.lags + 3)
    few, most, missing = shown.latest(4), shown.latest(model.lags), (0, model.lags - 4)
    padded = Shown(F.pad(few.items, missing, value=-1), F.pad(few.rewards, missing))
    assert torch.equal(model.scores(states, few), model.scores(states, padded))
    torch.testing.assert_close(model.scores(states, shown), model.scores(states, most))
    for unknown in (-1, USERS, USERS + 9):
        users = torch.full((4,), unknown)
        assert torch.equal(model.scores(states, few, users), model.scores(states, few))
    # The level is what all items share.
    for effects in (model.interaction, model.affinity, model.exposure):
        effects.zero_()
    level = model.level(states, None, model.tastes_after(shown, None)).unsqueeze(1)
    rest = model.scores(states, shown) - level
    torch.testing.assert_close(rest, model.item.expand(4, -1), atol=1e-5, rtol=0)


def test_expected_rewards_are_in_reward_units() -> None:
    model = planted(tags=False)
    scores = torch.tensor([-50.0, 0.0, 50.0])
    torch.testing.assert_close(model.expect(scores), torch.tensor([-1.0, 0.5, 2.0]))
    model.binary.fill_(False)
    model.reward_mean.fill_(3.0)
    model.reward_std.fill_(2.0)
    torch.testing.assert_close(model.expect(scores), torch.tensor([-97.0, 3.0, 103.0]))


CATALOGUE, SIZE = 12, 3


def planted_tastes(seed: int = 0) -> tuple[UserPosterior, Tensor]:
    """Tastes that differ in all directions, and the vectors of the items."""
    random = torch.Generator().manual_seed(seed)
    tastes = UserPosterior(CATALOGUE, SIZE)
    tastes.root.copy_(torch.randn(SIZE + 1, SIZE + 1, generator=random).tril())
    tastes.usual.copy_(torch.rand(CATALOGUE, generator=random))
    tastes.weigh(torch.tensor(2.5))
    return tastes, torch.randn(CATALOGUE, SIZE, generator=random)


def sessions(rows: int, length: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    items = torch.randint(-1, CATALOGUE, (rows, length), generator=random)
    return items, torch.rand(rows, length, generator=random).masked_fill(items < 0, 0.0)


def test_tastes_are_those_of_a_gaussian_process() -> None:
    tastes, vectors = planted_tastes()
    items, targets = sessions(5, 30)
    found = tastes(items, vectors, targets)
    inputs = (F.pad(vectors, (1, 0), value=1.0) @ tastes.root).double().numpy()
    for row in range(5):
        shown = items[row][items[row] >= 0]
        unusual = (targets[row][items[row] >= 0] - tastes.usual[shown]).double().numpy()
        # Its kernel is the product of the inputs; its noise has variance 1.
        process = GaussianProcessRegressor(DotProduct(0.0, "fixed"), alpha=1.0, optimizer=None)
        expected = process.fit(inputs[shown.numpy()], unusual).predict(inputs)
        scores = found[row, 0] + vectors @ found[row, 1:]
        np.testing.assert_allclose(scores.numpy() / 2.5, expected, atol=1e-4)


@settings(max_examples=30, deadline=None)
@given(length=st.integers(0, 20), seed=st.integers(0, 99))
def test_neither_order_nor_padding_matters(length: int, seed: int) -> None:
    tastes, vectors = planted_tastes()
    items, targets = sessions(3, length, seed)
    order = torch.randperm(length, generator=torch.Generator().manual_seed(seed))
    found = tastes(items, vectors, targets)
    ordered = tastes(items[:, order], vectors, targets[:, order])
    padded = tastes(F.pad(items, (2, 3), value=-1), vectors, F.pad(targets, (2, 3), value=9.0))
    for other in (ordered, padded):
        torch.testing.assert_close(other, found, rtol=1e-4, atol=1e-4)


def test_nothing_shown_or_nothing_unusual_tells_nothing() -> None:
    tastes, vectors = planted_tastes()
    nothing = torch.full((2, 7), -1)
    assert not tastes(nothing, vectors, torch.zeros(2, 7)).any()
    assert not tastes(nothing[:, :0], vectors, torch.zeros(2, 0)).any()
    items = torch.arange(7).expand(2, 7)
    assert not tastes(items, vectors, tastes.usual[items]).any()


@pytest.mark.parametrize("size", [1, 4, 33])
def test_elimination_equals_factorisation(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    random = torch.Generator().manual_seed(size)
    inputs = 5 * torch.randn(6, 50, size, generator=random)
    matrix, right = inputs.mT @ inputs + torch.eye(size), torch.randn(6, size, 1, generator=random)
    expected = torch.linalg.solve(matrix.double(), right.double()).float()
    torch.testing.assert_close(_solution(matrix, right), expected, rtol=1e-3, atol=1e-5)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    torch.testing.assert_close(_solution(matrix, right), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("users", [2, 500])
def test_the_root_is_of_how_users_differ(users: int) -> None:
    rng = np.random.default_rng(0)
    spread = np.diag([0.1, 2.0, 1.0, 0.5])
    drawn = torch.from_numpy(rng.normal(size=(users, SIZE + 1)) @ spread).float()
    vectors = torch.from_numpy(rng.normal(size=(400, SIZE))).float()
    inputs = F.pad(vectors, (1, 0), value=1.0)
    root = root_of_tastes(drawn, inputs)
    assert float((inputs @ root).square().sum(1).mean()) == pytest.approx(1.0, rel=1e-4)
    if users == 500:
        variances, expected = (root @ root.T).diagonal(), torch.tensor([0.01, 4.0, 1.0, 0.25])
        shares = expected / expected.sum()
        torch.testing.assert_close(variances / variances.sum(), shares, rtol=0.2, atol=0.01)


def test_users_who_differ_in_one_direction_have_a_root() -> None:
    drawn = torch.zeros(5000, SIZE + 1)
    drawn[:, 1] = torch.randn(5000, generator=torch.Generator().manual_seed(0))
    root = root_of_tastes(drawn, F.pad(torch.eye(SIZE), (1, 0), value=1.0))
    assert torch.isfinite(root).all()
    assert float(root[1, 1]) > 30 * float(root[2, 2]) > 0


@pytest.mark.parametrize("broken", [torch.nan, torch.inf])
def test_broken_weights_give_no_number(broken: float) -> None:
    tastes, vectors = planted_tastes()
    tastes.root[0, 0] = broken
    items = torch.arange(5).expand(2, 5)
    assert torch.isnan(tastes(items, vectors, torch.zeros(2, 5))).any(1).all()
