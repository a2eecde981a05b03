"""Records: read and written in one place, and damage is one line."""

import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support.records import Example
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A folder with three files and their record."""
    folder = tmp_path / "sealed"
    (folder / "inner").mkdir(parents=True)
    for name, content in (("a", b""), ("b", b"words"), ("inner/c", bytes(30_000))):
        (folder / name).write_bytes(content)
    Example(files={}, version=1, numbers=(0.5, float("nan"))).seal(folder)
    return folder


def test_what_was_sealed_comes_back_and_holds(sealed: Path) -> None:
    written, record = read_json(sealed / "record.json"), Example.read(sealed)
    assert written["numbers"] == [0.5, None]
    assert "note" not in written
    assert (record.version, record.note, {*record.files}) == (1, None, {"a", "b", "inner/c"})
    assert list(record.faults(sealed)) == []
    record.require(sealed, small=10**9)


def test_sealing_again_signs_off_no_damage(sealed: Path) -> None:
    record = Example.read(sealed)
    (sealed / "b").write_text("B")
    (sealed / "new").write_text("1")
    assert "new" in record.seal(sealed).files
    assert [name for name, _ in Example.read(sealed).faults(sealed)] == ["b"]


def test_reopening_leaves_only_what_stays(sealed: Path) -> None:
    assert set(Example.read(sealed).reopen(sealed, ("b",)).files) == {"b"}
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
    for content, says in (("[]", "it is not a JSON object"), ("{}", r"record\.json has no files")):
        (tmp_path / "record.json").write_text(content)
        with pytest.raises(InputError, match=f"{says}; make it again"):
            Example.read(tmp_path)


def test_every_flipped_bit_is_found_or_changes_nothing(sealed: Path, tmp_path: Path) -> None:
    generator, before = random.Random(0), Example.read(sealed)
    found = 0
    for number in range(90):
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(sealed, copy)
        path = copy / ("record.json", "b", "inner/c")[number % 3]
        content = bytearray(path.read_bytes())
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
        path.write_bytes(content)
        try:
            record = Example.read(copy)
        except InputError:
            found += 1
            continue
        if any(record.faults(copy)):
            found += 1
            continue
        # The flip was in the layout of the record, or in the name of its entry "checksum".
        assert path.name == "record.json"
        assert repr(record) == repr(before)
    assert found > 80


def test_each_kind_of_fault_is_named(sealed: Path) -> None:
    (sealed / "a").unlink()
    (sealed / "a").mkdir()
    (sealed / "b").write_bytes(b"word")
    (sealed / "inner" / "c").write_bytes(bytes(30_001))
    (sealed / "foreign").write_bytes(b"")
    record = Example.read(sealed)
    assert dict(record.faults(sealed)) == {
        "a": "is not a regular file",
        "b": "is truncated: 4 of 5 bytes",
        "inner/c": "is grown: 30,001 of 30,000 bytes",
    }
    assert record.strangers(sealed) == ["foreign", "record.json"]
    with pytest.raises(InputError, match="restore the file, or make it again"):
        record.require(sealed)
    (sealed / "b").unlink()
    assert dict(record.faults(sealed))["b"] == "is missing"
