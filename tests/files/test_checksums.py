"""Every flipped bit of a sealed folder is found."""

import random
import shutil
from pathlib import Path

import pytest

from tests.support.records import Example
from ucfrec.errors import InputError
from ucfrec.files.checksums import Sealed


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A folder with three files and their record."""
    folder = tmp_path / "sealed"
    (folder / "inner").mkdir(parents=True)
    for name, content in (("a", b""), ("b", b"words"), ("inner/c", bytes(3_000_000))):
        (folder / name).write_bytes(content)
    Example(files={}, version=1, numbers=(0.1, float("nan"))).sealed(folder)
    return folder


def read(folder: Path) -> Sealed:
    return Example.read(folder).checksums(folder)


def test_what_was_sealed_comes_back_and_holds(sealed: Path) -> None:
    record, files = Example.read(sealed), read(sealed)
    assert record.version == 1
    assert set(record.files) == {"a", "b", "inner/c"}
    assert list(files.faults()) == []
    files.require_small()


def test_every_flipped_bit_is_found_or_changes_nothing(sealed: Path, tmp_path: Path) -> None:
    generator, before = random.Random(0), Example.read(sealed)
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
