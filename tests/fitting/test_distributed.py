"""Two processes compute what one would with all rows; alone, nothing is exchanged."""

import os
from pathlib import Path

import pytest
import torch
from torch import nn

from tests.fitting.test_loop import Model
from tests.support.together import together
from ucfrec.errors import InputError
from ucfrec.fitting import distributed

ROWS = torch.tensor([3, 7, 7, 0, 9])
"""The first two are of the first process, the others of the second."""


def make_model() -> Model:
    model = Model(sparse=True)
    model.unused = nn.Parameter(torch.ones(2))
    return model


def test_gradients_and_means_are_those_of_all_rows(tmp_path: Path) -> None:
    whole, values = make_model(), torch.randn(7)
    whole(ROWS).backward()

    def work() -> None:
        model, own = make_model(), ROWS[:2] if distributed.leads() else ROWS[2:]
        model(own).backward()
        distributed.average_gradients(model.parameters(), len(own))
        found, expected = (
            [p.grad if p.grad is None else p.grad.to_dense() for p in each.parameters()]
            for each in (model, whole)
        )
        torch.testing.assert_close(found, expected)
        own = values[:2] if distributed.leads() else values[2:]
        means = distributed.joint_means({"one": float(own.mean())}, len(own))
        assert means == {"one": pytest.approx(float(values.mean()), rel=1e-5)}

    together(2, work, tmp_path)


def test_every_window_is_of_one_process_and_the_leader_goes_first(tmp_path: Path) -> None:
    def work() -> None:
        parts = torch.zeros(11)
        parts[distributed.share(11)] += 1
        torch.distributed.all_reduce(parts)
        assert (parts == 1).all()
        with pytest.raises(InputError, match=r"train\.batch_size"):
            distributed.share(2)
        with distributed.leader_first():
            if distributed.leads():
                (tmp_path / "written").touch()
            assert (tmp_path / "written").exists()

    together(3, work, tmp_path)


def test_alone_nothing_changes() -> None:
    with distributed.joined(), distributed.leader_first():
        assert (distributed.processes(), distributed.rank(), distributed.leads()) == (1, 0, True)
        assert distributed.share(9) == slice(0, 9)
        assert distributed.joint_means({"x": 0.3}, 16) == {"x": 0.3}
        distributed.wait()


def test_a_process_that_ended_is_one_clear_error(tmp_path: Path) -> None:
    def work() -> None:
        if not distributed.leads():
            os._exit(0)
        distributed.wait()

    with pytest.raises(AssertionError, match="another process of this training has ended"):
        together(2, work, tmp_path)
