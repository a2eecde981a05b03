"""Every table and figure of the paper has its cells, and one command makes it."""

from pathlib import Path

import pytest

from tests.support.control_files import TINY, control, refused, write_made
from tests.support.result_rows import result_row
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.results.rows import append_rows, read_rows
from ucfrec_control.benchmark.budgets import BUDGETS, budget_of
from ucfrec_control.benchmark.methods import MAIN, ROBUST, ROBUSTNESS, SCORES, TABLES
from ucfrec_control.commands.reproduce import PARTS
from ucfrec_control.data.distractor import DISTRACTORS
from ucfrec_control.figures.figures import draw_plans, plan_rows

LAST = {"suite": SCORES, "metric": "score", "checkpoint": "last"}


@pytest.mark.parametrize("name", PARTS)
def test_a_part_has_rows_and_files_of_its_tables(name: str) -> None:
    part = PARTS[name]
    assert set(part.methods) <= set(ROBUST if part.table == ROBUSTNESS else TABLES[part.table])
    for size in BUDGETS:
        own = part.budget(size)
        assert own.tasks == (part.files or budget_of(part.table, size).tasks)
    assert "ucf-paper" in (part.methods or TABLES[part.table])
    assert set(part.distractors) <= set(DISTRACTORS)
    assert part.of_runs == (name in ("figure-5", "figure-6"))


def test_one_command_makes_a_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_made(tmp_path, "hopper_medium-zoo")
    settings = (*TINY, "crm.epochs=1", "csg.epochs=1")
    tiny = Budget("small", ("unused",), 1, Evaluation(1, 1000), settings)
    monkeypatch.setitem(BUDGETS, "small", tiny)
    where = ("--data", tmp_path, "--out", tmp_path / "out", "--context", "ucf-paper=5")
    printed, said = control("reproduce", "figure-5", *where)
    assert "reproduce figure-5: 2 cells, 2 of them left to measure" in said
    rows = read_rows(tmp_path / "out" / "results.jsonl")
    assert {row.method for row in rows} == {"ucf", "ucf-paper"}
    assert {row.details.get("updates") for row in rows} == {
        None,
        "the paper's settings, 0.004% of its updates",
    }
    assert "ucf-paper…: the paper's settings, 0.004% of its updates" in printed
    for kind in ("moves", "acceptance", "attention"):
        assert len(list((tmp_path / "out" / "figure-5").glob(f"{kind}-*.png"))) == 2


def test_every_other_part_is_drawn_of_its_rows(tmp_path: Path) -> None:
    for part in PARTS.values():
        robust = part.table == ROBUSTNESS
        shared = LAST | {"suite": part.table if robust else SCORES, "table": part.table}
        rows = [
            result_row(10.0 * n + seed, **shared, task="d", method=method, **own)
            for n, method in enumerate(part.methods or TABLES[part.table])
            for distractor in part.distractors or (None,)
            for conditions in [small(distractor=distractor, lambda_mask=n / 10)]
            for seed in range(2)
            for own in [{"training_seed": seed, "conditions": conditions}]
        ]
        made = {file.name for file in draw_plans(plan_rows(rows), tmp_path)[0]}
        wanted = "robustness-small-d.png" if robust else f"scores-small-{part.table}.png"
        assert wanted in made
    assert {*tmp_path.glob("lambda-*.png")} == {
        tmp_path / f"lambda-small{family}.png" for family in ("", "-ucf-paper")
    }


def small(**conditions: object) -> dict[str, object]:
    return {"budget": "small", **conditions}


def test_show_only_draws_the_rows_at_hand_and_measures_nothing(tmp_path: Path) -> None:
    of = LAST | {"task": "d\x1b[2J\nforged"}
    rows = [
        result_row(41.5, **of, table=MAIN, method="ucf", conditions=small()),
        result_row(42.5, **of, table=MAIN, method="bc", conditions=small()),
        result_row(43.5, **of, table=MAIN, method="ucf", conditions={"budget": "full"}),
        result_row(44.5, **of, table="lambda", method="ucf", conditions=small()),
    ]
    append_rows(results := tmp_path / "rows.jsonl", rows)
    asked = ("--show-only", "--results", results, "--out", tmp_path / "out")
    printed = control("reproduce", "table-1", *asked)[0]
    assert [score in printed for score in ("41.5", "42.5", "43.5", "44.5")] == [True] + [False] * 3
    assert "d\\x1b[2J forged" in printed
    assert "no rows of table-9" in refused("reproduce", "table-9", *asked)
    assert "drawn from its runs" in refused("reproduce", "figure-5", *asked)


def test_rows_that_lack_what_is_shown_are_one_clear_error(tmp_path: Path) -> None:
    for command, suite, conditions, lacking in (
        ("benchmark", SCORES, {}, "budget"),
        ("robustness", ROBUSTNESS, small(), "distractor"),
    ):
        results = tmp_path / f"{command}.jsonl"
        append_rows(results, [result_row(1.0, **LAST | {"suite": suite}, conditions=conditions)])
        said = refused(command, "--show-only", "--results", results)
        assert f"{results} is damaged (KeyError: '{lacking}'); measure its rows again" in said


def test_a_figure_that_cannot_be_drawn_keeps_no_other_from_it(tmp_path: Path) -> None:
    results, out = tmp_path / "rows.jsonl", tmp_path / "out"
    for weight in (0.5, "half"):
        named = {"table": "lambda", "method": "ucf", "conditions": small(lambda_mask=weight)}
        append_rows(results, [result_row(1.0, **LAST, **named)])
    said = control("figures", "--results", results, "--out", out)[1]
    assert "lambda-small: what it is drawn from is damaged" in said
    assert (out / "scores-small-lambda.png").exists()
