"""The benchmark grid: resumed without measuring twice, nothing lost to a failure."""

import json
from pathlib import Path
from typing import Any

import pytest

from ucfrec.errors import InputError
from ucfrec.reporting.grid import read_rows, run_grid


def _square(cell: tuple[str, int]) -> list[dict[str, Any]]:
    folder, number = cell
    marks = Path(folder) / "marks"
    with marks.open("a") as file:
        file.write(f"{number}\n")
    if number < 0:
        raise ValueError("negative")
    return [{"square": number**2, "sign": sign} for sign in (1, -1)]


def _keys(cell: tuple[str, int]) -> dict[str, Any]:
    return {"number": cell[1]}


def test_measures_once_and_returns_rows_in_the_order_of_cells(tmp_path: Path) -> None:
    results = tmp_path / "results" / "rows.jsonl"
    first = [(str(tmp_path), n) for n in (2, 1)]
    run_grid(first, _square, _keys, results, 2)
    cells = [(str(tmp_path), n) for n in (1, 3, 2)]
    rows = run_grid(cells, _square, _keys, results, 2)
    assert [(row["number"], row["square"], row["sign"]) for row in rows] == [
        (n, n**2, sign) for n in (1, 3, 2) for sign in (1, -1)
    ]
    assert sorted((tmp_path / "marks").read_text().split()) == ["1", "2", "3"]
    assert len(read_rows(results)) == 6


def test_a_failed_cell_costs_only_itself(tmp_path: Path) -> None:
    results = tmp_path / "rows.jsonl"
    cells = [(str(tmp_path), n) for n in (-1, 5)]
    told = r"1 of 2 cells failed.*'number': -1.*ValueError: negative"
    with pytest.raises(InputError, match=told):
        run_grid(cells, _square, _keys, results, 1)
    assert {row["number"] for row in read_rows(results)} == {5}


def test_a_line_that_is_no_row_is_named(tmp_path: Path) -> None:
    results = tmp_path / "rows.jsonl"
    results.write_text(json.dumps({"number": 1}) + "\n[broken\n")
    with pytest.raises(InputError, match="line 2, is no result row"):
        run_grid([], _square, _keys, results, 1)
