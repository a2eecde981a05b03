"""The training loop: bit-exact resumption, early stopping, best weights, logs."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tests.support import killed_training
from tests.support.tensors import assert_same_tensors
from tests.support.together import together
from ucfrec.errors import InputError
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import load_tensors, read_metrics, save_tensors
from ucfrec.fitting.loop import Fit, LoopConfig, RowAdamW, clip_gradients, fit, load_trained

ROOT = Path(__file__).parents[2]
FAST = LoopConfig(
    steps=12, batch_size=4, learning_rate=0.1, warmup_steps=0, validate_every=2, average=0.0
)


def draw(generator: np.random.Generator) -> Tensor:
    return torch.from_numpy(generator.normal(size=(4, 3)).astype(np.float32))


def squared(module: nn.Module) -> Callable[[Tensor], tuple[Tensor, dict[str, Tensor]]]:
    def loss(batch: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        assert module.training
        value = (module(batch) - batch.sum(1, keepdim=True)).square().mean()
        return value, {"mine": value.detach()}

    return loss


def linear() -> nn.Module:
    torch.manual_seed(0)
    return nn.Linear(3, 1)


def weights(module: nn.Module) -> list[Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def equal(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.slow
def test_killed_training_ends_as_if_left_alone(tmp_path: Path) -> None:
    calm, folder = tmp_path / "calm", tmp_path / "killed"
    calm_fit = killed_training.train(calm)
    script = ROOT / "tests" / "support" / "killed_training.py"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = json.loads(subprocess.check_output([sys.executable, script, "1", folder], env=env))
    assert ended["killed"] >= 3
    for key in ("steps", "best_step", "best_validation"):
        assert ended[key] == getattr(calm_fit, key)
    assert_same_tensors(folder, calm, "best", "last")
    every = range(killed_training.EVERY, killed_training.STEPS + 1, killed_training.EVERY)
    losses, logged = (read_metrics(each)["validation_loss"] for each in (calm, folder))
    assert [*logged] == [*every]
    assert logged == losses


def test_a_finished_training_is_not_repeated(tmp_path: Path) -> None:
    first = linear()
    fitted = fit(first, draw, squared(first), FAST, tmp_path, seed=1)

    def nothing(generator: np.random.Generator) -> Tensor:
        raise AssertionError("nothing is left to learn")

    again = linear()
    refitted = fit(again, nothing, squared(again), FAST, tmp_path, seed=1)
    assert equal(weights(first), weights(again))
    assert (refitted.steps, refitted.best_step) == (fitted.steps, fitted.best_step) == (12, 12)
    assert math.isnan(fitted.best_validation)
    other = linear()
    fit(other, draw, squared(other), FAST, tmp_path / "other", seed=2)
    assert not equal(weights(other), weights(again))


@pytest.mark.parametrize("other", [nn.Linear(4, 1), nn.Linear(3, 1, bias=False)])
def test_weights_of_another_architecture_are_named(tmp_path: Path, other: nn.Module) -> None:
    module = linear()
    save_tensors(tmp_path / "last.safetensors", dict(other.state_dict()), {})
    with pytest.raises(InputError, match=r"last\.safetensors holds weights of another"):
        fit(module, draw, squared(module), FAST, tmp_path, seed=1)


def validated(
    folder: Path, losses: list[float], config: LoopConfig
) -> tuple[Fit, nn.Module, list[list[Tensor]]]:
    """Train with validation losses that are given; also the weights at each validation."""
    module, seen = linear(), []

    def validate() -> float:
        assert not module.training
        assert not torch.is_grad_enabled()
        seen.append(weights(module))
        return losses[len(seen) - 1]

    given = module, draw, squared(module), config, folder
    return fit(*given, seed=1, validate=validate), module, seen


def test_the_best_weights_come_back(tmp_path: Path) -> None:
    losses = [3.0, 1.0, 2.0, 1.0, 4.0, 2.0]
    fitted, module, seen = validated(tmp_path, losses, FAST)
    assert (fitted.steps, fitted.best_step, fitted.best_validation) == (12, 4, 1.0)
    logged = read_metrics(tmp_path)
    assert [*logged["validation_loss"].items()] == [(2 * n, x) for n, x in enumerate(losses, 1)]
    assert logged["mine"] == logged["loss"]
    assert all(map(math.isfinite, logged["gradient_norm"].values()))
    assert equal(weights(module), seen[1])
    assert not equal(seen[1], seen[5])
    assert not module.training
    last, _ = load_tensors(tmp_path / "last.safetensors")
    assert equal([last["weight"], last["bias"]], seen[5])


@pytest.mark.parametrize(
    ("patience", "steps", "best"), [(0, 15, 14), (1, 6, 4), (2, 8, 4), (3, 15, 14)]
)
def test_patience_stops_early(tmp_path: Path, patience: int, steps: int, best: int) -> None:
    config = replace(FAST, steps=15, patience=patience)  # the last, odd step is validated, too
    losses = [3.0, 2.0, 2.0, 2.5, 1.9, 2.0, 1.0, 1.5]
    fitted, module, seen = validated(tmp_path, losses, config)
    assert (fitted.steps, fitted.best_step) == (steps, best)
    assert equal(weights(module), seen[best // 2 - 1])
    # Started again, it is as patient as it was: nothing more is learnt.
    again, module, seen = validated(tmp_path, [], config)
    assert (again.steps, again.best_step, seen) == (steps, best, [])


@pytest.mark.parametrize(
    ("cosine", "rates"),
    [
        (False, [0.02, 0.04, 0.06, 0.08, 0.1, 0.1, 0.1]),
        (True, [0.02, 0.04, 0.06, 0.08, 0.1, 0.05, 0.0]),
    ],
)
def test_steps_are_those_of_torch(tmp_path: Path, cosine: bool, rates: list[float]) -> None:
    lengths = replace(FAST, steps=7, warmup_steps=5, validate_every=3)
    config = replace(lengths, weight_decay=0.2, cosine=cosine, clip_norm=0.3)
    batches: list[Tensor] = []

    def remembered(generator: np.random.Generator) -> Tensor:
        batches.append(draw(generator))
        return batches[-1]

    module = linear()
    fit(module, remembered, squared(module), config, tmp_path, seed=1)

    twin = linear()
    optimizer = torch.optim.AdamW(twin.parameters(), weight_decay=0.2)
    for rate, batch in zip(rates, batches, strict=True):
        optimizer.param_groups[0]["lr"] = rate
        optimizer.zero_grad()
        squared(twin)(batch)[0].backward()
        norm = math.sqrt(sum(float(p.grad.square().sum()) for p in twin.parameters()))
        for parameter in twin.parameters():
            parameter.grad *= min(1.0, 0.3 / norm)
        optimizer.step()
    for a, b in zip(weights(module), weights(twin), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
    assert len({tuple(batch.flatten().tolist()) for batch in batches}) == 7


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_is_named(tmp_path: Path, bad: float) -> None:
    module, calls = linear(), []

    def loss(batch: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        calls.append(1)
        value, scalars = squared(module)(batch)
        return value * (bad if len(calls) > 4 else 1.0), scalars

    with pytest.raises(InputError, match=r"critic: the loss is (nan|inf) at step 6") as caught:
        fit(module, draw, loss, FAST, tmp_path, seed=1, describe="critic")
    assert "\n" not in str(caught.value)
    kept, about = load_tensors(tmp_path / "last.safetensors")
    assert about["step"] == 4
    assert all(torch.isfinite(tensor).all() for tensor in kept.values())
    with pytest.raises(InputError, match="validation loss is nan"):
        validated(tmp_path / "validated", [math.nan], FAST)


def test_speed_and_waiting_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module, seconds = linear(), 0.0  # of a clock that no other work on the machine can slow down
    clock = SimpleNamespace(perf_counter=lambda: seconds)
    monkeypatch.setattr("ucfrec.fitting.loop.time", clock)

    def takes(more: float, result: Any) -> Any:
        nonlocal seconds
        seconds += more
        return result

    def loss(batch: Tensor) -> Any:
        return takes(0.5, squared(module)(batch))

    config = LoopConfig(steps=15, batch_size=64, validate_every=5)
    given = module, lambda generator: takes(0.75, draw(generator)), loss, config, tmp_path
    fitted = fit(*given, seed=1, validate=lambda: takes(4, 0.0))  # which counts as neither
    assert fitted.seconds == 15 * 1.25 + 3 * 4
    logged = read_metrics(tmp_path)
    assert logged["waiting_for_data"] == dict.fromkeys((5, 10, 15), 0.75 / 1.25)
    assert logged["samples_per_second"] == dict.fromkeys((5, 10, 15), 64 / 1.25)


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


def trained(model: Model, rows: list[Tensor], decay: float, largest: float = 0.0) -> list[float]:
    optimizer = RowAdamW(model.parameters(), lr=0.05, weight_decay=decay, fused=True)
    norms = []
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


AVERAGED = LoopConfig(
    steps=40, batch_size=4, learning_rate=0.1, warmup_steps=0, validate_every=8, average=0.9
)


def draw_rows(generator: np.random.Generator) -> Tensor:
    return torch.from_numpy(generator.integers(25, size=4))  # half of the rows never move


def row_loss(module: nn.Module, rows: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    return module(rows), {}


def train(
    folder: Path, config: LoopConfig = AVERAGED, stop_at: int | None = None, validated: bool = True
) -> tuple[Model, list[list[Tensor]]]:
    """The trained module, and its weights before every step."""
    module, seen = Model(True), []

    def stopping(generator: np.random.Generator) -> Tensor:
        seen.append(weights(module))
        if len(seen) == stop_at:
            raise KeyboardInterrupt
        return draw_rows(generator)

    def validate() -> float:
        return float(module(torch.arange(50)))

    given = module, stopping, partial(row_loss, module), config, folder
    fit(*given, seed=0, validate=validate if validated else None)
    return module, seen


@pytest.mark.parametrize("warmup", [0, 15, 40])
def test_averages_are_those_of_the_formula(tmp_path: Path, warmup: int) -> None:
    config = replace(AVERAGED, warmup_steps=warmup)
    module, seen = train(tmp_path, config, validated=False)
    raw, _ = load_tensors(tmp_path / "last.safetensors")
    names = [name for name, _ in module.named_parameters()]
    expected = [each.double() for each in seen[0]]
    for t, step in enumerate([*seen[1:], [raw[name] for name in names]], start=1):
        after = max(0, t - warmup)
        d = min(AVERAGED.average, after / (9 + after))
        pairs = zip(expected, step, strict=True)
        expected = [d * mean + (1 - d) * w.double() for mean, w in pairs]
    for name, parameter, mean in zip(names, module.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.detach().double(), mean, rtol=1e-5, atol=1e-6)
        assert torch.equal(parameter.detach(), raw[name]) == (warmup == AVERAGED.steps)
    for file in ("best.safetensors", "last.safetensors"):
        loaded = load_trained(tmp_path / file)
        assert all(torch.equal(loaded[key], each) for key, each in module.state_dict().items())


def test_an_interrupted_training_ends_with_the_same_bits(tmp_path: Path) -> None:
    whole, _ = train(tmp_path / "whole")
    for stop in (11, 13, 9):
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "parts", stop_at=stop)
    resumed, _ = train(tmp_path / "parts")
    assert equal(weights(whole), weights(resumed))
    assert_same_tensors(tmp_path / "whole", tmp_path / "parts", "best", "last")


def test_processes_that_train_together_have_the_same_averages(tmp_path: Path) -> None:
    """Also of rows that a batch moves in one of the processes only."""

    def work(folder: Path) -> None:
        module, own = Model(True), distributed.share(AVERAGED.batch_size)

        def validate() -> float:  # inside, the weights are the averages
            save_tensors(folder / f"{distributed.rank()}.safetensors", module.state_dict(), {})
            return 0.0

        loss, rows = partial(row_loss, module), lambda batch: float(len(batch))
        part = lambda generator: draw_rows(generator)[own]  # noqa: E731
        fit(module, part, loss, AVERAGED, folder, seed=0, validate=validate, rows=rows)

    work(tmp_path / "one")
    together(2, lambda: work(tmp_path / "two"), tmp_path)
    files = (tmp_path / f"{name}.safetensors" for name in ("one/0", "two/0", "two/1"))
    alone, first, second = (load_tensors(file)[0] for file in files)
    for name, mean in alone.items():
        assert torch.equal(first[name], second[name])
        torch.testing.assert_close(first[name], mean, rtol=1e-3, atol=1e-4)


def test_averaging_and_reading_averages_do_not_change_the_training_itself(tmp_path: Path) -> None:
    configs = (AVERAGED, replace(AVERAGED, validate_every=40), replace(AVERAGED, average=0.0))
    for number, config in enumerate(configs):
        train(tmp_path / str(number), config)
    often, once, raw = (load_tensors(tmp_path / n / "last.safetensors")[0] for n in "012")
    assert often.keys() == once.keys() > raw.keys()
    assert all(torch.equal(often[name], once[name]) for name in often)
    assert all(torch.equal(often[name], raw[name]) for name in raw)
