"""Scores of the last checkpoints, raw and averaged, and how far equal trainings are apart."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.support.control_files import hopper_like, write_hdf5
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.fitting.checkpoint import load_raw, load_tensors, load_trained
from ucfrec.fitting.loop import LoopConfig
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import read_rows
from ucfrec_control.benchmark.budgets import BUDGETS
from ucfrec_control.benchmark.spread import AVERAGING, BACK, spreads
from ucfrec_control.cli import main
from ucfrec_control.training.kept import WEIGHTS, checkpoint_name, keeping, kept_steps

FILE = "hopper_medium-made"
LOOP = LoopConfig(steps=6, validate_every=2, average=0.9)


def scored(score: float, seed: int, back: int = 0, weights: str = "raw") -> ResultRow:
    return ResultRow(
        suite="spread",
        table="spread",
        task=FILE,
        method="ucf",
        policy="ucf",
        training_seed=seed,
        conditions={BACK: back, AVERAGING: weights},
        metric="score",
        metrics={"score": score},
    )


def test_spreads_are_over_seeds_and_within_trainings() -> None:
    rows = [
        *(scored(10, 0), scored(12, 0, 1), scored(14, 0, 2)),  # their variance is 4
        *(scored(20, 1), scored(20, 1, 1)),  # 0
        *(scored(30, 2, weights="averaged"),),
    ]
    raw, averaged = spreads(rows)
    assert (raw["weights"], raw["seeds"], raw["checkpoints"]) == ("raw", 2, 3)
    assert raw["score"] == 15
    assert raw["sd_seeds"] == pytest.approx(50**0.5)
    assert raw["sd_last"] == pytest.approx(2**0.5)
    assert (averaged["score"], averaged["seeds"]) == (30, 1)
    assert averaged["sd_seeds"] != averaged["sd_seeds"], "one seed has no spread"


def test_the_last_checkpoints_are_those_of_validations() -> None:
    assert kept_steps(LOOP) == [6, 4, 2]
    assert kept_steps(replace(LOOP, steps=20, validate_every=3)) == [20, 18, 15, 12, 9]
    assert kept_steps(replace(LOOP, steps=1)) == [1]


@pytest.mark.slow
def test_checkpoints_are_measured_once_and_share_the_run_of_the_main_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hdf5(tmp_path / f"{FILE}.hdf5", hopper_like((30, 8, 25) * 8))
    sizes = ("train.steps=6", "train.validate_every=2", "policy.dim=16", "policy.context=5")
    rates = ("train.average=0.9", "train.warmup_steps=2", "train.learning_rate=0.01")
    evaluation, settings = Evaluation(2, 1000), (*sizes, *rates)
    tiny = Budget("medium", (FILE,), 1, evaluation, settings, methods=("ucf-wo-count",))
    monkeypatch.setitem(BUDGETS, "medium", tiny)
    out = tmp_path / "out"
    arguments = ["--budget", "medium", "--out", str(out)]
    spread = ["spread", "--data", str(tmp_path), *arguments, "--seeds", "2"]
    assert main([*spread, "--checkpoints", "1"]) == 0
    first = read_rows(out / "results.jsonl")
    assert [(r.training_seed, r.checkpoint) for r in first] == [
        (seed, f"{weights}-6") for seed in (0, 1) for weights in WEIGHTS
    ]
    assert main(spread) == 0
    rows = read_rows(out / "results.jsonl")
    assert rows[: len(first)] == first
    assert len(rows) == 2 * 2 * 3
    assert {r.evaluation_seed for r in rows} == {1000}
    capsys.readouterr()
    assert main(["spread", *arguments, "--show-only"]) == 0
    assert capsys.readouterr().out.count("ucf-wo-count") == 2
    assert main(["benchmark", "--data", str(tmp_path), *arguments]) == 0
    (run, _) = sorted(path for path in out.glob("medium/runs/*/*") if path.is_dir())
    more = read_rows(out / "results.jsonl")[len(rows) :]
    assert {r.suite for r in more} == {"control"}
    assert main([*spread, "--budget", "small", "--file", FILE, "--method", "dt"]) == 2
    assert "without train.average" in capsys.readouterr().err
    (last,) = (r.value for r in more if r.checkpoint == "last")
    assert last == next(r.value for r in first if r.checkpoint == "averaged-6")
    the_files_are_those_of_the_training(run)
    searched = ["contexts", "--data", str(tmp_path), *arguments, "--method", "ucf-wo-count"]
    assert main(searched) == 0
    assert "highest mean score: --context ucf-wo-count=" in capsys.readouterr().out
    tried = [r for r in read_rows(out / "results.jsonl") if r.suite == "contexts"]
    assert {r.conditions["context"] for r in tried} == {8, 20}
    assert {r.evaluation_seed for r in tried}.isdisjoint({1000})


def the_files_are_those_of_the_training(run: Path) -> None:
    folder = run / "policy"
    last = folder / "last.safetensors"
    raw, averaged = (folder / f"{checkpoint_name(w, 6)}.safetensors" for w in WEIGHTS)
    found, means = load_raw(last), load_trained(last)
    assert any(not torch.equal(found[name], means[name]) for name in found)
    for path, expected in ((raw, found), (averaged, means)):
        tensors, _ = load_tensors(path)
        assert tensors.keys() == expected.keys()
        assert all(torch.equal(tensors[name], expected[name]) for name in tensors)
    before = raw.read_bytes()
    raw.unlink()  # as after an interruption between the two files
    keeping(run, LOOP)
    assert raw.read_bytes() == before
