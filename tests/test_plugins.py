"""Plugins of every group: what is of another type, or broken, is refused in one line."""

from importlib import invalidate_caches
from pathlib import Path

import pytest

from ucfrec.commands.cli import main

ENTRY_POINTS = """[ucfrec.simulators]
number = my_things:NUMBER
[ucfrec.datasets]
number = my_things:NUMBER
gone = my_gone:DATASET
[ucfrec.benchmarks]
number = my_things:NUMBER
"""


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A distribution as pip leaves it, on the path."""
    info = tmp_path / "site" / "my_things-1.0.dist-info"
    info.mkdir(parents=True)
    (info.parent / "my_things.py").write_text("NUMBER = 7\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-things\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(info.parent))
    invalidate_caches()


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("collect --env number --sessions 2 --out logs", "the simulator 'number' is installed as"),
        ("prepare log.csv --dataset number --out store", "the dataset 'number' is installed as"),
        ("benchmark number", "the benchmark 'number' is installed as my_things:NUMBER"),
        ("datasets open-bandits", "no data set is called"),
    ],
)
def test_commands_say_so_in_one_line(
    command: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 2
    error = capsys.readouterr().err
    assert says in error
    assert "Traceback" not in error


def test_other_datasets_are_listed_beside_a_broken_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets"]) == 0
    printed = capsys.readouterr()
    assert "open-bandit" in printed.out
    assert "note: the dataset 'gone' is installed as my_gone:DATASET, which" in printed.err
    assert "note: the dataset 'number'" in printed.err
