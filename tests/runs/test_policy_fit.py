"""Processes that train together give the curve of one, and leave the run of one."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.short_validation import ALL_BATCHES, short_validation
from tests.support.together import together
from ucfrec.commands.cli import main
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.fitting.metrics_log import read_metrics
from ucfrec.runs.config import resolve_config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.run import train_run
from ucfrec.runs.start import new_policy

ROOT = Path(__file__).parents[2]
SETTINGS = [
    "train.steps=12", "train.validate_every=4", "train.batch_size=9", "train.warmup_steps=2",
    "train.learning_rate=0.01", "policy.dim=8", "policy.context=3", "policy.dropout=0.0",
    "policy.advantage_weights=true", "augment.copies=1", "crm.epochs=1", "crm.hidden=8",
]  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 6, size=120)
    n = int(lengths.sum())
    columns = {
        "observation": rng.normal(size=(n, 3)),
        "action": rng.uniform(-1, 1, size=(n, 2)),
        "reward": rng.normal(size=n),
    }
    path = tmp_path_factory.mktemp("store") / "store"
    split = np.repeat([0, 1], [100, 20]).astype(np.uint8)
    EpisodeStore.write(path, columns, lengths, {"split": split})
    return path


def train(store: Path, run: Path, *settings: str) -> None:
    if not distributed.leads():
        distributed.wait()
    train_run(EpisodeStore.open(store), run, resolve_config("ucf", None, [*SETTINGS, *settings]))


def same(found: Path, expected: Path) -> None:
    """Runs of the same files and curves. Weights without effect, whose gradients are rounding
    errors, differ."""
    curves, others = (read_metrics(run / "policy") for run in (found, expected))
    for name in ("loss", "validation_loss", "action_loss", "value_loss", "gradient_norm"):
        assert curves[name] == pytest.approx(others[name], rel=1e-4)
    for name in ("best", "last"):
        (one, about), (other, said) = (
            load_tensors(run / "policy" / f"{name}.safetensors") for run in (found, expected)
        )
        assert {key: each.shape for key, each in one.items()} == {
            key: each.shape for key, each in other.items()
        }
        assert about["step"] == said["step"]


def test_two_processes_give_the_curve_of_one(store: Path, tmp_path: Path) -> None:
    train(store, tmp_path / "one")
    together(2, lambda: train(store, tmp_path / "two"), tmp_path)
    same(tmp_path / "two", tmp_path / "one")
    assert (tmp_path / "two" / "augmented.safetensors").exists()
    assert not list(tmp_path.rglob("*.ucfrec-*"))


def test_a_run_goes_on_with_another_number_of_processes(store: Path, tmp_path: Path) -> None:
    train(store, tmp_path / "one")
    for count, steps in ((3, 4), (1, 8), (2, 12)):
        together(count, lambda: train(store, tmp_path / "run", f"train.steps={steps}"), tmp_path)  # noqa: B023
    same(tmp_path / "run", tmp_path / "one")


def started(store: Path, run: Path, *more: str) -> "subprocess.CompletedProcess[Any]":
    command = [
        *(sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"),
        *("--master-port", "0", "--rdzv-backend", "c10d", "--rdzv-endpoint", "127.0.0.1:0"),
        *("-m", "ucfrec", "train", str(store), "--out", str(run), "--threads", "1", *more),
    ]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=300
    )


@pytest.mark.slow
def test_torchrun_is_the_same_command(store: Path, tmp_path: Path) -> None:
    options = [word for setting in SETTINGS for word in ("--set", setting)]
    ended = started(store, tmp_path / "two", *options)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("model card:") == 1
    with short_validation(ALL_BATCHES):
        assert main(["train", str(store), "--out", str(tmp_path / "one"), *options]) == 0
    same(tmp_path / "two", tmp_path / "one")
    again = started(store, tmp_path / "two", "--set", "train.steps=5")
    assert again.returncode != 0
    assert again.stderr.count("was started with another") == 1


def test_new_episodes_are_half_of_every_batch(tmp_path: Path) -> None:
    """So few steps suffice to learn what only they show, beside what all others show."""
    rng = np.random.default_rng(0)
    n, new = 4000, 40
    item = rng.integers(2, size=n)
    item[-new:] = 2
    columns = {"item": item.astype(np.int32), "reward": rng.random(n).astype(np.float32)}
    states = ItemStates(torch.randn(4, 3), torch.zeros(0, 0), 0.0, 1.0)
    store = EpisodeStore.from_arrays(columns, np.full(n // 4, 4), None, states)
    config = resolve_config(
        "bc", None, ["train.steps=60", "train.learning_rate=0.01", "train.warmup_steps=0"]
    )
    shares = []
    for newest in (None, np.arange(n // 4 - new // 4, n // 4)):
        policy = new_policy(store, config)
        fit_policy(policy, store, None, tmp_path / str(newest is None), config, newest=newest)
        first = store.windows(np.arange(9), np.zeros(9, dtype=np.int64), 1)
        with torch.no_grad():
            shares.append(float(policy.act(first).softmax(-1)[:, 2].mean()))
    assert shares[0] < 0.05
    assert 0.3 < shares[1] < 0.7
