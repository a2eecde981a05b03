"""How a run begins: warm or alone, with other processes, and what is said if nothing is learned."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.episodes import random_episodes, write_store
from tests.support.later import later_log, later_mapping
from tests.support.logs import random_log
from tests.support.served import trained_run
from tests.support.short_validation import ALL_BATCHES, short_validation
from tests.support.tagged import ITEMS
from tests.support.together import together
from ucfrec import Recommender
from ucfrec.commands.cli import main
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputNote
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import load_tensors, read_metrics
from ucfrec.logs.append import append_logs
from ucfrec.runs.config import resolve_config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.record import RunRecord
from ucfrec.runs.run import train_run
from ucfrec.runs.start import new_policy, start_warm

SETTINGS = ["train.steps=150", "train.validate_every=150", "policy.dim=16", "policy.context=4"]
SETTINGS += ["train.learning_rate=0.01", "augment.copies=0", "rule.choose=false"]
SAID = "the policy learned nothing about users; add features of users and items"


@pytest.mark.parametrize(
    ("best", "logged", "said"),
    [
        (3.0, {"action_loss"}, True),
        (2.9, {"action_loss"}, False),
        (float("nan"), {"action_loss"}, False),
        (3.1, set(), False),
    ],
)
def test_only_a_comparable_loss_is_told(best: float, logged: set[str], said: bool) -> None:
    trained = SimpleNamespace(best_validation=best)
    record = RunRecord.model_construct(policy=trained, reference_losses={"popularity": 3.0})
    assert (SAID in record.learned_nothing(logged | {"validation_loss"})) == said


def log(users_differ: bool) -> pd.DataFrame:
    """Users see items of their own half of the catalogue, or any."""
    frame = random_log(3000, users=60, items=20, step=20_000)
    if users_differ:
        frame["item_id"] = 2 * (frame.item_id // 2) + frame.user_id % 2
    return frame


@pytest.mark.parametrize(
    ("users_differ", "policy", "said"),
    [(False, "dt", True), (True, "dt", False), (False, "popular", False)],
)
def test_train_and_fit_say_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], users_differ: bool, policy: str, said: bool
) -> None:
    log(users_differ).to_parquet(tmp_path / "log.parquet")
    store, run = str(tmp_path / "store"), str(tmp_path / "run")
    prepare = ["prepare", str(tmp_path / "log.parquet"), "--out", store, "--session-by", "user"]
    assert main(prepare) == 0
    sets = [word for setting in SETTINGS for word in ("--set", setting)]
    if policy == "popular":
        sets = ["--set", "rule.choose=false"]
    capsys.readouterr()
    assert main(["train", store, "--out", run, "--policy", policy, *sets]) == 0
    assert (SAID in capsys.readouterr().out) == said
    assert (SAID in (tmp_path / "run" / "MODEL_CARD.md").read_text()) == said
    if said:
        with pytest.warns(InputNote, match=SAID):
            Recommender(policy, settings=SETTINGS).fit(log(users_differ), session_by="user")


def test_what_the_old_run_knows_is_kept(tmp_path: Path) -> None:
    trained = trained_run(tmp_path)
    later_log().to_parquet(tmp_path / "later.parquet")
    logs, mapping = [tmp_path / "later.parquet"], later_mapping(tmp_path)
    append_logs(tmp_path / "store", logs, tmp_path / "grown", mapping)
    store = EpisodeStore.open(tmp_path / "grown").split("train")
    policy = new_policy(store, trained.record.config)
    fresh = {name: value.clone() for name, value in policy.state_dict().items()}
    start_warm(policy, tmp_path / "run2", tmp_path / "run")
    old = trained.policy.state_dict()
    for name, value in policy.named_parameters():
        new, known = torch.atleast_1d(value), torch.atleast_1d(old[name])
        assert torch.equal(new[: len(known)], known), name
        assert torch.equal(new[len(known) :], torch.atleast_1d(fresh[name])[len(known) :])
    assert torch.equal(policy.state_mean, trained.policy.state_mean)
    counts = policy.state_dict()["head.counts"]
    assert len(counts) > ITEMS
    assert torch.equal(counts, fresh["head.counts"])


TOGETHER = [
    "train.steps=12", "train.validate_every=4", "train.batch_size=9", "train.warmup_steps=2",
    "train.learning_rate=0.01", "policy.dim=8", "policy.context=3", "policy.dropout=0.0",
    "augment.copies=1", "crm.epochs=1", "crm.hidden=8",
]  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "store"
    return write_store(path, random_episodes([1, 4, 2, 5, 3] * 30, items=False)).path


def train(store: Path, run: Path, *settings: str) -> None:
    if not distributed.leads():
        distributed.wait()
    train_run(EpisodeStore.open(store), run, resolve_config("ucf", None, [*TOGETHER, *settings]))


def same(found: Path, expected: Path) -> None:
    """Files and curves are the same. Weights whose gradients are rounding errors differ."""
    curves, others = (read_metrics(run / "policy") for run in (found, expected))
    for name in ("loss", "validation_loss", "action_loss", "gradient_norm"):
        assert curves[name] == pytest.approx(others[name], rel=1e-4)
    for name in ("best", "last"):
        read = [load_tensors(run / "policy" / f"{name}.safetensors") for run in (found, expected)]
        shapes = [{key: each.shape for key, each in tensors.items()} for tensors, _ in read]
        assert shapes[0] == shapes[1]
        assert read[0][1]["step"] == read[1][1]["step"]


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
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_torchrun_is_the_same_command(store: Path, tmp_path: Path) -> None:
    options = [word for setting in TOGETHER for word in ("--set", setting)]
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
    settings = ["train.steps=60", "train.learning_rate=0.01", "train.warmup_steps=0"]
    config = resolve_config("bc", None, settings)
    shares = []
    for newest in (None, np.arange(n // 4 - new // 4, n // 4)):
        policy = new_policy(store, config)
        fit_policy(policy, store, None, tmp_path / str(newest is None), config, newest=newest)
        first = store.windows(np.arange(9), np.zeros(9, dtype=np.int64), 1)
        with torch.no_grad():
            shares.append(float(policy.act(first).softmax(-1)[:, 2].mean()))
    assert shares[0] < 0.05
    assert 0.3 < shares[1] < 0.7
