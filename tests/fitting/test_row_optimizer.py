"""Tables: rows with gradients move as by AdamW, others stay; checkpoints and clipping hold too."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.fitting.checkpoint import load_training, save_training
from ucfrec.fitting.row_optimizer import RowAdamW, clip_gradients


class Model(nn.Module):
    """A table of which a few rows are read, and a dense layer."""

    def __init__(self, sparse: bool) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.table, self.line = nn.Parameter(torch.randn(50, 4)), nn.Linear(4, 1)
        self.bias, self.sparse = nn.Parameter(torch.randn(50)), sparse

    def forward(self, rows: Tensor) -> Tensor:
        """A loss of the rows."""
        vectors = F.embedding(rows, self.table, sparse=self.sparse)
        bias = torch.gather(self.bias, 0, rows, sparse_grad=self.sparse)
        return (self.line(vectors).squeeze(-1) + bias).square().mean()


def optimizer_of(module: nn.Module, decay: float = 0.0) -> RowAdamW:
    return RowAdamW(module.parameters(), lr=0.05, weight_decay=decay, fused=True)


def trained(model: Model, rows: list[Tensor], decay: float, largest: float = 0.0) -> list[float]:
    optimizer, norms = optimizer_of(model, decay), []
    for each in rows:
        optimizer.zero_grad()
        model(each).backward()
        norms.append(float(clip_gradients(model.parameters(), largest)))
        optimizer.step()
    return norms


@pytest.mark.parametrize("largest", [0.0, 0.5])
@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_with_all_rows_in_every_step_it_is_adamw(decay: float, largest: float) -> None:
    torch.manual_seed(1)
    rows = [torch.cat([torch.randperm(50), torch.randint(50, (9,))]) for _ in range(6)]
    tables, dense = Model(True), Model(False)
    norms = trained(tables, rows, decay, largest)
    assert norms == pytest.approx(trained(dense, rows, decay, largest), rel=1e-5)
    for found, expected in zip(tables.parameters(), dense.parameters(), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_rows_without_a_gradient_stay() -> None:
    model, before = Model(True), Model(True)
    trained(model, [torch.tensor([3, 7, 7]), torch.tensor([3])], 0.3)
    others = torch.tensor([row for row in range(50) if row not in (3, 7)])
    assert torch.equal(model.table[others], before.table[others])
    assert torch.equal(model.bias[others], before.bias[others])
    assert (model.table[[3, 7]] != before.table[[3, 7]]).all()


def test_clipping_dense_gradients_is_that_of_torch() -> None:
    found, expected = Model(False), Model(False)
    for model in (found, expected):
        model(torch.arange(50)).backward()
    norm = clip_gradients(found.parameters(), 0.1)
    assert torch.equal(norm, nn.utils.clip_grad_norm_(expected.parameters(), 0.1))
    for one, other in zip(found.parameters(), expected.parameters(), strict=True):
        assert one.grad is not None
        assert other.grad is not None
        assert torch.equal(one.grad, other.grad)


def test_a_checkpoint_restores_the_moments_of_rows(tmp_path: Path) -> None:
    torch.manual_seed(2)
    rows = [torch.randint(50, (20,)) for _ in range(8)]
    whole, first, second = Model(True), Model(True), Model(True)
    trained(whole, rows, 0.1)
    optimizer = optimizer_of(first, 0.1)
    for count, each in enumerate(rows):
        if count == 4:
            save_training(tmp_path / "last", first, optimizer, {})
            first, optimizer = second, optimizer_of(second, 0.1)
            load_training(tmp_path / "last", first, optimizer)
        optimizer.zero_grad()
        first(each).backward()
        clip_gradients(first.parameters(), 0.0)
        optimizer.step()
    for found, expected in zip(first.parameters(), whole.parameters(), strict=True):
        assert torch.equal(found, expected)
