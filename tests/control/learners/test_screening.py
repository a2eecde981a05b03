"""Screening finds what causes nothing, keeps what causes something, and intervenes on it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.control_files import hopper_like, write_hdf5
from tests.support.real_data import data_folder
from ucfrec import schema
from ucfrec.episodes.distractor import with_observations
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.reporting.rows_file import read_rows
from ucfrec.runs.config import resolve_config
from ucfrec_control.benchmark import screening_table
from ucfrec_control.benchmark.budgets import Budget
from ucfrec_control.benchmark.plan import stores_of
from ucfrec_control.cli import main
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.distractor import add_distractor
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.figures.diagnostics import store_of
from ucfrec_control.learners.screening import ScreeningConfig, interventions, screen
from ucfrec_control.learners.train import train_control

QUICK = ScreeningConfig(hidden=64, shared_steps=400, own_steps=200)


def planted(out: Path, trajectories: int = 60, length: int = 40, jolt: float = 0.0) -> EpisodeStore:
    """Five dimensions: 0 drives 1, 1 drives 0 and the reward, 2 the reward alone, 3 measures the
    reward, 4 is noise. 3 and 4 have no effect. In 0.3% of the steps 1 is jolted by `jolt`."""
    rng = np.random.default_rng(0)
    shape = (trajectories, length)
    states, actions = np.zeros((*shape, 5)), rng.uniform(-1, 1, (*shape, 1))
    states[:, :, [2, 4]] = rng.normal(size=(*shape, 2))
    states[:, 0, :2] = rng.normal(size=(trajectories, 2))
    for t in range(length - 1):
        x, y = states[:, t, 0], states[:, t, 1]
        states[:, t + 1, 0] = 0.8 * x + 0.5 * np.tanh(y) + 0.2 * actions[:, t, 0]
        states[:, t + 1, 1] = 0.7 * y - 0.6 * x + 0.3 * rng.normal(size=trajectories)
        if jolt:
            states[:, t + 1, 1] += jolt * (rng.random(trajectories) < 0.003)
    rewards = states[:, :, 1] + np.abs(states[:, :, 2]) + 0.3 * actions[:, :, 0]
    states[:, :, 3] = rewards > np.median(rewards)
    return Trajectories(
        observations=states.reshape(-1, 5).astype(np.float32),
        actions=actions.reshape(-1, 1).astype(np.float32),
        rewards=rewards.reshape(-1).astype(np.float32),
        lengths=np.full(trajectories, length),
        terminated=np.zeros(trajectories, dtype=bool),
        final_observations=None,
        source={"where": "planted", "dataset": "planted", "env_id": None, "versions": {}},
    ).write_store(out)


def test_what_causes_nothing_is_flagged_and_nothing_else(tmp_path: Path) -> None:
    store = planted(tmp_path / "store")
    report = screen(store, QUICK, seed=0)
    assert report.flagged == (3, 4)
    by_dimension = report.dimensions
    assert by_dimension[0].helps[0] == 1
    assert by_dimension[0].effect > 0.1
    assert by_dimension[2].reward_effect > 0.1
    assert abs(by_dimension[3].effect) < 0.03
    assert by_dimension[3].reward_effect < 0.01
    assert screen(store, QUICK, seed=0) == report


def test_a_few_violent_steps_do_not_decide(tmp_path: Path) -> None:
    store = planted(tmp_path / "store", jolt=40.0)
    assert screen(store, QUICK, seed=0).flagged == (3, 4)
    # What they would decide: that nothing helps to predict what is jolted.
    assert 0 in screen(store, replace(QUICK, capped=0.0), seed=0).flagged


def test_too_few_trajectories_are_refused(tmp_path: Path) -> None:
    store = planted(tmp_path / "store", trajectories=8)
    with pytest.raises(InputError, match="screening needs at least 15"):
        screen(store, QUICK, seed=0)


def test_interventions_change_the_flagged_dimensions_alone(tmp_path: Path) -> None:
    store = planted(tmp_path / "store", trajectories=20, length=30)
    train = store.split("train")
    union = train.with_overlay(interventions(train, [1, 4], seed=5))
    n = train.n_episodes
    assert union.n_episodes == 3 * n
    factual = train.windows(np.arange(n), train.lengths - 1, 30).states
    held, redrawn = (
        union.windows(np.arange(k * n, (k + 1) * n), train.lengths - 1, 30) for k in (1, 2)
    )
    rest = [0, 2, 3]
    for copy in (held, redrawn):
        assert torch.equal(copy.states[..., rest], factual[..., rest])
    assert torch.equal(held.states[:, 1:, [1, 4]], held.states[:, :-1, [1, 4]])
    assert (redrawn.states[:, 1:, 4] != redrawn.states[:, :-1, 4]).float().mean() > 0.9
    # Jointly from the marginal: every pair of values is some step's own.
    pairs = {tuple(pair) for pair in factual[..., [1, 4]].reshape(-1, 2).tolist()}
    drawn = redrawn.states[..., [1, 4]].reshape(-1, 2)
    assert all(tuple(pair) in pairs for pair in drawn.tolist())
    cut = np.corrcoef(drawn[:, 0], factual[..., 1].reshape(-1))[0, 1]
    assert abs(cut) < 0.15
    again = interventions(train, [1, 4], seed=5)
    assert union.overlay is not None
    np.testing.assert_array_equal(again.edit_state, union.overlay.edit_state)


def test_overlays_join_in_order(tmp_path: Path) -> None:
    train = planted(tmp_path / "store", trajectories=20, length=10).split("train")
    first, second = (interventions(train, [d], seed=d, copies=1) for d in (0, 3))
    union, n = train.with_overlay(first.joined(second)), train.n_episodes
    for k, alone in ((1, first), (2, second)):
        copies = np.arange(k * n, (k + 1) * n)
        there = union.windows(copies, train.lengths - 1, 10).states
        wanted = train.with_overlay(alone).windows(np.arange(n, 2 * n), train.lengths - 1, 10)
        assert torch.equal(there, wanted.states)


def test_training_with_screening_records_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quickest = ScreeningConfig(hidden=8, shared_steps=100, own_steps=50)
    monkeypatch.setattr("ucfrec_control.learners.train.ScreeningConfig", lambda: quickest)
    columns = hopper_like((20, 30) * 12)
    columns["rewards"] = columns["observations"][:, 0]
    columns["observations"][:, 4] = 0.0  # a constant causes nothing
    file = write_hdf5(tmp_path / "hopper.hdf5", columns)
    store, run = str(tmp_path / "store"), str(tmp_path / "run")
    assert main(["prepare", str(file), "--out", store]) == 0
    arguments = ["train", store, "--out", run, "--policy", "bc", "--screen", "copies"]
    arguments += ["--set", "train.steps=2", "--set", "policy.dim=8"]
    assert main(arguments) == 0
    record = read_json(Path(run) / "run.json")
    flagged = record["dataset"]["screened"]
    assert 4 in flagged
    said = ", ".join(map(str, flagged))
    assert f"dimensions without effect: {said}\n" in capsys.readouterr().out
    assert len(record["screening"]["dimensions"]) == 11
    assert main(arguments) == 0
    assert read_json(Path(run) / "run.json")["screening"] == record["screening"]


def test_screening_that_finds_no_cause_at_all_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quickest = ScreeningConfig(hidden=8, shared_steps=100, own_steps=50)
    monkeypatch.setattr("ucfrec_control.learners.train.ScreeningConfig", lambda: quickest)
    noise = read_d4rl(write_hdf5(tmp_path / "hopper.hdf5", hopper_like((30,) * 60)))
    store = noise.write_store(tmp_path / "store")
    config = resolve_config("dt", None, ["train.steps=2"])
    with pytest.raises(InputError, match="no effect of any of the 11 state dimensions"):
        train_control(store, tmp_path / "run", config, screening="drop")
    assert not (tmp_path / "run").exists()


def test_what_is_dropped_might_never_have_been_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ucfrec_control.learners.train.ScreeningConfig", lambda: QUICK)
    store = planted(tmp_path / "store")
    logged = store.step_values(schema.OBSERVATION, *store.all_steps())[:, :3]
    never = with_observations(store, tmp_path / "never", logged, {})
    config = resolve_config("ucf", None, ["train.steps=4", "policy.dim=8", "crm.epochs=1"])
    record = train_control(store, tmp_path / "dropped", config, screening="drop")
    assert record["dataset"]["unseen"] == [3, 4]
    assert record["sizes"]["state"] == 3
    train_control(never, tmp_path / "plain", config)
    for name in ("crm/cvae/last", "overlay", "policy/last"):
        kept, other = (tmp_path / run / f"{name}.safetensors" for run in ("dropped", "plain"))
        assert load_tensors(kept)[0].keys() == load_tensors(other)[0].keys()
        for key, value in load_tensors(kept)[0].items():
            assert torch.equal(value, load_tensors(other)[0][key]), (name, key)
    again = train_control(store, tmp_path / "dropped", config, screening="drop")
    assert (again["dataset"], again["policy"]) == (record["dataset"], record["policy"])
    with pytest.raises(InputError, match="was started with --screen drop"):
        train_control(store, tmp_path / "dropped", config, screening="copies")
    assert store_of(tmp_path / "dropped").state_size == 3


def test_every_file_is_screened_plain_and_distracted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quickest = ScreeningConfig(hidden=8, shared_steps=100, own_steps=50)
    monkeypatch.setattr(screening_table, "ScreeningConfig", lambda: quickest)
    budget = {"full": Budget(("hopper_medium-made",), 1, 1, ())}
    monkeypatch.setattr("ucfrec_control.commands.screen_all.BUDGETS", budget)
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", hopper_like((20, 30) * 12))
    results = tmp_path / "rows.jsonl"
    arguments = ["screen-all", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    arguments += ["--results", str(results)]
    assert main(arguments) == 0
    rows = {row.conditions["distractor"]: row for row in read_rows(results)}
    assert rows.keys() == {"none", "deterministic", "stochastic", "early"}
    for kind, row in rows.items():
        name = "hopper_medium-made" + ("" if kind == "none" else f"-{kind}")
        report = screen(EpisodeStore.open(stores_of(tmp_path / "out") / name), quickest, seed=0)
        found = row.details["screening"]
        assert tuple(d["dimension"] for d in found if d["flagged"]) == report.flagged
        added = [d["dimension"] for d in found if d["distractor"]]
        assert row.value == len(set(report.flagged) - set(added))
        assert added == ([] if kind == "none" else [11])
    printed, before = capsys.readouterr().out, results.read_text()
    assert f"{rows['early'].details['screening'][11]['effect']:#.3g}" in printed
    assert main(arguments) == 0
    assert results.read_text() == before


@pytest.mark.realdata
def test_the_distractor_is_flagged_and_no_true_dimension(tmp_path: Path) -> None:
    read = read_d4rl(data_folder("control") / "hopper_medium-zoo.hdf5")
    store = add_distractor(read.write_store(tmp_path / "clean"), tmp_path / "store")
    config = ScreeningConfig(hidden=128, shared_steps=700, own_steps=250, max_transitions=50_000)
    report = screen(store, config, seed=0)
    assert report.flagged == (11,)
    assert store.meta["columns"][schema.OBSERVATION] == [12]
