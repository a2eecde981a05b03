"""What a session shows of tastes: a ridge regression within the session, the same everywhere."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct
from torch import Tensor

from ucfrec.user_model.posterior import UserPosterior, _solution, root_of_tastes

ITEMS, DIM = 12, 3


def planted(seed: int = 0) -> tuple[UserPosterior, Tensor]:
    """Tastes that differ in all directions, and the vectors of the items."""
    random = torch.Generator().manual_seed(seed)
    tastes = UserPosterior(ITEMS, DIM)
    tastes.root.copy_(torch.randn(DIM + 1, DIM + 1, generator=random).tril())
    tastes.usual.copy_(torch.rand(ITEMS, generator=random))
    tastes.weigh(2.5)
    return tastes, torch.randn(ITEMS, DIM, generator=random)


def sessions(rows: int, length: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    items = torch.randint(-1, ITEMS, (rows, length), generator=random)
    return items, torch.rand(rows, length, generator=random).masked_fill(items < 0, 0.0)


def test_tastes_are_those_of_a_gaussian_process() -> None:
    tastes, vectors = planted()
    items, targets = sessions(5, 30)
    found = tastes(items, vectors, targets)
    inputs = (torch.nn.functional.pad(vectors, (1, 0), value=1.0) @ tastes.root).double().numpy()
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
    tastes, vectors = planted()
    items, targets = sessions(3, length, seed)
    order = torch.randperm(length, generator=torch.Generator().manual_seed(seed))
    padding = torch.nn.functional.pad
    found = tastes(items, vectors, targets)
    for other in (
        tastes(items[:, order], vectors, targets[:, order]),
        tastes(padding(items, (2, 3), value=-1), vectors, padding(targets, (2, 3), value=9.0)),
    ):
        torch.testing.assert_close(other, found, rtol=1e-4, atol=1e-4)


def test_nothing_shown_or_nothing_unusual_tells_nothing() -> None:
    tastes, vectors = planted()
    nothing = torch.full((2, 7), -1)
    assert not tastes(nothing, vectors, torch.zeros(2, 7)).any()
    assert not tastes(nothing[:, :0], vectors, torch.zeros(2, 0)).any()
    items = torch.arange(7).expand(2, 7)
    assert not tastes(items, vectors, tastes.usual[items]).any()


def test_what_is_liked_more_than_usual_scores_higher() -> None:
    tastes, vectors = planted()
    for item in range(ITEMS):
        shown = torch.full((1, 4), item)
        found = tastes(shown, vectors, tastes.usual[shown] + 0.5)
        assert float(found[0, 0] + vectors[item] @ found[0, 1:]) > 0


@pytest.mark.parametrize("size", [1, 4, 33])
def test_elimination_solves_what_factorisation_does(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    drawn = torch.from_numpy(rng.normal(size=(users, DIM + 1)) @ spread).float()
    vectors = torch.from_numpy(rng.normal(size=(400, DIM))).float()
    root = root_of_tastes(drawn, vectors)
    inputs = torch.nn.functional.pad(vectors, (1, 0), value=1.0)
    assert float((inputs @ root).square().sum(1).mean()) == pytest.approx(1.0, rel=1e-4)
    if users == 500:
        variances = (root @ root.T).diagonal()
        expected = torch.tensor([0.01, 4.0, 1.0, 0.25])
        torch.testing.assert_close(
            variances / variances.sum(), expected / expected.sum(), rtol=0.2, atol=0.01
        )


def test_users_who_differ_in_one_direction_have_a_root() -> None:
    drawn = torch.zeros(5000, DIM + 1)
    drawn[:, 1] = torch.randn(5000, generator=torch.Generator().manual_seed(0))
    root = root_of_tastes(drawn, torch.eye(DIM))
    assert torch.isfinite(root).all()
    assert float(root[1, 1]) > 30 * float(root[2, 2]) > 0


@pytest.mark.parametrize("broken", [torch.nan, torch.inf])
def test_broken_weights_give_no_number(broken: float) -> None:
    tastes, vectors = planted()
    tastes.root[0, 0] = broken
    items = torch.arange(5).expand(2, 5)
    assert torch.isnan(tastes(items, vectors, torch.zeros(2, 5))).any(1).all()
