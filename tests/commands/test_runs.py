"""`ucfrec verify` finds damage and says where."""

import shutil
from pathlib import Path

import pytest

from tests.support.episodes import random_episodes, write_store
from ucfrec.commands.cli import main
from ucfrec.files.atomic import read_json, write_json
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run

Capsys = pytest.CaptureFixture[str]

TINY = {
    "policy.dim": 8,
    "policy.context": 2,
    "train.steps": 4,
    "train.validate_every": 2,
    "augment.copies": 0,
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store and a run on it."""
    folder = tmp_path_factory.mktemp("verify")
    store = write_store(folder / "store", random_episodes([4] * 30, items=False))
    train_run(store, folder / "run", resolve_config("ucf", None, TINY))
    return folder


def test_what_is_whole_is_said_to_be(made: Path, capsys: Capsys) -> None:
    assert main(["verify", str(made / "store"), str(made / "run")]) == 0
    store, run = capsys.readouterr().out.splitlines()
    assert "store: 11 of 11 files have the content that was written" in store
    assert "run: " in run


def test_damage_is_one_line_a_file(made: Path, capsys: Capsys) -> None:
    column = made / "store" / "shard-00000" / "reward.npy"
    before = column.read_bytes()
    column.write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
    (made / "store" / "mine.txt").write_text("")
    assert main(["verify", str(made / "store")]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("ucfrec verify: 1 files do not have the content")
    assert [line.split("/")[-1] for line in printed.out.splitlines()] == [
        "reward.npy has another content than was written",
        "mine.txt is not listed in meta.json: it was added later",
        "store: 10 of 11 files have the content that was written (0.0 MB)",
    ]
    column.write_bytes(before)
    (made / "store" / "mine.txt").unlink()


@pytest.mark.parametrize("name", ["\ud800", "a" * 5000, "x\ny"])
def test_listed_names_without_file(made: Path, tmp_path: Path, capsys: Capsys, name: str) -> None:
    shutil.copytree(made / "store", tmp_path / "store")
    record = read_json(tmp_path / "store" / "meta.json")
    record["files"][name] = [1, "00"]
    write_json(tmp_path / "store" / "meta.json", record)
    assert main(["verify", str(tmp_path / "store")]) == 2
    assert "11 of 12 files have the content" in capsys.readouterr().out


def test_other_paths(made: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert main(["verify", str(tmp_path)]) == 2
    assert "neither an episode store" in capsys.readouterr().err
    (tmp_path / "rows.jsonl").write_text("{}\n")
    assert main(["verify", str(tmp_path / "rows.jsonl")]) == 2
    assert "line 1 is not a result row" in capsys.readouterr().err
    record = read_json(made / "run" / "run.json")
    del record["files"]
    write_json(tmp_path / "run.json", record)
    assert main(["verify", str(tmp_path)]) == 2
    assert "run.json has no files; train it again" in capsys.readouterr().err


def test_a_flipped_bit_of_a_run_is_found_by_whoever_reads_it(made: Path, capsys: Capsys) -> None:
    for name in ("policy/best.safetensors", "policy/metrics.jsonl"):
        path = made / "run" / name
        before = path.read_bytes()
        path.write_bytes(before[:-9] + bytes([before[-9] ^ 1]) + before[-8:])
        arguments = ["report", str(made / "run"), "--out", str(made / "report.html")]
        assert main(arguments) == 2
        assert f"{name} has another content than was written" in capsys.readouterr().err
        path.write_bytes(before)
