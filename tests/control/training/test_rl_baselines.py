"""IQL and CQL of d3rlpy: what they read, that they resume, and rows like everybody else's."""

import re
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.support.control_files import MADE, control, refused, write_made
from ucfrec.benchmark.cells import Budget, Evaluation, Method
from ucfrec.benchmark.grid import run_grid
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.processes import random_state_kept
from ucfrec.results.rows import read_rows
from ucfrec_control.benchmark.measure import SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import TABLES
from ucfrec_control.benchmark.plan import score_cells
from ucfrec_control.training import rl_baselines
from ucfrec_control.training.evaluate import evaluate_run
from ucfrec_control.training.rl_baselines import RLConfig, RLRecord, rl_config, train_rl
from ucfrec_control.training.train import dataset_of

pytest.importorskip("d3rlpy", reason="the extra rl is not installed")
pytest.importorskip("mujoco", reason="the extra control is not installed")


class _Stops:
    seen = 0

    def update(self, n: float = 1, **shown: float) -> None:
        self.seen += 1
        if self.seen == 5:
            raise KeyboardInterrupt


@pytest.mark.parametrize("algorithm", ["iql", "cql"])
def test_a_training_that_was_interrupted_ends_as_one_left_alone(
    store: EpisodeStore, tmp_path: Path, algorithm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = rl_config(dataset_of(store), algorithm, steps=7, batch_size=16)
    monkeypatch.setattr(rl_baselines, "CHECKPOINT_EVERY", 2)
    train_rl(store, tmp_path / "alone", config, 0)
    with monkeypatch.context() as interrupted:
        interrupted.setattr(rl_baselines, "progress", lambda *_, **__: nullcontext(_Stops()))
        with pytest.raises(KeyboardInterrupt):
            train_rl(store, tmp_path / "interrupted", config, 0)
    with pytest.raises(InputError, match="has not ended"):
        evaluate_run(tmp_path / "interrupted", episodes=2, seed=0)
    train_rl(store, tmp_path / "interrupted", config, 0)
    train_rl(store, tmp_path / "other", config, 1)
    names = ("alone", "interrupted", "other")
    first, second, third = ((tmp_path / n / "actor.safetensors").read_bytes() for n in names)
    assert first == second != third
    alone, interrupted = (read_metrics(tmp_path / run) for run in ("alone", "interrupted"))
    for loss in ("actor_loss", "critic_loss"):
        assert list(alone[loss]) == [2, 4, 6, 7]
        assert alone[loss] == interrupted[loss]
    (row,) = evaluate_run(tmp_path / "alone", episodes=2, seed=0)
    assert (row["method"], row["checkpoint"], row["target_return"]) == (algorithm, "last", None)
    assert row.data_fingerprint == store.record.fingerprint
    asked = ("evaluate", tmp_path / "alone", "--episodes", 2)
    control(*asked)
    assert "keep their last checkpoint only" in refused(*asked, "--checkpoint", "best")
    assert train_rl(store, tmp_path / "alone", config, 0) == RLRecord.read(tmp_path / "alone")
    with pytest.raises(InputError, match="other settings or data"):
        train_rl(store, tmp_path / "alone", config, 1)


def agent_of(task: str, kind: str, algorithm: str = "cql", **settings: float) -> Any:
    with random_state_kept():
        agent = rl_baselines._algorithm(RLConfig(algorithm, 10, task, kind, **settings))
        agent.create_impl((29,), 8)
    return agent


def test_cql_has_the_settings_of_corl() -> None:
    scalers = {
        (task, kind): type(agent_of(task, kind).config.reward_scaler).__name__
        for task, kind in product(("hopper", "walker2d"), ("medium", "mixed", "medium-expert"))
    }
    assert scalers.pop(("hopper", "medium")) == "ReturnBasedRewardScaler"
    assert set(scalers.values()) == {"NoneType"}
    for task, hidden in (("walker2d", 3), ("antmaze", 5)):
        for critic in agent_of(task, "medium").impl.modules.q_funcs:
            assert sum(isinstance(m, torch.nn.Linear) for m in critic.modules()) == hidden + 1
    agent = agent_of("antmaze", "diverse")
    assert (agent.config.reward_scaler.shift, agent.config.reward_scaler.multiplier) == (-5, 10)


@pytest.mark.parametrize("algorithm", ["iql", "cql"])
def test_all_rates_keep_their_proportion(algorithm: str) -> None:
    usual, faster = (
        {name: rate for name, rate in vars(agent.config).items() if name.endswith("learning_rate")}
        for given in ({}, {"learning_rate": 3e-3})
        for agent in [agent_of("antmaze", "medium", algorithm, **given)]
    )
    assert usual["critic_learning_rate"] == 3e-4
    assert faster == pytest.approx({name: 10 * rate for name, rate in usual.items()})


def test_cql_sees_the_states_of_antmaze_as_they_are(store: EpisodeStore) -> None:
    train = store.split("train")
    for task, plain in (("antmaze", True), ("hopper", False)):
        mean, std = rl_baselines._statistics(train, RLConfig("cql", 10, task, "medium"))
        assert (not mean.any() and bool((std == 1).all())) == plain


def test_the_benchmark_finds_its_rl_rows_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    write_made(tmp_path)
    monkeypatch.setitem(TABLES, "main", {"iql": Method("iql")})
    settings = {"iql": ("steps=2",)}
    budget = Budget("full", (MADE,), 1, Evaluation(2, 1000), of_policies=settings)
    cells, results = score_cells(tmp_path, tmp_path / "runs", budget, "main"), tmp_path / "rows"
    (cell,) = cells
    (row,) = run_grid([cell], SCORE_MEASUREMENT, results, 1)
    assert (row.table, row.method, row.checkpoint) == ("main", "iql", "last")
    assert run_grid([cell], SCORE_MEASUREMENT, results, 1) == read_rows(results) == [row]
    printed = capfd.readouterr()
    assert "1 cells, 0 of them left" in printed.err
    # Neither here nor in the workers does d3rlpy report its trainings.
    assert "[info" not in re.sub(r"\x1b\[[\d;]*m", "", printed.out)
