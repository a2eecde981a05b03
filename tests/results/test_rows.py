"""Result rows: read as they were written, and nothing else is read."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.records import JSON
from tests.support.result_rows import result_row
from ucfrec.errors import InputError
from ucfrec.results.rows import (
    ResultRow,
    ResultTable,
    RowKey,
    append_rows,
    benchmarking,
    latest,
    read_results,
    read_rows,
    row_from_json,
    select_intervals,
)

WHOLE = result_row(
    2.5,
    metrics={"length": 3.0},
    log_seed=1,
    evaluation_seed=1_000_000,
    conditions={"budget": "small", "episodes": 5, "rate": 0.5, "on": True, "none": None},
    config_hash="ab",
    data_fingerprint="ef",
    interval=(1.0, 3.0),
    target_return=4.0,
    rule="target return: the largest",
    details={"validation": {"4": [1, {"a": None}]}},
    wall_time_s=0.5,
    peak_memory_mib=300.0,
    command="ucfrec benchmark",
    commit="12",
    versions={"python": "3.11"},
)


@pytest.mark.parametrize("row", [WHOLE, result_row()], ids=["every field", "few fields"])
def test_a_row_is_read_as_it_was_written(row: ResultRow) -> None:
    assert row_from_json(json.dumps(row.to_json(), allow_nan=False), "here") == row
    assert not {"conditions", "interval", "command", "log_seed"} & result_row().to_json().keys()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"suite": 1}, "'suite'"),
        ({"training_seed": 10**30}, "'training_seed'"),
        ({"metrics": {"R_cum": float("nan")}}, "'metrics.R_cum'"),
        ({"metrics": {"other": 3}}, "its metrics lack 'R_cum'"),
        ({"interval": [1, 2, 3]}, "'interval"),
        ({"conditions": {"a": [1]}}, "'conditions.a"),
        ({"details": {"a": float("inf")}}, "every number should be finite"),
        ({"seed": 3}, "'seed': Unexpected"),
    ],
)
def test_what_is_of_another_kind_is_refused(change: dict[str, Any], says: str) -> None:
    given = result_row().to_json() | change
    with pytest.raises(InputError, match=r"x\.jsonl, line 3 is not a result row") as refused:
        row_from_json(json.dumps(given), "x.jsonl, line 3")
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@settings(max_examples=40)
@given(name=st.sampled_from([*WHOLE.to_json(), "other"]), value=JSON)
def test_whatever_stands_in_a_field_it_is_a_row_or_refused(name: str, value: Any) -> None:
    with pytest.raises(InputError, match="here is not a result row"):
        row_from_json(json.dumps(value), "here")
    written = json.dumps(WHOLE.to_json() | {name: value})
    try:
        row = row_from_json(written, "here")
    except InputError:
        return
    assert row_from_json(json.dumps(row.to_json(), allow_nan=False), "again") == row


def test_a_key_covers_its_rows_and_no_others() -> None:
    names = RowKey.__dataclass_fields__
    key = RowKey(**{name: getattr(WHOLE, name) for name in names})
    assert key.covers(WHOLE)
    more = ResultRow(**vars(WHOLE) | {"conditions": {**WHOLE.conditions, "distractor": 0.0}})
    assert key.covers(more)
    for name in names:
        value: Any = {"budget": "full"} if name == "conditions" else "9"
        assert not key.covers(ResultRow(**vars(WHOLE) | {name: value})), name
    assert not key.covers(replace(WHOLE, conditions={}))


def test_of_rows_that_are_not_finite_none_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        append_rows(tmp_path / "c.jsonl", [result_row(), result_row(float("nan"))])
    assert not (tmp_path / "c.jsonl").exists()


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


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "does not exist"),
        ({}, "holds no list of result rows"),
        ([1], "row 1 is not a result row"),
        ([WHOLE.to_json(), {}], "row 2 is not a result row"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: Any, says: str) -> None:
    if content is not None:
        (tmp_path / "rows.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=says):
        read_results(tmp_path / "rows.json")


def test_a_last_line_without_its_end_is_not_run_into(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    assert read_rows(path) == []
    path.write_text(json.dumps(WHOLE.to_json()))
    append_rows(path, [result_row(2.0)])
    assert read_rows(path) == [WHOLE, result_row(2.0)]


_FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from tests.support.result_rows import result_row
from ucfrec.results.rows import append_rows
signal.signal(signal.SIGXFSZ, signal.SIG_DFL if sys.argv[2] == "kill" else signal.SIG_IGN)
path = Path(sys.argv[1])
limit = path.stat().st_size + 100
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
append_rows(path, [result_row(9.0), result_row(10.0)])
"""


@pytest.mark.parametrize("how", ["kill", "raise"])
def test_an_append_that_breaks_off_leaves_the_file_as_it_was(tmp_path: Path, how: str) -> None:
    path = tmp_path / "rows.jsonl"
    append_rows(path, [result_row(1.0)])
    before = path.read_bytes()
    command = [sys.executable, "-c", _FULL_DISK, str(path), how]
    assert subprocess.run(command, check=False).returncode != 0
    assert path.read_bytes() == before


_APPEND = """
import sys
from pathlib import Path
from tests.support.result_rows import result_row
from ucfrec.results.rows import append_rows
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
    for name in names:
        own = [(row.training_seed, row.table) for row in rows if row.method == name]
        assert own == [(n, table) for n in range(30) for table in "ab"]


def test_of_rows_that_measure_the_same_the_last_counts() -> None:
    old = result_row(1.0)
    rows = [old, result_row(2.0, training_seed=1), result_row(3.0, data_fingerprint="b")]
    rows.append(result_row(4.0, conditions={"budget": "full"}))
    assert sorted(row.value for row in latest(rows)) == [2.0, 3.0, 4.0]


_BENCHMARK = """
import sys
from pathlib import Path
from ucfrec.results.rows import benchmarking
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
    says = rf"rows\.jsonl is being filled by process {other.pid} "
    with pytest.raises(InputError, match=says), benchmarking(path):
        raise AssertionError("the block must not run")
    with benchmarking(tmp_path / "others.jsonl"):
        append_rows(path, [result_row()])
    other.kill()
    other.wait()
    with benchmarking(path):
        append_rows(path, [result_row(training_seed=7)])
    assert len(read_rows(path)) == 2
    assert [each.name for each in tmp_path.iterdir()] == ["rows.jsonl"]


mpl.use("Agg")
_KEY = {"suite": "rank", "table": "rank", "task": "logs", "policy": "dt", "metric": "R"}
_BARE = ResultRow(**_KEY, method="popular", metrics={"R": 1.0}, conditions={"k": 10})
_ENDS = {"intervals": {"S": [0.125, 0.5]}}
_OWN = {"R": 1.5, "S": 0.25}
ROWS = [replace(_BARE, method="<b>", metrics=_OWN, interval=(1.0, 2.5), details=_ENDS), _BARE]


def test_a_frame_has_metrics_with_their_intervals_and_is_saved(tmp_path: Path) -> None:
    for name in ("rows.json", "rows"):
        ResultTable(ROWS, ()).save(tmp_path / name)
        assert read_results(tmp_path / name) == ROWS
    frame = ResultTable(ROWS, ()).to_frame().set_index("method")
    found = frame.loc["<b>", ["R", "R_low", "R_high", "S", "S_low", "S_high"]]
    assert found.tolist() == [1.5, 1.0, 2.5, 0.25, 0.125, 0.5]
    assert frame.loc["popular", ["S", "R_low"]].isna().all()
    assert (frame.k == 10).all()


def test_a_notebook_shows_rows_and_warnings_and_no_markup_of_names() -> None:
    table = ResultTable(ROWS, ["mind <this>"])
    html, shown = table._repr_html_(), repr(table).splitlines()
    assert all(text in html for text in ("&lt;b&gt;", "mind &lt;this&gt;"))
    assert "<b>" not in html
    assert "popular" in shown[-2]
    assert shown[-1] == "warning: mind <this>"


def test_a_chart_has_a_point_and_an_interval_for_each_method() -> None:
    table = ResultTable(ROWS, ())
    axes = table.plot()
    texts = [text.get_text() for text in axes.texts]
    assert [text.replace("\N{NO-BREAK SPACE}", " ") for text in texts] == [
        "<b>: 1.5 [1, 2.5]",
        "popular: 1",
    ]
    assert table.plot("S", ax=axes) is axes
    for name in ("T", "method", "k"):
        with pytest.raises(InputError, match=f"no row has the metric '{name}'; they have R, S"):
            table.plot(name)


def test_a_chart_of_estimates_has_those_of_verdicts_and_the_logged_return() -> None:
    details = {"verdict": "v", "verdict_of": "DR", "reliable": True}
    named = {"logged": ("behavior", 2.0), "DM": ("dt", 99.0), "DR": ("dt", 3.0)}
    estimates = [
        replace(_BARE, method=name, policy=policy, metric="R_cum", metrics={"R_cum": value})
        for name, (policy, value) in named.items()
    ]
    estimates = [replace(row, details=details) for row in estimates]
    axes = ResultTable(estimates, ()).plot()
    assert [text.get_text().strip() for text in axes.texts] == ["dt: 3", "logged: 2"]
    # Returns of several logs are no common level.
    fewer = [replace(row, metrics={"R_cum": row.value + 1}) for row in estimates]
    assert select_intervals(estimates + fewer)[1] is None
