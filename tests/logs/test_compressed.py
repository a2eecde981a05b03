"""Compressed logs that unfold to fill the disk."""

import gzip
import time
from pathlib import Path

import numpy as np
import pytest

from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.logs import compressed
from ucfrec.logs.compressed import require_plausible_size
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import validate

HEADER = b"user_id,item_id,timestamp,reward\n"


def test_a_small_file_of_equal_rows_is_refused_before_it_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bomb.csv.gz"
    row = b"1,2,1700000000000,1\n" * 50_000
    with gzip.open(path, "wb", compresslevel=9) as file:
        file.write(HEADER)
        for _ in range(300):
            file.write(row)
    assert path.stat().st_size < 2**20
    assert main(["prepare", str(path), "--out", str(tmp_path / "store")]) == 2
    printed = capsys.readouterr().err.splitlines()[-1]  # after lines of progress, if it took long
    assert "bomb.csv.gz unfolds to more than 268,435,456 bytes from" in printed
    assert [each.name for each in tmp_path.iterdir()] == ["bomb.csv.gz"]


@pytest.mark.parametrize("parts", [1, 3])
def test_the_limit_is_a_hundred_times_the_size_and_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts: int
) -> None:
    """A file may have several members, one after the other."""
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"a" * 40_000) * parts)
    monkeypatch.setattr(compressed, "_RATIO", 0)
    monkeypatch.setattr(compressed, "_LARGE", 40_000 * parts)
    monkeypatch.setattr(compressed, "_DEFLATE", 10**6)
    require_plausible_size(path)
    monkeypatch.setattr(compressed, "_LARGE", 40_000 * parts - 1)
    with pytest.raises(ValueError, match="unfolds to more than"):
        require_plausible_size(path)


def test_a_log_that_compresses_as_logs_do_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compressed, "_LARGE", 0)
    count = np.arange(20_000)
    rows = "\n".join(f"{i % 50},{i % 7},{1_700_000_000_000 + i},{i % 2}" for i in count)
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(HEADER + rows.encode(), 9))
    require_plausible_size(path)
    path.write_bytes(path.read_bytes()[:-40])
    require_plausible_size(path)  # its reader says that it is cut


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
@pytest.mark.parametrize("place", [0, 5000])
def test_a_field_of_50_megabytes_is_refused_in_a_second(
    tmp_path: Path, name: str, place: int
) -> None:
    rows = [f"1,{n % 9},{1_700_000_000_000 + n},{n % 2},b" for n in range(6000)]
    rows[place] += "a" * 50_000_000
    text = "\n".join(["user_id,item_id,timestamp,reward,x", *rows]).encode()
    path = tmp_path / name
    path.write_bytes(gzip.compress(text, 1) if name.endswith(".gz") else text)
    began = time.process_time()
    with pytest.raises(InputError, match=rf"line {place + 2:,}: has more than 2,000,000 bytes"):
        validate([path], LogMapping())
    assert time.process_time() - began < 1
