"""The penalised fit of effects, against independent solutions."""

import numpy as np
import pytest
import torch
from scipy import sparse
from sklearn.linear_model import LogisticRegression, Ridge
from torch import Tensor

from ucfrec.user_model.reward_effects import EFFECTS, Design, fit_effects


def design(rows: int, binary: bool, items: int = 12, users: int = 9) -> Design:
    """Random rows of old items; rewards depend on items and the state."""
    rng = np.random.default_rng(0)
    shown = rng.integers(items, size=rows)
    x = rng.normal(size=(rows, 5)) @ rng.normal(size=(5, 5))  # correlated
    vectors = rng.normal(size=(items, 3))
    predictor = rng.normal(size=items)[shown] + 0.3 * x[:, 0] + x[:, 1] * vectors[shown, 0] * 0.2
    target = predictor + rng.normal(size=rows)
    if binary:
        target = rng.random(rows) < 1 / (1 + np.exp(-predictor))
    return Design(
        items=torch.from_numpy(shown),
        users=torch.from_numpy(rng.integers(users + 1, size=rows)),
        x=torch.from_numpy(x).float(),
        observed=torch.from_numpy(x[:, 3:]).float(),
        exposure=torch.from_numpy(rng.random((rows, 4)) < 0.2).float(),
        target=torch.from_numpy(target).float(),
        vectors=torch.from_numpy(vectors).float(),
        rows=torch.from_numpy(vectors[shown]).float(),
        tags=torch.arange(items)[:, None].add(torch.tensor([0, 2])).remainder(5),
        n_tags=4,
        fitted_users=torch.arange(users),
        binary=binary,
        weights=torch.ones(rows),
        running=torch.from_numpy(rng.normal([0, 30, 6.58], [0.05, 0, 0], (rows, 3))).float(),
        interest=torch.from_numpy(rng.normal(size=(rows, 3))).float(),
        tastes=torch.from_numpy(rng.normal(size=rows)).float(),
        position=torch.eye(4)[rng.integers(4, size=rows), 1:],
        above=torch.from_numpy(rng.integers(3, size=(rows, 1))).float(),
    )


def matrix(given: Design, name: str) -> sparse.csr_matrix:
    """What every number of an effect multiplies, row by row."""
    users = torch.nn.functional.one_hot(given.users, len(given.fitted_users) + 1).float()
    tags = torch.stack([(given.tags == tag).sum(1) for tag in range(given.n_tags)], 1)

    def times_vectors(left: Tensor) -> Tensor:
        return torch.einsum("ma,mb->mab", left, given.rows).flatten(1)

    columns = {
        "item": torch.nn.functional.one_hot(given.items, len(given.vectors)).float(),
        "user": users,
        "content": torch.cat([tags[given.items].float(), given.rows], 1),
        "affinity": times_vectors(users),
        "exposure": given.exposure,
        "running": given.running,
        "interest": given.interest,
        "tastes": given.tastes.unsqueeze(1),
        "position": given.position,
        "above": given.above,
        "context": times_vectors(given.observed),
        "state": given.x,
        "interaction": times_vectors(given.x),
    }
    return sparse.csr_matrix(columns[name].double().numpy())


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_that_of_a_penalised_regression(name: str, binary: bool) -> None:
    given = design(33_000 if name == "running" else 600, binary)
    found = fit_effects(given, given.mean_effect(), {name: 3.2})
    penalty = given.penalty(name, 3.2)
    inputs, target = matrix(given, name), given.target.numpy()
    assert penalty * 3.2**2 == pytest.approx(inputs.multiply(inputs).sum() / len(target), rel=1e-4)
    if binary:
        reference = LogisticRegression(C=1 / penalty, tol=1e-8, max_iter=10_000)
    else:
        reference = Ridge(alpha=penalty, tol=1e-8, solver="lsqr" if name == "item" else "auto")
    reference.fit(inputs, target)
    expected = inputs @ reference.coef_.ravel() + reference.intercept_
    np.testing.assert_allclose(given.predictor(found).numpy(), expected, atol=0.02)


def test_effects_are_fitted_jointly_and_a_start_changes_nothing() -> None:
    given = design(800, binary=True)
    spreads = dict.fromkeys(EFFECTS, 0.5)
    alone = fit_effects(given, {}, spreads)
    parts = [matrix(given, name) * given.penalty(name, 0.5) ** -0.5 for name in EFFECTS]
    inputs = sparse.hstack(parts)
    reference = LogisticRegression(C=1.0, tol=1e-8, max_iter=10_000)
    reference.fit(inputs.tocsr(), given.target.numpy())
    expected = inputs @ reference.coef_.ravel() + reference.intercept_
    np.testing.assert_allclose(given.predictor(alone).numpy(), expected, atol=0.05)
    start = {name: torch.randn(given.zeros(name).shape) for name in EFFECTS}
    other = given.predictor(fit_effects(given, start, spreads))
    np.testing.assert_allclose(other.numpy(), given.predictor(alone).numpy(), atol=0.08)
