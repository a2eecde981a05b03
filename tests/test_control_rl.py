"""IQL and CQL of d3rlpy: what they read, that they resume, and rows like everybody else's."""

import json
from pathlib import Path

import pytest
import torch

from tests.control_files import hopper_like, write_hdf5
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.store import EpisodeStore
from ucfrec_control.benchmark import TABLES, Budget, benchmark
from ucfrec_control.cli import main
from ucfrec_control.d4rl import read_d4rl
from ucfrec_control.evaluate import evaluate_run
from ucfrec_control.rl_baselines import rl_config, train_rl
from ucfrec_control.train import dataset_of

pytest.importorskip("d3rlpy", reason="the extra rl is not installed")
pytest.importorskip("mujoco", reason="the extra control is not installed")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("rl")
    file = write_hdf5(folder / "hopper_medium-made.hdf5", hopper_like((30, 8, 25) * 8))
    return read_d4rl(file).write_store(folder / "store")


@pytest.mark.parametrize("algorithm", ["iql", "cql"])
def test_equal_seeds_train_equal_actors_that_are_judged_as_others_are(
    store: EpisodeStore, tmp_path: Path, algorithm: str
) -> None:
    config = rl_config(dataset_of(store), algorithm, steps=4)
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train_rl(store, tmp_path / name, config, seed)
    a, b, c = ((tmp_path / name / "actor.safetensors").read_bytes() for name in "abc")
    assert a == b != c
    (row,) = evaluate_run(tmp_path / "a", episodes=2, seed=0)
    assert (row["method"], row["checkpoint"], row["target_return"]) == (algorithm, "last", None)
    assert row["fingerprint"] == store.meta["fingerprint"]
    assert main(["evaluate", str(tmp_path / "a"), "--episodes", "2"]) == 0


def test_a_finished_run_is_read_and_another_configuration_refused(
    store: EpisodeStore, tmp_path: Path
) -> None:
    config = rl_config(dataset_of(store), "iql", steps=2)
    record = train_rl(store, tmp_path / "run", config, 0)
    assert train_rl(store, tmp_path / "run", config, 0) == record
    assert read_json(tmp_path / "run" / "run.json") == record
    with pytest.raises(InputError, match="trained otherwise"):
        train_rl(store, tmp_path / "run", config, 1)


def test_the_benchmark_finds_its_rl_rows_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", hopper_like((30, 8, 25) * 8))
    monkeypatch.setitem(TABLES, "main", {"iql": ("iql", ())})
    budget = Budget(("hopper_medium-made",), 1, 2, (), rl_steps=2)
    results = tmp_path / "rows.jsonl"
    (row,) = benchmark(tmp_path, tmp_path / "runs", results, budget, "tiny", 1)
    assert (row["table"], row["method"]) == ("main", "iql")
    assert benchmark(tmp_path, tmp_path / "runs", results, budget, "tiny", 1) == [row]
    assert len(results.read_text().splitlines()) == 1
    assert json.loads(results.read_text()) == row
