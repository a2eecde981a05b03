"""Every table and figure of the paper has its cells, and one command makes it."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.control_files import hopper_like, write_hdf5
from tests.support.result_rows import result_row
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.results.rows import append_rows, read_rows
from ucfrec_control.benchmark.budgets import BUDGETS, budget_of
from ucfrec_control.benchmark.methods import MAIN, ROBUST, ROBUSTNESS, SCORES, TABLES
from ucfrec_control.benchmark.reproduce import PARTS, budget_of_part
from ucfrec_control.cli import main
from ucfrec_control.data.distractor import DISTRACTORS
from ucfrec_control.figures.figures import make_row_figures

TINY = ("train.steps=4", "train.validate_every=2", "policy.dim=16", "policy.context=3")


@pytest.mark.parametrize("name", PARTS)
def test_a_part_has_rows_and_files_of_its_tables(name: str) -> None:
    part = PARTS[name]
    assert set(part.methods) <= set(ROBUST if part.table == ROBUSTNESS else TABLES[part.table])
    for size in BUDGETS:
        own = budget_of_part(part, size)
        assert own.tasks == (part.files or budget_of(part.table, size).tasks)
    assert set(part.distractors) <= set(DISTRACTORS)
    assert part.of_runs == (name in ("figure-5", "figure-6"))


def test_one_command_makes_a_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hdf5(tmp_path / "hopper_medium-zoo.hdf5", hopper_like((30, 8, 25) * 8))
    settings = (*TINY, "crm.epochs=1", "csg.epochs=1")
    tiny = Budget("small", ("unused",), 1, Evaluation(1, 1000), settings)
    monkeypatch.setitem(BUDGETS, "small", tiny)
    arguments = ["reproduce", "figure-5", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    said = capsys.readouterr().err
    assert "reproduce figure-5: 1 cells, 1 of them left to measure" in said
    assert {row.method for row in read_rows(tmp_path / "out" / "results.jsonl")} == {"ucf"}
    assert list((tmp_path / "out" / "figure-5").glob("moves-*.png"))


def test_every_other_part_is_drawn_of_its_rows(tmp_path: Path) -> None:
    for part in PARTS.values():
        robust = part.table == ROBUSTNESS
        rows = [
            result_row(
                10.0 * number + seed,
                suite=ROBUSTNESS if robust else SCORES,
                table=part.table,
                metric="score",
                task="d",
                method=method,
                training_seed=seed,
                checkpoint="last",
                conditions={
                    "budget": "small",
                    "distractor": distractor,
                    "lambda_mask": number / 10,
                },
            )
            for number, method in enumerate(part.methods or TABLES[part.table])
            for distractor in part.distractors or (None,)
            for seed in range(2)
        ]
        made = {file.name for file in make_row_figures(rows, tmp_path)}
        wanted = "robustness-scores-small-d.png" if robust else f"scores-small-{part.table}.png"
        assert wanted in made
    assert (tmp_path / "lambda-small.png").exists()


def test_show_only_draws_the_rows_at_hand_and_measures_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        result_row(
            score,
            suite=SCORES,
            table=table,
            metric="score",
            task="hopper_medium-zoo",
            method=method,
            training_seed=0,
            checkpoint="last",
            conditions={"budget": budget},
        )
        for table, method, budget, score in (
            (MAIN, "ucf", "small", 41.5),
            (MAIN, "bc", "small", 42.5),
            (MAIN, "ucf", "full", 43.5),
            ("lambda", "ucf", "small", 44.5),
        )
    ]
    results = tmp_path / "rows.jsonl"
    append_rows(results, rows)
    asked = ["--show-only", "--results", str(results), "--out", str(tmp_path / "out")]
    assert main(["reproduce", "table-1", *asked]) == 0
    printed = capsys.readouterr().out
    assert [score in printed for score in ("41.5", "42.5", "43.5", "44.5")] == [True] + [False] * 3
    assert read_rows(results) == rows
    assert main(["reproduce", "table-9", *asked]) == 2
    assert "no rows of table-9" in capsys.readouterr().err
    assert main(["reproduce", "figure-5", *asked]) == 2
    assert "drawn from its runs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "suite", "conditions", "lacking"),
    [
        ("benchmark", SCORES, {}, "budget"),
        ("robustness", ROBUSTNESS, {"budget": "small"}, "distractor"),
    ],
)
def test_rows_that_lack_what_is_shown_are_one_clear_error(
    command: str,
    suite: str,
    conditions: dict[str, str],
    lacking: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    results = tmp_path / "rows.jsonl"
    fields = {"suite": suite, "metric": "score", "checkpoint": "last", "conditions": conditions}
    append_rows(results, [result_row(1.0, **fields)])
    assert main([command, "--show-only", "--results", str(results)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{results} is damaged (KeyError: '{lacking}'); measure its rows again" in line
    assert main(["figures", "--results", str(results), "--out", str(tmp_path / "out")]) == 2
    assert f"{results} is damaged" in capsys.readouterr().err


def test_names_of_foreign_rows_do_not_steer_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, name = tmp_path / "rows.jsonl", "d\x1b[2J\nforged"
    row = result_row(1.0, suite=SCORES, table=MAIN, metric="score", task=name, checkpoint="last")
    append_rows(results, [replace(row, conditions={"budget": "small"})])
    assert main(["benchmark", "--show-only", "--results", str(results)]) == 0
    printed = capsys.readouterr().out
    assert "\x1b" not in printed
    assert "d\\x1b[2J forged" in printed


def test_a_figure_that_cannot_be_drawn_keeps_no_other_from_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, out = tmp_path / "rows.jsonl", tmp_path / "out"
    row = result_row(1.0, suite=SCORES, table="lambda", metric="score", method="ucf")
    for weight in (0.5, "half"):
        conditions = {"budget": "small", "lambda_mask": weight}
        append_rows(results, [replace(row, checkpoint="last", conditions=conditions)])
    assert main(["figures", "--results", str(results), "--out", str(out)]) == 0
    assert "lambda-small: what it is drawn from is damaged" in capsys.readouterr().err
    assert (out / "scores-small-lambda.png").exists()
