"""Averaged weights: the formula, tables whose rows rest, resuming, what is saved."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.support.together import together
from ucfrec.fitting import distributed
from ucfrec.fitting.average import WeightAverage
from ucfrec.fitting.checkpoint import load_tensors, load_trained, save_tensors
from ucfrec.fitting.loop import LoopConfig, fit

AVERAGED = LoopConfig(
    steps=40, batch_size=4, learning_rate=0.1, warmup_steps=0, validate_every=8, average=0.9
)
ROWS = 30


class Lookup(nn.Module):
    """A table of which a batch moves a few rows, and a dense layer."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.table = nn.Embedding(ROWS, 3, sparse=True)
        self.layer = nn.Linear(3, 1)

    def forward(self, rows: Tensor) -> Tensor:
        out: Tensor = self.layer(self.table(rows))
        return out


def draw(generator: np.random.Generator) -> Tensor:
    return torch.from_numpy(generator.integers(ROWS - 5, size=4))  # the last five rows never move


def loss(module: nn.Module, rows: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    return (module(rows) - rows.float().unsqueeze(1) / ROWS).square().mean(), {}


def train(
    folder: Path, config: LoopConfig = AVERAGED, stop_at: int | None = None, validated: bool = True
) -> tuple[Lookup, list[list[Tensor]]]:
    """The trained module, and its weights after every step."""
    module, seen, drawn = Lookup(), [], 0

    def stopping(generator: np.random.Generator) -> Tensor:
        nonlocal drawn
        seen.append([p.detach().clone() for p in module.parameters()])
        drawn += 1
        if stop_at is not None and drawn == stop_at:
            raise KeyboardInterrupt
        return draw(generator)

    def validate() -> float:
        return float(loss(module, torch.arange(ROWS))[0])

    given = module, stopping, partial(loss, module), config, folder
    fit(*given, seed=0, validate=validate if validated else None)
    return module, seen


@pytest.mark.parametrize("warmup", [0, 15])
def test_averages_are_those_of_the_formula_for_rows_that_rest_too(
    tmp_path: Path, warmup: int
) -> None:
    config = replace(AVERAGED, warmup_steps=warmup)
    module, seen = train(tmp_path, config, validated=False)
    raw, _ = load_tensors(tmp_path / "last.safetensors")
    names = [name for name, _ in module.named_parameters()]
    steps = [*seen[1:], [raw[name] for name in names]]
    expected = [each.double() for each in seen[0]]
    for t, weights in enumerate(steps, start=1):
        after = max(0, t - warmup)
        d = min(AVERAGED.average, after / (9 + after))
        expected = [
            d * mean + (1 - d) * w.double() for mean, w in zip(expected, weights, strict=True)
        ]
    for name, parameter, mean in zip(names, module.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.detach().double(), mean, rtol=1e-5, atol=1e-6)
        assert not torch.equal(parameter.detach(), raw[name])


def test_a_training_that_ends_with_its_warm_up_is_not_averaged(tmp_path: Path) -> None:
    averaged, raw = (
        train(tmp_path / str(decay), replace(AVERAGED, warmup_steps=40, average=decay))[0]
        for decay in (0.9, 0.0)
    )
    for one, other in zip(averaged.parameters(), raw.parameters(), strict=True):
        assert torch.equal(one, other)


def test_an_interrupted_training_ends_with_the_same_bits(tmp_path: Path) -> None:
    whole, _ = train(tmp_path / "whole")
    for stop in (11, 13, 9):
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "parts", stop_at=stop)
    resumed, _ = train(tmp_path / "parts")
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)
    for name in ("best.safetensors", "last.safetensors"):
        one, _ = load_tensors(tmp_path / "whole" / name)
        other, _ = load_tensors(tmp_path / "parts" / name)
        assert one.keys() == other.keys()
        assert all(torch.equal(one[key], other[key]) for key in one)


def test_processes_that_train_together_have_the_same_averages(tmp_path: Path) -> None:
    """Also of rows that a batch moves in one of the processes only."""

    def work(folder: Path) -> None:
        module, own = Lookup(), distributed.share(AVERAGED.batch_size)

        def validate() -> float:  # inside, the weights are the averages
            save_tensors(folder / f"{distributed.rank()}.safetensors", module.state_dict(), {})
            return 0.0

        fit(
            *(module, lambda generator: draw(generator)[own], partial(loss, module)),
            *(AVERAGED, folder),
            seed=0,
            validate=validate,
            rows=lambda batch: float(len(batch)),
        )

    work(tmp_path / "one")
    together(2, lambda: work(tmp_path / "two"), tmp_path)
    alone, first, second = (
        load_tensors(tmp_path / file)[0]
        for file in ("one/0.safetensors", "two/0.safetensors", "two/1.safetensors")
    )
    for name, mean in alone.items():
        assert torch.equal(first[name], second[name])
        torch.testing.assert_close(first[name], mean, rtol=1e-3, atol=1e-4)


def test_averaging_does_not_change_the_training_itself(tmp_path: Path) -> None:
    train(tmp_path / "averaged")
    train(tmp_path / "raw", replace(AVERAGED, average=0.0))
    averaged, _ = load_tensors(tmp_path / "averaged" / "last.safetensors")
    raw, _ = load_tensors(tmp_path / "raw" / "last.safetensors")
    assert all(torch.equal(averaged[name], raw[name]) for name in raw)


def test_the_averages_are_what_is_loaded_from_either_file(tmp_path: Path) -> None:
    module, _ = train(tmp_path, validated=False)
    for name in ("best.safetensors", "last.safetensors"):
        loaded = load_trained(tmp_path / name)
        assert loaded.keys() == module.state_dict().keys()
        for key, value in module.state_dict().items():
            assert torch.equal(loaded[key], value)


def test_reading_an_average_changes_nothing() -> None:
    module = Lookup()
    average = WeightAverage(module, 0.99)
    for step in range(5):
        module(torch.tensor([step, 0])).sum().backward()
        moved = average.before_step()
        with torch.no_grad():
            for parameter in module.parameters():
                assert parameter.grad is not None
                parameter.sub_(0.1 * parameter.grad.to_dense())
                parameter.grad = None
        average.after_step(moved)
        weights = [p.detach().clone() for p in module.parameters()]
        stored = {name: tensor.clone() for name, tensor in average.state()[0].items()}
        with average.applied():
            assert not torch.equal(module.layer.weight, weights[1])
        assert all(torch.equal(stored[k], v) for k, v in average.state()[0].items())
        assert all(
            torch.equal(one, two.detach())
            for one, two in zip(weights, module.parameters(), strict=True)
        )
