"""Control runs end to end: presets, training, normalised scores, distractors."""

import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.support.control_files import (
    MADE,
    TINY,
    changed,
    control,
    refused,
    set_options,
    write_made,
)
from tests.support.real_data import data_folder
from ucfrec.acting.rollout import Episodes, Step, Uniform, rollout
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.policies.registry import BUILT_IN
from ucfrec.results.rows import read_results, read_rows
from ucfrec.runs.config import resolve_config
from ucfrec_control.benchmark.budgets import BUDGETS, ZOO
from ucfrec_control.benchmark.methods import METHODS, TABLES
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.environments.environments import make_env, mismatches
from ucfrec_control.environments.scores import TASKS
from ucfrec_control.training import selection
from ucfrec_control.training.evaluate import evaluate_run
from ucfrec_control.training.train import find_preset, train_control

LAST = ("--checkpoint", "last", "--episodes", "1")


def test_evaluate_writes_last_and_best_apart(folder: Path, tmp_path: Path) -> None:
    run, out = folder / "store-run", tmp_path / "rows.json"
    assert "warning" not in control("evaluate", run, "--episodes", 3, "--json", out)[1]
    rows = read_results(out)
    keys = [(r.checkpoint, r.target_return) for r in rows]
    assert keys == list(product(("last", "best"), (3600, 1800)))
    # The best is played whichever step it is of.
    (best,) = evaluate_run(run, episodes=3, seed=0, targets=(3600.0,), checkpoints=("best",))
    assert best["return"] == rows[2]["return"]
    record = read_json(run / "run.json")
    for row in rows:
        assert (row.task, row.method, row.policy, row.training_seed) == (MADE, "dt", "dt", 3)
        assert (row["episodes"], row.environment) == (3, "Hopper-v5")
        scored = 100 * (row["return"] + 20.272305) / (3234.3 + 20.272305)
        assert row["score"] == pytest.approx(scored)
        assert row["score_low"] <= row["score"] <= row["score_high"]
        assert row["validation_loss"] == record["policy"]["best_validation"] > 0
        assert min(row["wall_time_s"], row["train_wall_time_s"]) > 0
    assert record["data"]["env_id"] == "Hopper-v5"


def test_another_environment_version_warns(folder: Path) -> None:
    said = control("evaluate", folder / "store-run", *LAST, "--target", 9, "--env", "Hopper-v4")[1]
    assert "warning: the data is of Hopper-v5, the evaluation is in Hopper-v4" in said
    assert not mismatches({"env_id": "Tank-v0", "versions": {}}, "mine:Tank-v0")


def test_behaviour_cloning_has_no_target(folder: Path, store: EpisodeStore, tmp_path: Path) -> None:
    cloned, asked = tmp_path / "bc", (*LAST, "--target", 100)
    train_control(store, cloned, resolve_config("bc", None, TINY))
    (row,) = evaluate_run(cloned, episodes=1, seed=0, checkpoints=("last",))
    assert (row["target_return"], row["rule"]) == (None, "no target return")
    assert f"no target return is taken by {cloned} (bc)" in refused("evaluate", cloned, *asked)
    assert "is taken by bc" in refused("ope", cloned, folder / "store", "--target", 100)
    said = control("evaluate", cloned, folder / "store-run", *asked)[1]
    assert f"note: --target does nothing for {cloned} (bc)" in said


def test_data_runs_no_code(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "theirs.py").write_text("raise SystemExit('their code ran')")
    monkeypatch.syspath_prepend(tmp_path)
    run = changed(folder / "store-run", tmp_path / "run", ("data", "env_id"), "theirs:Hopper-v5")
    assert "the Python module theirs would be run" in refused("evaluate", run, "--episodes", 1)


def test_a_policy_with_a_distractor_is_judged_at_zero(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    asked = ("evaluate", folder / "distracted-run", *LAST, "--target", 900, "--json", out)
    assert f"\n{MADE} + distractor  dc" in control(*asked)[0]
    (row,) = read_results(out)
    assert [[*d.values()] for d in row.details["distractors"]] == [[11, 0.15, 0, False]]
    env = make_env("Hopper-v5", 2, [0.0])
    steps: list[Step] = []
    rollout(env, Uniform(env, 0), 4, seed=0, on_step=steps.append)
    assert not any(step.observations[:, 11].any() for step in steps)


def test_the_weights_of_the_highest_validation_return_are_kept(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    returns, out = iter((3.0, 5.0, 4.0)), tmp_path / "rows.json"

    def play(_: object, env_id: str, *arguments: object) -> Episodes:
        assert env_id == "Hopper-v4"
        return Episodes(np.array([next(returns)]), np.array([1]))

    monkeypatch.setattr(selection, "play", play)
    monkeypatch.setattr("ucfrec_control.training.train.policy_package", lambda name: "pytest")
    where = (folder / "store", "--out", tmp_path / "run", "--policy", "dt")
    longer = set_options((*TINY, "train.steps=6"))
    control("train", *where, *longer, "--select-by-return", 1, "--env", "Hopper-v4")
    _, about = load_tensors(tmp_path / "run" / "policy" / "return.safetensors")
    assert about == {"step": 4, "return": 5.0}
    assert read_json(tmp_path / "run" / "run.json")["versions"]["pytest"] == pytest.__version__
    asked = ("--episodes", 1, "--checkpoint", "return", "--json", out)
    control("evaluate", tmp_path / "run", *asked)
    assert {(row.checkpoint, row.interval) for row in read_results(out)} == {("return", None)}
    assert "train with --select-by-return" in refused("evaluate", folder / "store-run", *asked)


def test_presets_are_those_of_the_papers() -> None:
    kinds = ("medium", "medium-replay", "mixed", "medium-expert", "diverse", "")
    for policy, task, kind in product(BUILT_IN, TASKS, kinds):
        preset = find_preset(task.name, kind, policy)
        resolve_config(policy, presets=preset.tables)
        assert preset.targets
        if policy in ("ucf", "ucf-paper") and task.name != "antmaze" and kind in kinds[:4]:
            wide = task.name == "hopper" and kind != "medium-expert"
            assert preset.tables["policy"].get("dim", 128) == (256 if wide else 128)
    paper = find_preset("antmaze", "diverse", "ucf-paper").tables
    assert (paper["policy"]["context"], paper["crm"]["latent_dim"]) == (50, 32)
    # Copies are the same whichever policy learns from them.
    assert find_preset("antmaze", "diverse", "dt").tables["crm"] == paper["crm"]
    for task_name, expected in (("hopper", (8, 256, 1e-4)), ("walker2d", (20, 128, 1e-3))):
        dc = resolve_config("dc", presets=find_preset(task_name, "medium", "dc").tables)
        assert (dc.policy.context, dc.policy.dim, dc.train.learning_rate) == expected
    assert find_preset("walker2d", "mixed", "lsdt").targets == (10000,)


LIGHT = """import contextlib, sys
from ucfrec.commands.cli import parse_command
from ucfrec_control.cli import CONTROL
with contextlib.suppress(SystemExit):
    parse_command(CONTROL, ["--help"])
assert not {"torch", "mujoco", "minari", "h5py"} & sys.modules.keys()"""


def test_help_needs_none_of_the_extras() -> None:
    subprocess.run([sys.executable, "-c", LIGHT], check=True)


@pytest.mark.realdata
def test_a_clone_of_a_zoo_file_hops(tmp_path: Path) -> None:
    read_d4rl(data_folder("control") / "hopper_medium-zoo.hdf5").write_store(tmp_path / "store")
    settings = ["train.steps=300", "train.warmup_steps=20", "train.learning_rate=2e-3"]
    settings += ["train.batch_size=256", "train.validate_every=300"]
    run, out = tmp_path / "run", tmp_path / "rows.json"
    where = (tmp_path / "store", "--out", run, "--policy", "bc")
    control("train", *where, *set_options(settings))
    control("evaluate", run, "--checkpoint", "last", "--json", out)
    (row,) = read_results(out)
    assert row["score"] > 15


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("file", ZOO[::4])  # every environment, and every kind of data
def test_each_zoo_file_trains_ucf_that_its_environment_judges(tmp_path: Path, file: str) -> None:
    store, run, out = (tmp_path / name for name in ("store", "run", "rows.json"))
    control("prepare", data_folder("control") / f"{file}.hdf5", "--out", store)
    few = ("crm.max_transitions", "csg.max_transitions", "augment.max_steps")
    quick = [*TINY, "augment.copies=1", "crm.epochs=1", *(f"{name}=20000" for name in few)]
    control("train", store, "--out", run, "--policy", "ucf", *set_options(quick))
    assert read_json(run / "run.json")["augmentation"]["acceptance"] > 0.5
    control("evaluate", run, "--episodes", 2, "--checkpoint", "last", "--json", out)
    rows = read_results(out)
    assert len(rows) == 2  # one for each of the preset's targets
    for row in rows:
        assert "warnings" not in row.details
        assert row["score_low"] <= row["score"] <= row["score_high"] < 20  # it has learned nothing


def test_a_benchmark_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_made(tmp_path)
    settings = (*TINY, "policy.dim=32", "crm.epochs=1", "csg.epochs=1")
    tiny = Budget("small", (MADE,), 1, Evaluation(2, 1000), settings)
    monkeypatch.setitem(BUDGETS, "small", tiny)
    monkeypatch.setitem(TABLES, "main", {m: METHODS[m] for m in ("lsdt", "ucf")})
    results = tmp_path / "control.jsonl"
    where = ("--out", tmp_path / "runs", "--results", results)
    command = ("benchmark", "--data", tmp_path, *where)
    control(*command)
    rows, before = read_rows(results), results.read_text()
    kept = sorted((r.method, r.checkpoint) for r in rows)
    assert kept == list(product(("lsdt", "ucf"), ("best", "last")))
    for row in rows:
        assert (row.suite, row.table, row.task) == ("control", "main", MADE)
        assert row.conditions.items() >= {"budget": "small", "episodes": 2}.items()
        assert (row.training_seed, row.evaluation_seed) == (0, 1000)
    assert str(tmp_path) not in before
    control(*command)
    assert results.read_text() == before
    results.write_text("".join(line for line in before.splitlines(True) if '"lsdt"' not in line))
    control(*command)
    again = read_rows(results)
    assert [r.method for r in again] == ["ucf", "ucf", "lsdt", "lsdt"]
    earned = {r.checkpoint: r.metrics["return"] for r in rows if r.method == "lsdt"}
    assert {r.checkpoint: r.metrics["return"] for r in again[2:]} == earned
    assert f"{earned['last']:.3f}" in control("benchmark", "--show-only", *where)[0]
    file.rename(tmp_path / "hopper_medium-own.hdf5")
    control(*command, "--file", "hopper_medium-own", "--method", "lsdt", "--seeds", 2)
    more = [(r.task, r.method, r.training_seed) for r in read_rows(results)[len(again) :]]
    assert sorted(more) == [("hopper_medium-own", "lsdt", seed) for seed in (0, 0, 1, 1)]


STRANGE: dict[str, list[object]] = {
    "policy": [None, {}],
    "config": ["text", None],
    "data": ["text", {}],
    "data dataset": [5],
    "data env_id": [5],
    "data versions": ["text", {"mujoco": 3}],
    "data distractors": [5, [1]],
    "data env_settings": [[1], {"xml_file": "/etc/x"}, {"frame_skip": 10**9}, {"frame_skip": 0}],
}


@pytest.mark.parametrize(("entry", "value"), [(e, v) for e, vs in STRANGE.items() for v in vs])
def test_strange_runs_are_refused(folder: Path, tmp_path: Path, entry: str, value: object) -> None:
    run = changed(folder / "store-run", tmp_path / "run", tuple(entry.split()), value)
    said = refused("evaluate", run, "--episodes", 1)
    assert (entry, value) != ("policy", None) or f"the training in {run} has not ended" in said
    # A run that says nothing of its data is not one of control, and has no figure.
    if entry != "policy" and value != {} and "settings" not in entry:
        refused("figures", "--runs", run, "--out", tmp_path / "figures")
