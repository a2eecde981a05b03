"""The pointer to the served run: only runs with a verdict, atomically, and back again."""

import json
import shutil
from pathlib import Path

import pytest

from tests.support.killed_loop import kills
from tests.support.served import trained_run
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.results.evidence import Evidence
from ucfrec.runs.promoted import POINTER, promote, promote_back, promoted
from ucfrec.runs.record import RunRecord, Update
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    return trained_run(tmp_path_factory.mktemp("promoted"))


def runs(trained: TrainedPolicy, folder: Path, *names: str) -> Path:
    for name in names:
        shutil.copytree(trained.folder, folder / name)
    return folder


def updated(run: Path, of: TrainedPolicy, low: float, high: float = 0.2) -> Path:
    """Give a run a verdict against another one: level by the deciding measure, and by a second."""
    differences = {"x": Evidence(0.0, 0.0, 0.0), "ndcg_liked": Evidence(low, low, high)}
    verdict = {"decided_by": "x", "differences": differences, "steps": 9}
    about = {"of": "a", "run": of.fingerprint, "settings_from_nothing": {}, "appended": {}}
    update = Update.model_validate({**about, "episodes": 1, "verdict": verdict | {"users": 3}})
    RunRecord.read(run).copy_with(update=update).write(run)
    return run


def current(folder: Path) -> str | None:
    return getattr(promoted(folder), "current", None)


def test_only_later_runs_need_a_verdict(trained: TrainedPolicy, tmp_path: Path) -> None:
    folder = runs(trained, tmp_path, "a", "b", "c")
    promote(folder / "a")
    with pytest.raises(InputError, match="no verdict"):
        promote(folder / "b")
    with pytest.raises(InputError, match=r"worse than a: ndcg_liked -0.3 \[-0.3, -0.1\]"):
        promote(updated(folder / "b", trained, -0.3, -0.1))
    assert current(folder) == "a"
    promote(updated(folder / "b", trained, -0.1))
    assert current(folder) == "b"
    promote(folder / "c", force=True)
    promote(folder / "c")  # again: nothing changes
    found = promoted(folder)
    assert (found.current, found.previous) == ("c", ("a", "b"))


def test_another_run_under_the_name_of_the_current_one_needs_a_verdict(
    trained: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = runs(trained, tmp_path, "a", "b")
    promote(folder / "a")
    RunRecord.read(folder / "a").copy_with(fingerprint="another store").write(folder / "a")
    with pytest.raises(InputError, match="no verdict"):
        promote(folder / "a")
    for name in ("a", "b"):
        with pytest.raises(InputError, match="was compared with a, not with the current run a"):
            promote(updated(folder / name, trained, 0.1))
    told = "a is not the run that was promoted"
    with pytest.raises(InputError, match=told):
        promote(updated(folder / "b", TrainedPolicy.load(folder / "a"), 0.1))
    assert main(["update", str(folder), "log.parquet", "--out", str(tmp_path / "c")]) == 2
    assert told in capsys.readouterr().err
    found = promote(folder / "a", force=True)
    assert found.fingerprint == TrainedPolicy.load(folder / "a").fingerprint
    assert found.previous == ()


def test_back_returns_as_often_as_there_was_a_run(trained: TrainedPolicy, tmp_path: Path) -> None:
    folder = runs(trained, tmp_path, "a", "b")
    with pytest.raises(InputError, match="no run was current before"):
        promote_back(folder)
    promote(folder / "a")
    assert main(["promote", str(folder / "b"), "--force"]) == 0
    assert main(["promote", str(folder), "--back"]) == 0
    assert current(folder) == "a"
    assert main(["promote", str(folder), "--back"]) == 2
    assert current(folder) == "a"


def test_a_damaged_run_or_pointer_is_refused(trained: TrainedPolicy, tmp_path: Path) -> None:
    folder = runs(trained, tmp_path, "a", "b")
    promote(folder / "a")
    weights = folder / "b" / "policy" / "best.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"?")
    with pytest.raises(InputError, match=r"best\.safetensors"):
        promote(folder / "b", force=True)
    assert current(folder) == "a"
    rest = {"files": {}, "fingerprint": "0"}
    names = [{"current": "a", "previous": ["../a"]}, {"current": "/tmp/a"}, {"current": ".."}]
    for wrong in (*(rest | name for name in names), rest, {**rest, "current": 3}):
        (folder / POINTER).write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=POINTER):
            promote_back(folder)


@pytest.mark.slow
def test_a_promotion_killed_at_any_moment_leaves_a_whole_pointer(
    trained: TrainedPolicy, tmp_path: Path
) -> None:
    folder = runs(trained, tmp_path, "run", "other")
    promote(folder / "run")
    assert kills("promote", folder) >= 7
    promote(folder / "other", force=True)
    assert current(folder) == "other"


def test_a_link_to_a_run_elsewhere_is_refused(trained: TrainedPolicy, tmp_path: Path) -> None:
    folder = runs(trained, tmp_path / "runs", "a")
    served = tmp_path / "served"
    served.mkdir()
    (served / "current").symlink_to(folder / "a")
    with pytest.raises(InputError, match=r"current is a link.*name the run itself, .*runs/a"):
        promote(served / "current")
    assert current(folder) is None
