"""The record of a run: damage to any entry is one line, from whatever reads it."""

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.recommending.test_recommend import SMALL
from tests.support.random_runs import random_run
from tests.support.records import DAMAGE, JSON, damaged, paths
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json
from ucfrec.runs.record import RunRecord, read_record

OPTIONAL = {"reference_losses", "augmentation", "policy", "reward_model", "rule"}
"""Entries of stages that may not have ended."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log and a run on it, without checksums of its files."""
    settings = [*SMALL, "augment.copies=1", "crm.epochs=1"]
    folder = random_run(tmp_path_factory.mktemp("records"), "ucf", settings).parent
    write_json(folder / "run" / "run.json", record_of(folder) | {"files": {}})
    return folder


def record_of(folder: Path) -> Any:
    return read_json(folder / "run" / "run.json")


def test_what_is_written_comes_back(folder: Path, tmp_path: Path) -> None:
    record = read_record(folder / "run")
    record.write(tmp_path)
    assert read_json(tmp_path / "run.json") == record_of(folder)
    assert record.data == EpisodeStore.open(folder / "store").record.source
    assert record.session_gap_ms == 20 * 60_000


@pytest.mark.parametrize("kind", DAMAGE)
def test_every_entry_is_checked(folder: Path, tmp_path: Path, kind: str) -> None:
    value, said = record_of(folder), dict[tuple[str, ...], str]()
    for path in paths(value, depth=1):
        damaged(tmp_path / "run.json", value, path, DAMAGE[kind])
        if path[0] == "files":
            continue
        try:
            RunRecord.read(tmp_path)
        except InputError as error:
            said[path] = str(error)
            continue
        # An entry of a stage that has not ended, or a value that it may have.
        may_be_absent = path[0] in OPTIONAL or path[0] in ("data", "config", "library")
        assert kind not in ("huge", "list") or path[0] in ("rule", "data"), path
        assert kind != "missing" or may_be_absent or len(path) > 1, path
    assert said
    assert all("run.json" in text and "\n" not in text for text in said.values())


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("session_gap_ms",), DAMAGE["missing"], "run.json has no session_gap_ms; train it again"),
        (("session_gap_ms",), "soon", "its session_gap_ms is 'soon'; train it again"),
        (("config", "policy_name"), "no such", "policy 'no such' (of an unknown package)"),
        (("config", "train", "steps"), "many", "train.steps is 'many'"),
        (("sizes", "state"), -1, "its sizes.state is -1"),
        (("return_quantiles",), {"half": 1.0}, "its return_quantiles is {'half': 1.0}"),
        (("return_to_go", "horizon"), 0, "its return_to_go.horizon is 0"),
        (("data", "unknown_propensities"), "some", "its data.unknown_propensities is 'some'"),
        (("rule", "rule", "temperature"), -1, "temperature"),
    ],
)
def test_every_command_says_what_is_wrong(
    folder: Path,
    tmp_path: Path,
    path: tuple[str, ...],
    value: object,
    says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    damaged(run / "run.json", record_of(folder), path, value)
    log, out = str(folder / "log.parquet"), str(tmp_path / "out")
    for command in (
        ["verify", str(run)],
        ["recommend", str(run), log, "--out", f"{out}.parquet"],
        ["report", str(run), "--out", f"{out}.html"],
    ):
        assert main(command) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "run.json" in line
        assert says in line


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data(), value=JSON)
def test_no_value_gives_another_error(folder: Path, data: st.DataObject, value: object) -> None:
    record = record_of(folder)
    path = data.draw(st.sampled_from(list(paths(record))))
    copy = folder / "copy"
    copy.mkdir(exist_ok=True)
    damaged(copy / "run.json", record, path, value)
    with suppress(InputError):
        RunRecord.read(copy).describe()
