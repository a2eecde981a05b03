"""Records: read and written in one place, and damage is one line."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.records import Example
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A folder with two files and their record."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    Example(files={}, version=1, numbers=(0.5,)).sealed(tmp_path)
    return tmp_path


def test_absent_entries_are_left_out(sealed: Path) -> None:
    written = read_json(sealed / "record.json")
    assert written["numbers"] == [0.5]
    assert "note" not in written
    assert Example.read(sealed).note is None


def test_sealing_again_signs_off_no_damage(sealed: Path) -> None:
    record = Example.read(sealed)
    (sealed / "b").write_text("B")
    (sealed / "new").write_text("1")
    assert "new" in record.sealed(sealed).files
    assert [name for name, _ in Example.read(sealed).checksums(sealed).faults()] == ["b"]


def test_reopening_leaves_only_what_stays(sealed: Path) -> None:
    assert set(Example.read(sealed).reopened(sealed, ("b",)).files) == {"b"}
    assert set(Example.read(sealed).files) == {"b"}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"version": "soon"}, "is damaged: its version is 'soon'; make it again"),
        ({"version": None}, "is damaged: its version is None"),
        ({"version": 10**30}, "is damaged: its version is a number with more than 18 digits"),
        ({"numbers": [0, "x"]}, r"its numbers\.1 is 'x'"),
        ({"files": {"../a": [1, ""]}}, "its files is .* lies outside the folder"),
        ({"files": {"a": [1]}}, r"has no files\.a\.1"),
        ({"files": {"a": [-1, ""]}}, r"its files\.a\.0 is -1"),
    ],
)
def test_damage_is_one_line(sealed: Path, changes: dict[str, Any], says: str) -> None:
    value = {**read_json(sealed / "record.json"), **changes}
    (sealed / "record.json").write_text(json.dumps(value))
    with pytest.raises(InputError, match=rf"record\.json {says}|record\.json is damaged.*{says}"):
        Example.read(sealed)


def test_what_is_no_record_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not an example: it has no record"):
        Example.read(tmp_path)
    (tmp_path / "record.json").write_text("[]")
    with pytest.raises(InputError, match="it is no JSON object; make it again"):
        Example.read(tmp_path)
    (tmp_path / "record.json").write_text("{}")
    with pytest.raises(InputError, match=r"record\.json has no files; make it again"):
        Example.read(tmp_path)
