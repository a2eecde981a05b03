"""Control stores: screening in training, and every file screened."""

from pathlib import Path

import pytest
import torch

from tests.support.causes import QUICK, planted_vectors
from tests.support.control_files import hopper_like, write_hdf5
from tests.support.real_data import data_folder
from ucfrec import schema
from ucfrec.counterfactual.measured_reward import MeasurementConfig
from ucfrec.counterfactual.screening import ScreeningConfig, screen
from ucfrec.episodes.distractor import with_observations
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.reporting.tables import NONE
from ucfrec.results.rows_file import read_rows
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.start import training_views
from ucfrec_control.benchmark import screening_table
from ucfrec_control.benchmark.plan import stores_of
from ucfrec_control.cli import main
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.distractor import add_distractor
from ucfrec_control.figures.diagnostics import store_of
from ucfrec_control.training.train import train_control

QUICKEST = ScreeningConfig(
    hidden=8,
    shared_steps=100,
    own_steps=50,
    min_reward_r2=0.5,  # predictors this small reach no more
    measurement=MeasurementConfig(trees=5),
)


def test_training_with_screening_records_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ucfrec.runs.screened.ScreeningConfig", lambda: QUICKEST)
    columns = hopper_like((20, 30) * 12)
    columns["rewards"] = columns["observations"][:, 0]
    columns["observations"][:, 4] = 0.0  # a constant causes nothing
    file = write_hdf5(tmp_path / "hopper.hdf5", columns)
    store, run = str(tmp_path / "store"), str(tmp_path / "run")
    assert main(["prepare", str(file), "--out", store]) == 0
    arguments = ["train", store, "--out", run, "--policy", "bc", "--screen", "copies"]
    arguments += ["--set", "train.steps=2", "--set", "policy.dim=8"]
    assert main(arguments) == 0
    screening = RunRecord.read(Path(run)).screening
    assert screening is not None
    flagged = screening.flagged
    assert 4 in flagged
    said = ", ".join(map(str, flagged))
    assert f"columns without effect: {said}\n" in capsys.readouterr().out
    assert len(screening.dimensions) == 11
    assert main(arguments) == 0
    assert RunRecord.read(Path(run)).screening == screening


def test_screening_that_finds_no_cause_at_all_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ucfrec.runs.screened.ScreeningConfig", lambda: QUICK)
    columns = hopper_like((30,) * 30)
    columns["rewards"] = columns["actions"][:, 0]  # nothing but the action has an effect
    store = read_d4rl(write_hdf5(tmp_path / "hopper.hdf5", columns)).write_store(tmp_path / "store")
    config = resolve_config("dt", None, ["train.steps=2"])
    with pytest.raises(InputError, match="no effect of any of the 11 state dimensions"):
        train_control(store, tmp_path / "run", config, screening="drop")
    assert not (tmp_path / "run").exists()


def test_what_is_dropped_might_never_have_been_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ucfrec.runs.screened.ScreeningConfig", lambda: QUICK)
    store = planted_vectors(tmp_path / "store")
    logged = store.step_values(schema.OBSERVATION, *store.all_steps())[:, :3]
    never = with_observations(store, tmp_path / "never", logged, {})
    config = resolve_config("ucf", None, ["train.steps=4", "policy.dim=8", "crm.epochs=1"])
    record = train_control(store, tmp_path / "dropped", config, screening="drop")
    assert record.dropped_observations == (3, 4)
    assert record.sizes["state"] == 3
    train_control(never, tmp_path / "plain", config)
    for name in ("crm/cvae/last", "overlay", "policy/last"):
        kept, other = (
            load_tensors(tmp_path / run / f"{name}.safetensors")[0] for run in ("dropped", "plain")
        )
        assert kept.keys() == other.keys()
        for key, value in kept.items():
            assert torch.equal(value, other[key]), (name, key)
    again = train_control(store, tmp_path / "dropped", config, screening="drop")
    assert (again.data, again.policy) == (record.data, record.policy)
    with pytest.raises(InputError, match="was started with --screen drop"):
        train_control(store, tmp_path / "dropped", config, screening="copies")
    assert store_of(tmp_path / "dropped").state_size == 3


def test_every_file_is_screened_plain_and_distracted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(screening_table, "ScreeningConfig", lambda: QUICKEST)
    monkeypatch.setattr("ucfrec_control.commands.screen_all.ZOO", ("hopper_medium-made",))
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", hopper_like((20, 30) * 12))
    results = tmp_path / "rows.jsonl"
    arguments = ["screen-all", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    arguments += ["--results", str(results)]
    assert main(arguments) == 0
    rows = {row.conditions["distractor"]: row for row in read_rows(results)}
    assert rows.keys() == {"none", "deterministic", "stochastic", "early"}
    for kind, row in rows.items():
        name = "hopper_medium-made" + ("" if kind == "none" else f"-{kind}")
        store = EpisodeStore.open(stores_of(tmp_path / "out") / name)
        report = screen(training_views(store)[0], QUICKEST, seed=0)
        found = row.details["screening"]
        assert tuple(d["dimension"] for d in found if d["flagged"]) == report.flagged
        added = [d["dimension"] for d in found if d["distractor"]]
        assert row.value == len(set(report.flagged) - set(added))
        assert added == ([] if kind == "none" else [11])
    printed, before = capsys.readouterr().out, results.read_text()
    effect = rows["early"].details["screening"][11]["effect"]
    # Nothing shows these rewards, so that only measurements of them are tested.
    assert (NONE if effect is None else f"{effect:#.3g}") in printed
    assert main(arguments) == 0
    assert results.read_text() == before


@pytest.mark.slow
@pytest.mark.realdata
def test_the_distractor_is_flagged_and_no_true_dimension(tmp_path: Path) -> None:
    read = read_d4rl(data_folder("control") / "hopper_medium-zoo.hdf5")
    store = add_distractor(read.write_store(tmp_path / "clean"), tmp_path / "store")
    config = ScreeningConfig(hidden=128, shared_steps=700, own_steps=250, max_transitions=50_000)
    report = screen(training_views(store)[0], config, seed=0)
    assert report.flagged == (11,)
    assert store.record.columns[schema.OBSERVATION] == [12]
