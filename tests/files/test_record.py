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
from ucfrec.files.record import Sealed


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A folder with two files and their record."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    Example(files={}, version=1, numbers=(0.5,)).seal(tmp_path)
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
    assert "new" in record.seal(sealed).files
    assert [name for name, _ in Example.read(sealed).checksums(sealed).faults()] == ["b"]


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
    (tmp_path / "record.json").write_text("[]")
    with pytest.raises(InputError, match="it is not a JSON object; make it again"):
        Example.read(tmp_path)
    (tmp_path / "record.json").write_text("{}")
    with pytest.raises(InputError, match=r"record\.json has no files; make it again"):
        Example.read(tmp_path)


@pytest.fixture
def three_files(tmp_path: Path) -> Path:
    """A folder with three files and their record."""
    folder = tmp_path / "sealed"
    (folder / "inner").mkdir(parents=True)
    for name, content in (("a", b""), ("b", b"words"), ("inner/c", bytes(30_000))):
        (folder / name).write_bytes(content)
    Example(files={}, version=1, numbers=(0.1, float("nan"))).seal(folder)
    return folder


def read(folder: Path) -> Sealed:
    return Example.read(folder).checksums(folder)


def test_what_was_sealed_comes_back_and_holds(three_files: Path) -> None:
    record, files = Example.read(three_files), read(three_files)
    assert record.version == 1
    assert set(record.files) == {"a", "b", "inner/c"}
    assert list(files.faults()) == []
    files.require()


def test_every_flipped_bit_is_found_or_changes_nothing(three_files: Path, tmp_path: Path) -> None:
    generator, before = random.Random(0), Example.read(three_files)
    found = 0
    for number in range(90):
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(three_files, copy)
        path = copy / ("record.json", "b", "inner/c")[number % 3]
        content = bytearray(path.read_bytes())
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
        path.write_bytes(content)
        try:
            record = Example.read(copy)
        except InputError:
            found += 1
            continue
        if any(record.checksums(copy).faults()):
            found += 1
            continue
        # The flip was in the layout of the record, or in the name of its entry "checksum".
        assert path.name == "record.json"
        assert repr(record) == repr(before)
    assert found > 80


def test_each_kind_of_fault_is_named(three_files: Path) -> None:
    (three_files / "a").unlink()
    (three_files / "a").mkdir()
    (three_files / "b").write_bytes(b"word")
    (three_files / "inner" / "c").write_bytes(bytes(30_001))
    (three_files / "foreign").write_bytes(b"")
    files = read(three_files)
    faults = dict(files.faults())
    assert faults["b"] == "is truncated: 4 of 5 bytes"
    assert faults["inner/c"] == "is grown: 30,001 of 30,000 bytes"
    assert "a" in faults
    assert files.strangers() == ["foreign", "record.json"]
    with pytest.raises(InputError, match="restore the file, or make it again"):
        files.require(small=-1)
    (three_files / "b").unlink()
    assert dict(files.faults())["b"] == "is missing"
