"""Every flipped bit of a sealed folder is found."""

import random
import shutil
from pathlib import Path

import pytest

from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json
from ucfrec.files.checksums import FILES, Sealed, reopen, seal, sealed_record


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A folder with three files and their record."""
    folder = tmp_path / "sealed"
    (folder / "inner").mkdir(parents=True)
    for name, content in (("a", b""), ("b", b"words"), ("inner/c", bytes(3_000_000))):
        (folder / name).write_bytes(content)
    seal(folder, "record.json", {"version": 1, "π": [0.1, float("nan")]})
    return folder


def read(folder: Path) -> Sealed:
    _, files = sealed_record(folder, "record.json", "make it again")
    assert files is not None
    return files


def test_what_was_sealed_comes_back_and_holds(sealed: Path) -> None:
    record, files = sealed_record(sealed, "record.json", "make it again")
    assert record["version"] == 1
    assert set(record[FILES]) == {"a", "b", "inner/c"}
    assert files is not None
    assert list(files.faults()) == []
    files.require_small()


def test_every_flipped_bit_is_found_or_changes_nothing(sealed: Path, tmp_path: Path) -> None:
    generator, before = random.Random(0), read_json(sealed / "record.json")
    found = 0
    for number in range(300):
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(sealed, copy)
        path = copy / ("record.json", "b", "inner/c")[number % 3]
        content = bytearray(path.read_bytes())
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
        path.write_bytes(content)
        try:
            record, files = sealed_record(copy, "record.json", "make it again")
        except InputError:
            found += 1
            continue
        if files is not None and any(files.faults()):
            found += 1
            continue
        # The flip was in the layout of the record, or in the name of its entry "checksum".
        assert path.name == "record.json"
        assert repr({name: record[name] for name in before}) == repr(before)
    assert found > 270


def test_each_kind_of_fault_is_named(sealed: Path) -> None:
    (sealed / "a").unlink()
    (sealed / "a").mkdir()
    (sealed / "b").write_bytes(b"word")
    (sealed / "inner" / "c").write_bytes(bytes(3_000_001))
    (sealed / "foreign").write_bytes(b"")
    files = read(sealed)
    faults = dict(files.faults())
    assert faults["b"] == "is truncated: 4 of 5 bytes"
    assert faults["inner/c"] == "is grown: 3,000,001 of 3,000,000 bytes"
    assert "a" in faults
    assert files.strangers() == ["foreign", "record.json"]
    with pytest.raises(InputError, match="restore the file, or make it again"):
        files.require_sizes()
    (sealed / "b").unlink()
    assert dict(files.faults())["b"] == "is missing"


def test_sealing_again_signs_off_no_damage(sealed: Path) -> None:
    record = read_json(sealed / "record.json")
    (sealed / "b").write_bytes(b"WORDS")
    (sealed / "new").write_bytes(b"1")
    seal(sealed, "record.json", record)
    assert [name for name, _ in read(sealed).faults()] == ["b"]
    assert "new" in read(sealed).files


def test_reopening_leaves_only_what_stays(sealed: Path) -> None:
    record = read_json(sealed / "record.json")
    reopen(sealed, "record.json", record, ("b",))
    assert set(read(sealed).files) == {"b"}


def test_a_folder_without_checksums_is_told_apart(sealed: Path) -> None:
    write_json(sealed / "record.json", {"version": 1})
    assert sealed_record(sealed, "record.json", "make it again") == ({"version": 1}, None)
