"""Untrusted runs: sizes are compared before memory is allocated."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.recommending.test_recommend import random_log
from tests.support.random_runs import random_run
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json
from ucfrec.fitting.checkpoint import load_module, load_tensors, save_tensors
from ucfrec.policies.registry import BUILT_IN, policy_class
from ucfrec.runs.config import resolve_config
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a log of items, without the checksums of its files, as a stranger can make it."""
    run = random_run(tmp_path_factory.mktemp("trained"), "dt")
    write_json(run / "run.json", read_json(run / "run.json") | {"files": {}})
    return run


@pytest.fixture
def changed(run: Path, tmp_path: Path) -> Path:
    shutil.copytree(run, tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize("size", [2**40, 2**47, 3])
@pytest.mark.parametrize("name", ["state", "action", "items", "users"])
def test_absurd_sizes_are_one_clear_error(
    changed: Path, name: str, size: int, capsys: pytest.CaptureFixture[str]
) -> None:
    record = read_json(changed / "run.json")
    record["sizes"][name] = size
    write_json(changed / "run.json", record)
    with pytest.raises(InputError, match=r"holds weights of another architecture|is damaged"):
        TrainedPolicy.load(changed)
    log = changed.parent / "log.parquet"
    random_log().to_parquet(log)
    assert main(["recommend", str(changed), str(log), "--out", str(changed / "r.parquet")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        *(({"dropped_observations": each}, "as dropped") for each in ([3], [0, 0], [2, 1])),
        ({"observation_size": 2**40}, "does not fit the run"),
        ({"dim": 16_384, "max_timestep": 10**7}, "holds weights of another architecture"),
        ({"context": 4096, "dim": 16_384}, "holds weights of another architecture"),
    ],
)
def test_absurd_entries_are_one_error(changed: Path, entries: dict[str, Any], says: str) -> None:
    record = read_json(changed / "run.json")
    (record["config"]["policy"] if "dim" in entries else record).update(entries)
    write_json(changed / "run.json", record)
    with pytest.raises(InputError, match=says):
        TrainedPolicy.load(changed)


@pytest.mark.parametrize(
    ("file", "name", "shape"),
    [
        ("item_states.safetensors", "embeddings", (2, 3)),
        ("item_states.safetensors", "user_features", (4, 0)),
        ("training_counts.safetensors", "shown", (2,)),
        ("training_counts.safetensors", "liked", ()),
        ("training_returns.safetensors", "returns", (0,)),
        ("training_returns.safetensors", "returns", (2, 2)),
        ("policy/best.safetensors", "state_mean", (1,)),
        ("reward_model/item_reward.safetensors", "user", (0,)),
    ],
)
def test_tensors_of_another_shape_are_named(
    changed: Path, file: str, name: str, shape: tuple[int, ...]
) -> None:
    tensors, about = load_tensors(changed / file)
    assert tuple(tensors[name].shape) != shape
    tensors[name] = torch.zeros(shape, dtype=tensors[name].dtype)
    save_tensors(changed / file, tensors, about)
    # Of two files that disagree, either may be named.
    with pytest.raises(InputError, match=f"{Path(file).stem}|users.parquet does not fit"):
        TrainedPolicy.load(changed)


def test_weights_that_are_no_numbers_are_said_to_be_so(changed: Path) -> None:
    path = changed / "policy" / "best.safetensors"
    tensors, about = load_tensors(path)
    save_tensors(path, {**tensors, "head.bias": tensors["head.bias"] * torch.nan}, about)
    actor = TrainedPolicy.load(changed).actor(2)
    with pytest.raises(InputError, match="in 1 of 1 decisions scores are not numbers"):
        actor.act(np.zeros((2, 0), dtype=np.float32), np.array([True, False]))


@pytest.mark.parametrize("items", [0, 7])
@pytest.mark.parametrize("name", BUILT_IN)
def test_the_sizes_of_every_learner_are_known_without_memory(name: str, items: int) -> None:
    """Otherwise its sizes would not be compared."""
    config = resolve_config(name).policy
    sizes = {"state": 5, "action": 2, "items": items, "tags": 0, "users": 3}
    try:
        module = policy_class(name)(config, sizes)
    except InputError:
        pytest.skip("chooses items, or vectors, only")
    path = Path("best.safetensors")
    built = load_module(path, lambda: policy_class(name)(config, sizes), module.state_dict())
    for key, value in module.state_dict().items():
        assert torch.equal(built.state_dict()[key], value)
    huge = {**sizes, "state": 2**20 if items else 2**40, "items": items and 2**40}
    with pytest.raises(InputError, match="holds weights of another architecture"):
        load_module(path, lambda: policy_class(name)(config, huge), module.state_dict())
