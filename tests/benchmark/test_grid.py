"""The benchmark grid: resumed without measuring twice, nothing lost to a failure."""

import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from ucfrec.benchmark.cells import Cell, Evaluation, Measurement
from ucfrec.benchmark.grid import run_grid
from ucfrec.errors import InputError
from ucfrec.provenance import config_hash
from ucfrec.results.rows import ResultRow, RowKey, read_rows


def _config(cell: Cell) -> dict[str, Any] | None:
    return {"number": (int(cell.task),)} if int(cell.task) > 1 else None


def _square(cell: Cell, key: RowKey) -> list[ResultRow]:
    number = int(cell.task)
    assert cell.run is not None
    with (cell.run.parent / "marks").open("a") as file:
        file.write(f"{number}\n")
    if number < 0:
        raise ValueError("negative")
    metrics = {
        "square": float(number**2),
        "process": os.getpid(),
        "threads": torch.get_num_threads(),
    }
    row = ResultRow(**vars(key), metric="square", metrics=metrics)
    return [replace(row, checkpoint=name) for name in ("last", "best")]


HOW = Measurement(_square, _config)


def _cells(folder: Path, *numbers: int) -> list[Cell]:
    evaluation = Evaluation(1, 0)
    return [
        Cell("s", "squares", str(n), "m", "p", evaluation, run=folder / f"run-{n}") for n in numbers
    ]


def _marks(folder: Path) -> list[str]:
    return sorted((folder / "marks").read_text().split())


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)


def _Measurement(rows: Sequence[ResultRow]) -> set[float]:
    """The processes that measured the rows, each with one thread."""
    assert {row.metrics["threads"] for row in rows} == {1}
    return {row.metrics["process"] for row in rows}


def test_measures_once_and_returns_rows_in_the_order_of_cells(tmp_path: Path) -> None:
    results = tmp_path / "results" / "rows.jsonl"
    rows = run_grid(_cells(tmp_path, 2, 1), HOW, results, 2)
    assert os.getpid() not in _Measurement(rows)
    rows = run_grid(_cells(tmp_path, 1, 3, 2, 3), HOW, results, 2)
    assert [(row.task, row.value, row.checkpoint) for row in rows] == [
        (str(n), float(n**2), name) for n in (1, 3, 2) for name in ("last", "best")
    ]
    assert _marks(tmp_path) == ["1", "2", "3"]
    assert len(read_rows(results)) == 6
    assert all(row.peak_memory_mib and row.peak_memory_mib > 10 for row in rows)
    hashes = {row.task: row.config_hash for row in rows}
    assert hashes == {"1": None} | {str(n): config_hash({"number": [n]}) for n in (2, 3)}


@pytest.mark.usefixtures("two_threads")
def test_rows_and_folders_of_a_cell_are_replaced_when_it_is_measured_again(tmp_path: Path) -> None:
    results = tmp_path / "rows.jsonl"
    first = run_grid(_cells(tmp_path, 2, 3), HOW, results, 1)
    for number in (2, 3):
        (tmp_path / f"run-{number}" / "policy").mkdir(parents=True)
    rows = run_grid(_cells(tmp_path, 2), HOW, results, 1, again=True)
    assert _Measurement(rows) == {os.getpid()}, "one worker needs no process of its own"
    assert _marks(tmp_path) == ["2", "2", "3"]
    assert read_rows(results) == [*first[2:], *rows], "rows of other cells stay"
    assert [(tmp_path / name).exists() for name in ("run-2", "run-3/policy")] == [False, True]


def test_a_failed_cell_costs_only_itself(tmp_path: Path) -> None:
    results = tmp_path / "rows.jsonl"
    says = r"1 of 2 cells failed.*task='-1'.*ValueError: negative"
    with pytest.raises(InputError, match=says):
        run_grid(_cells(tmp_path, -1, 5), HOW, results, 1)
    assert {row.task for row in read_rows(results)} == {"5"}
    results.write_text("\n[broken\n")
    with pytest.raises(InputError, match="line 2 is not a result row"):
        run_grid(_cells(tmp_path, 7), HOW, results, 1)
    assert _marks(tmp_path) == ["-1", "5"]


def _interrupted(cell: Cell, key: RowKey) -> list[ResultRow]:
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise RuntimeError("query interrupted") from None
    return _square(cell, key)


def test_an_interruption_that_a_library_renames_is_no_failed_cell(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_grid(_cells(tmp_path, 1, 2), replace(HOW, measure=_interrupted), tmp_path / "rows", 1)
    assert not (tmp_path / "rows").exists()
    assert run_grid(_cells(tmp_path, 1), HOW, tmp_path / "rows", 1)
