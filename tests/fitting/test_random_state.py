"""Functions that seed the global generators restore them for their caller."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.policies.test_known_answers import ITEMS_ONLY
from tests.support import killed_run
from ucfrec.counterfactual.augmentation import counterfactual_augmentation
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.collect import simulated_store
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.fitting.loop import LoopConfig, fit
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.policies.registry import BUILT_IN
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import new_policy
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture
def store(tmp_path: Path) -> EpisodeStore:
    rng = np.random.default_rng(0)
    columns = {
        "observation": rng.normal(size=(300, 4)),
        "action": rng.uniform(-1, 1, size=(300, 2)),
        "reward": rng.normal(size=300),
    }
    split = np.repeat([0, 1], [40, 10]).astype(np.uint8)
    return EpisodeStore.write(tmp_path / "store", columns, np.full(50, 6), {"split": split})


@contextmanager
def unnoticed() -> Iterator[None]:
    """All three global generators are as they were before."""
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    torch.manual_seed(5)
    before = torch.get_rng_state()
    yield
    assert torch.equal(torch.get_rng_state(), before)
    drawn = (random.random(), float(np.random.random()))  # noqa: NPY002
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    assert drawn == (random.random(), float(np.random.random()))  # noqa: NPY002


def linear_fit(folder: Path, rate: float = 0.1) -> nn.Linear:
    module = nn.Linear(2, 1)

    def loss(batch: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return nn.functional.dropout(module(batch)).square().mean() * rate, {}

    def draw(generator: np.random.Generator) -> Tensor:
        return torch.from_numpy(generator.random((4, 2), dtype=np.float32))

    fit(module, draw, loss, LoopConfig(steps=4, validate_every=2), folder, seed=1)
    return module


def test_what_is_kept_is_kept_when_it_raises_too() -> None:
    def spoil() -> None:
        random.seed(0)
        np.random.seed(0)  # noqa: NPY002
        torch.manual_seed(0)
        raise ValueError("enough")

    with unnoticed(), pytest.raises(ValueError, match="enough"), random_state_kept():
        spoil()
    with unnoticed(), pytest.raises(ValueError, match="enough"):
        random_state_kept()(spoil)()


def test_the_loop(tmp_path: Path) -> None:
    with unnoticed():
        state = torch.get_rng_state()
        module = nn.Linear(2, 1)
        after = torch.get_rng_state()
        assert not torch.equal(state, after)
        torch.set_rng_state(state)
        fitted = linear_fit(tmp_path / "a")
        assert torch.equal(torch.get_rng_state(), after)
        torch.set_rng_state(state)
    assert not torch.equal(fitted.weight, module.weight)
    torch.manual_seed(5)
    with pytest.raises(InputError, match="is nan"):
        linear_fit(tmp_path / "b", float("nan"))
    assert torch.equal(torch.get_rng_state(), after)


@pytest.mark.parametrize("kind", ["tangent", "faithful", "noise"])
def test_augmentation(store: EpisodeStore, tmp_path: Path, kind: str) -> None:
    config = resolve_config("ucf", None, {"crm.epochs": 1, "csg.epochs": 1, "csg.kind": kind})
    tables = (config.crm, config.csg, config.augment)
    with unnoticed():
        counterfactual_augmentation(
            store.split("train"), store.split("validation"), *tables, tmp_path, 0
        )


@pytest.mark.parametrize("name", sorted({*BUILT_IN} - {*ITEMS_ONLY}))
def test_a_run_and_reading_it_back(store: EpisodeStore, tmp_path: Path, name: str) -> None:
    quick = {"policy.cql_steps": 3} if name == "edt4rec" else {}
    quick |= {"policy.kernel_groups": 4} if name == "lsdt" else {}
    size = {"train.steps": 4, "policy.dim": 16, "policy.context": 3, "crm.epochs": 1, **quick}
    config = resolve_config(name, None, size)
    with unnoticed():
        new_policy(store, config)
        train_run(store, tmp_path / "run", config)
        TrainedPolicy.load(tmp_path / "run")


@pytest.mark.parametrize("environment", ["synthetic-taobao", "synthetic-catalog"])
def test_collecting_and_evaluating(environment: str, tmp_path: Path) -> None:
    at = Environment(environment)
    with unnoticed():
        simulated_store(at, tmp_path, 60, 0)
    config = resolve_config("bc", None, {"train.steps": 2, "policy.dim": 8})
    train_run(EpisodeStore.open(tmp_path / "store"), tmp_path / "run", config)
    trained = TrainedPolicy.load(tmp_path / "run")
    with unnoticed():
        evaluate_policy(at, trained, "bc", 20, 0)
        evaluate_behavior(at, "mixture", 20, 0)


def test_the_numbers_of_a_run_do_not_depend_on_the_callers_state(
    store: EpisodeStore, tmp_path: Path
) -> None:
    config = resolve_config(
        "ucf", None, [*killed_run.SETTINGS, "augment.copies=1", "train.steps=10", "crm.epochs=1"]
    )
    weights = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        train_run(store, tmp_path / str(seed), config)
        weights.append(TrainedPolicy.load(tmp_path / str(seed)).policy.state_dict())
    assert all(torch.equal(tensor, weights[1][name]) for name, tensor in weights[0].items())
