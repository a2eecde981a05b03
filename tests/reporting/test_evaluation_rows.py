"""Evaluations as result rows, and result rows as the report reads them."""

import json
from pathlib import Path

import pytest

from ucfrec.errors import InputError
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_behavior
from ucfrec.reporting.evaluation_rows import as_evaluation, evaluation_row, read_evaluations
from ucfrec.results.row import RowKey
from ucfrec.results.rows_file import append_rows

KEY = RowKey(
    suite="s",
    table="t",
    task="catalogue",
    method="random",
    policy="random",
    training_seed=3,
    evaluation_seed=7,
)


@pytest.mark.parametrize("environment", ["synthetic-catalog", "synthetic-taobao"])
def test_an_evaluation_keeps_its_numbers_in_a_row_and_back(
    environment: str, tmp_path: Path
) -> None:
    found = evaluate_behavior(Environment(environment), "random", 20, 7)
    row = evaluation_row(found, KEY)
    assert (row.value, row.interval) == (
        found["R_cum"],
        (found["R_cum_low"], found["R_cum_high"]),
    )
    assert row.conditions == {"episodes": 20}
    path = tmp_path / "rows.jsonl"
    append_rows(path, [row])
    (back,) = read_evaluations(path)
    assert back == as_evaluation(row)
    kept = {name: value for name, value in found.items() if value is not None}
    assert {name: back[name] for name in kept} == kept
    assert back["train_seed"] == 3


def test_evaluations_are_read_from_lists_and_lines(tmp_path: Path) -> None:
    row = {"environment": "a", "policy": "ucf", "R_cum": 1.0}
    (tmp_path / "a.json").write_text(json.dumps([row]))
    (tmp_path / "b.jsonl").write_text(json.dumps(row) + "\n")
    assert read_evaluations(tmp_path / "a.json") == read_evaluations(tmp_path / "b.jsonl") == [row]
    (tmp_path / "c.jsonl").write_text(json.dumps({"suite": "s"}) + "\n")
    with pytest.raises(InputError, match=r"c\.jsonl, line 1 is no result row: it has no table"):
        read_evaluations(tmp_path / "c.jsonl")
