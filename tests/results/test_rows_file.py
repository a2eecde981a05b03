"""Files of rows: whole or untouched, appended to by one process at a time, every fault named."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.result_rows import read_configurations, result_row
from ucfrec.errors import InputError
from ucfrec.provenance import config_hash
from ucfrec.results.rows_file import (
    CONFIGURATIONS,
    append_rows,
    benchmarking,
    latest,
    read_rows,
)


def test_rows_are_read_as_they_were_appended(tmp_path: Path) -> None:
    path = tmp_path / "new" / "rows.jsonl"
    assert read_rows(path) == []
    rows = [result_row(float(n), training_seed=n) for n in range(3)]
    append_rows(path, rows[:1])
    append_rows(path, rows[1:])
    assert read_rows(path) == rows


def test_configurations_lie_once_beside_the_rows(tmp_path: Path) -> None:
    config = {"policy": {"dim": 8}, "seed": 0}
    named = config_hash(config)
    for seed in range(2):
        append_rows(tmp_path / "a.jsonl", [result_row(config_hash=named)], config)
        append_rows(tmp_path / "b.jsonl", [result_row(training_seed=seed)])
    assert read_configurations(tmp_path) == {named: config}
    assert len((tmp_path / CONFIGURATIONS).read_text().splitlines()) == 1
    with pytest.raises(InputError, match="have the hash of another configuration"):
        append_rows(tmp_path / "a.jsonl", [result_row(config_hash="other")], config)


@pytest.mark.parametrize(
    ("torn", "says"),
    [
        *((torn, "line 2 is not a result row") for torn in
          (b"[broken", b'{"suite": "x"', b"1" * 5000, b"[" * 100_000, b'"text"')),
        (b"\xff\xfe\n", r"rows\.jsonl is not UTF-8 text"),
    ],
)  # fmt: skip
def test_a_line_that_is_no_row_is_named_and_kept(tmp_path: Path, torn: bytes, says: str) -> None:
    path = tmp_path / "rows.jsonl"
    append_rows(path, [result_row()])
    path.write_bytes(path.read_bytes() + torn)
    with pytest.raises(InputError, match=says):
        read_rows(path)


def test_numbers_that_are_none_are_never_written(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with pytest.raises(InputError, match="is not a result row"):
        append_rows(path, [result_row(), result_row(float("nan"))])
    assert not path.exists()


def test_a_last_line_without_its_end_is_not_run_into(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps(result_row(1.0).to_json()))
    append_rows(path, [result_row(2.0)])
    assert [row.value for row in read_rows(path)] == [1.0, 2.0]


_FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from tests.support.result_rows import result_row
from ucfrec.results.rows_file import append_rows
signal.signal(signal.SIGXFSZ, signal.SIG_DFL if sys.argv[2] == "kill" else signal.SIG_IGN)
path = Path(sys.argv[1])
limit = path.stat().st_size + 100
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
append_rows(path, [result_row(9.0), result_row(10.0)])
"""


@pytest.mark.parametrize("how", ["kill", "raise"])
def test_an_append_that_breaks_off_leaves_the_file_as_it_was(tmp_path: Path, how: str) -> None:
    """The system stops the process in the middle of its write."""
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
    path = tmp_path / "rows.jsonl"
    append_rows(path, [result_row(1.0)])
    before = path.read_bytes()
    done = subprocess.run([sys.executable, "-c", _FULL_DISK, str(path), how], check=False)
    assert done.returncode != 0
    assert path.read_bytes() == before
    append_rows(path, [result_row(2.0)])
    assert [row.value for row in read_rows(path)] == [1.0, 2.0]


_APPEND = """
import sys
from pathlib import Path
from tests.support.result_rows import result_row
from ucfrec.results.rows_file import append_rows
for n in range(30):
    rows = [result_row(float(n), method=sys.argv[2], training_seed=n, table=t) for t in "ab"]
    append_rows(Path(sys.argv[1]), rows)
"""


def test_processes_that_append_at_once_lose_no_row(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    names = ("x", "y", "z")
    running = [subprocess.Popen([sys.executable, "-c", _APPEND, str(path), n]) for n in names]
    assert [process.wait() for process in running] == [0, 0, 0]
    rows = read_rows(path)
    assert len(rows) == 3 * 30 * 2
    for name in names:
        own = [(row.training_seed, row.table) for row in rows if row.method == name]
        assert own == [(n, table) for n in range(30) for table in "ab"]


def test_of_rows_that_measure_the_same_the_last_counts() -> None:
    old = result_row(1.0)
    rows = [
        old,
        result_row(2.0, training_seed=1),
        result_row(3.0, data_fingerprint="b", conditions={}),
        result_row(4.0, conditions={"budget": "full"}),
    ]
    assert sorted(row.value for row in latest(rows)) == [2.0, 3.0, 4.0]


_BENCHMARK = """
import sys
from pathlib import Path
from ucfrec.results.rows_file import benchmarking
with benchmarking(Path(sys.argv[1])):
    print("measuring", flush=True)
    sys.stdin.read()
"""


def test_one_command_at_a_time_fills_a_file_and_its_processes_append(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    other = subprocess.Popen(
        [sys.executable, "-c", _BENCHMARK, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert other.stdout is not None
    assert other.stdout.readline() == b"measuring\n"
    with (
        pytest.raises(InputError, match=rf"rows\.jsonl is being filled by process {other.pid} "),
        benchmarking(path),
    ):
        raise AssertionError("the block must not run")
    with benchmarking(tmp_path / "others.jsonl"):
        append_rows(path, [result_row()])
    other.kill()
    other.wait()
    with benchmarking(path):
        append_rows(path, [result_row(training_seed=7)])
    assert len(read_rows(path)) == 2
    assert [each.name for each in tmp_path.iterdir()] == ["rows.jsonl"]
