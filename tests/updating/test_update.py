"""An updated run knows the new rows, starts from the old weights, and says how it compares."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.killed_loop import kills
from tests.support.later import NEW, later_log, later_mapping
from tests.support.served import SETTINGS, trained_run
from tests.support.tagged import ITEMS, tagged_log, tagged_store
from tests.support.tensors import assert_same_tensors
from ucfrec import Recommender
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.logs.append import AppendOptions
from ucfrec.logs.mapping import LogMapping
from ucfrec.runs.later_logs import later_logs
from ucfrec.runs.promoted import promoted
from ucfrec.runs.record import RunRecord
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.update import UpdateOptions, update_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`run`, and `run2`, its update with `later.parquet`."""
    folder = tmp_path_factory.mktemp("updated")
    trained_run(folder)
    later_log(propensity=True).to_parquet(folder / "later.parquet")
    mapping = later_mapping(folder)
    update_run(folder / "run", [folder / "later.parquet"], folder / "run2", mapping=mapping)
    return folder


def test_the_update_is_recorded_with_its_drift_and_verdict(folder: Path) -> None:
    old, record = TrainedPolicy.load(folder / "run"), RunRecord.read(folder / "run2")
    update = record.update
    assert (update.of, update.run) == ("run", old.fingerprint)
    assert update.appended["new_items"] == update.appended["new_users"] == NEW
    log = later_log(propensity=True)
    assert update.drift["unknown_items"] == pytest.approx((log.item_id >= ITEMS).mean())
    assert update.drift["observed"] == pytest.approx(log.reward[log.item_id < ITEMS].mean())
    measures = {*update.verdict.differences}
    assert measures == {"ndcg_liked", "reward per step"}
    assert update.verdict.steps == 60
    assert record.finished.steps < old.record.finished.steps
    assert record.rule is not None
    assert main(["verify", str(folder / "run2")]) == 0


def test_the_updated_run_recommends_new_items(folder: Path) -> None:
    trained, log, items = (folder / name for name in ("run2", "histories.parquet", "items.parquet"))
    assert TrainedPolicy.load(trained).item_ids.tolist() == list(range(ITEMS + NEW))
    later_log().to_parquet(log)
    named = f"{trained} {log} --k 30 --keep-seen --out {folder / 'out.parquet'}".split()
    assert main(["recommend", *named]) == 0
    files, mapping = later_logs(TrainedPolicy.load(trained), [log, items], LogMapping())
    assert (files, mapping.item_features[0].files) == ((log,), (items,))  # as `prepare` reads them


def test_an_update_of_an_update_has_the_settings_of_the_first_run(folder: Path) -> None:
    later_log(seed=2).to_parquet(folder / "next.parquet")
    logs, mapping = [folder / "next.parquet"], later_mapping(folder)
    third = update_run(folder / "run2", logs, folder / "run3", mapping=mapping)
    second = RunRecord.read(folder / "run2")
    assert third.update.settings_from_nothing == second.update.settings_from_nothing
    assert replace(third.config, rule=second.config.rule) == second.config


def test_the_update_of_a_rule_that_draws_draws(tmp_path: Path) -> None:
    more = ["rule.evidence=5", "rule.least_items=2.0", "rule.temperatures=[0.0,4.0]"]
    store = tagged_store(tmp_path, propensity=1 / ITEMS)
    Recommender("dt", settings=[*SETTINGS, *more]).fit(store, tmp_path / "run")
    later_log(propensity=True).to_parquet(tmp_path / "later.parquet")
    logs, mapping = [tmp_path / "later.parquet"], later_mapping(tmp_path)
    update_run(tmp_path / "run", logs, tmp_path / "run2", mapping=mapping)
    first, second = (RunRecord.read(tmp_path / name) for name in ("run", "run2"))
    assert min(first.config.rule.temperatures) == 0 < first.rule.rule.temperature
    assert min(second.config.rule.temperatures) > 0 < second.rule.rule.temperature


def test_the_same_command_goes_on_and_another_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapping = later_mapping(folder)
    before, logs = RunRecord.read(folder / "run2"), [folder / "later.parquet"]
    again = update_run(folder / "run", logs, folder / "run2", mapping=mapping)
    assert (again.update, again.rule, again.policy) == (before.update, before.rule, before.policy)
    name = "policy/best.safetensors"
    assert again.files[name] == before.files[name]
    later_log(seed=3).to_parquet(tmp_path / "other.parquet")
    with pytest.raises(InputError, match="store of other logs"):
        update_run(folder / "run", [tmp_path / "other.parquet"], folder / "run2", mapping=mapping)
    assert main(["update", str(folder / "later.parquet"), str(logs[0]), "--out", "x"]) == 2
    assert "run folder" in capsys.readouterr().err


def test_augmentation_models_start_warm(folder: Path, tmp_path: Path) -> None:
    settings = [*SETTINGS, "augment.copies=1", "crm.epochs=12"]
    Recommender("ucf", settings).fit(EpisodeStore.open(folder / "store"), tmp_path / "run")
    record = update_run(tmp_path / "run", [folder / "later.parquet"], tmp_path / "run2")
    assert record.augmentation is not None
    assert record.config.crm.epochs == 1
    old = load_tensors(tmp_path / "run" / "crm" / "cvae" / "best.safetensors")[0]
    new = load_tensors(tmp_path / "run2" / "crm" / "cvae" / "best.safetensors")[0]
    assert torch.equal(old["state_mean"], new["state_mean"])
    assert any(not torch.equal(old[name], new[name]) for name in old)


def test_logs_that_leave_nothing_to_compare_on_are_refused(folder: Path, tmp_path: Path) -> None:
    options = UpdateOptions(AppendOptions(split=(0.5, 0.5, 0.0)))
    with pytest.raises(InputError, match="leave no test rows"):
        update_run(folder / "run", [folder / "later.parquet"], tmp_path / "run2", options=options)
    assert not any(tmp_path.iterdir())


def test_a_folder_that_is_no_update_is_refused_before_a_store_is_written(
    folder: Path, tmp_path: Path
) -> None:
    trained_run(tmp_path)
    (tmp_path / "other").mkdir()
    for name in ("run", "other"):
        with pytest.raises(InputError, match="is not an update of"):
            update_run(folder / "run", [folder / "later.parquet"], tmp_path / name)
        assert not (tmp_path / f"{name}-store").exists()


def test_the_documented_night_runs_on_the_first_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mapping is that of the shop's own log; the joined log has the columns of exposures."""
    monkeypatch.chdir(tmp_path)
    log, items = tagged_log(), [f"s{item}" for item in range(ITEMS)]
    shop = {"visitor": "v" + log.user_id.astype(str), "sku": "s" + log.item_id.astype(str)}
    shop |= {"seen": log.timestamp / 1000, "clicked": log.reward > 0, "bought": log.item_id == 3}
    pd.DataFrame(shop).to_parquet("shop.parquet")
    pd.DataFrame({"sku": items, "price": np.arange(ITEMS) * 1.0}).to_parquet("items.parquet")
    Path("shop.toml").write_text(
        'reward = "clicked::INT + 5 * bought::INT"\n[columns]\nuser_id = "visitor"\n'
        'item_id = "sku"\ntimestamp = "seen * 1000"\n'
        '[[item_features]]\nfiles = ["items.parquet"]\nkey = "sku"\n'
    )

    def run(command: str) -> None:
        assert main(command.split()) == 0, command

    run("prepare shop.parquet --mapping shop.toml --out store")
    run(f"train store --out runs/first --set {' --set '.join(SETTINGS)}")
    run("promote runs/first")
    files = "--exposures shown.parquet --out recommended.parquet"
    run(f"recommend runs/first shop.parquet --k 2 --temperature 1 --keep-seen {files}")
    shown = pd.read_parquet("shown.parquet")
    shown["timestamp"] += np.arange(len(shown)) * 1000  # as of requests one after the other
    shown.to_parquet("shown.parquet")
    clicks = shown[["user_id", "item_id", "timestamp"]][::3]
    clicks.assign(clicked=True, bought=False).to_parquet("clicks.parquet")
    run("join shown.parquet clicks.parquet --within 30m --out log.parquet")
    updated = "update runs log.parquet --mapping shop.toml --out runs/second"
    run(f"{updated} --window 60d")
    said = capsys.readouterr().out
    assert "new rows      60 of 60 read (0 not newer" in said
    for part in ("rows have new items, ", "the old run's reward model predicts ", "verdict "):
        assert part in said
    assert main([*updated.split(), "--window", "soon"]) == 2
    assert "--window soon is not a duration" in capsys.readouterr().err
    update = RunRecord.read(Path("runs/second")).update
    assert update.appended["steps"] == 60
    assert (update.drift["unknown_items"], update.drift["unknown_users"]) == (0, 0)
    run("promote runs/second --force")
    assert promoted(Path("runs")).current == "second"


@pytest.mark.slow
def test_an_update_killed_at_any_moment_ends_as_if_left_alone(folder: Path) -> None:
    assert kills("update", folder) >= 3
    alone, killed = (RunRecord.read(folder / name) for name in ("run2", "killed"))
    assert killed.update == alone.update
    assert killed.rule == alone.rule
    assert_same_tensors(folder / "killed", folder / "run2", "policy/best", "refit/policy/best")
    assert main(["verify", str(folder / "killed"), str(folder / "killed-store")]) == 0
