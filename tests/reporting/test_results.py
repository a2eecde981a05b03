"""What the report says of results: the answer of each kind, one picture, and tables."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from tests.support.report_page import estimate, row
from ucfrec.errors import InputError
from ucfrec.off_policy.ab_test import Comparison
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting.results import Finding, conclude_update, read_findings
from ucfrec.results.evidence import Evidence
from ucfrec.results.rows import ResultRow, write_results
from ucfrec.runs.record import UpdateVerdict


def findings_of(folder: Path, *results: Any) -> list[Finding]:
    """Findings of files, each of rows or of a JSON object."""
    files = [folder / f"{number}.json" for number in range(len(results))]
    for file, content in zip(files, results, strict=True):
        if isinstance(content, dict):
            file.write_text(json.dumps(content))
        else:
            write_results(file, content)
    return read_findings(files)


def call(value: float, reliable: bool, **more: Any) -> list[ResultRow]:
    """The rows of `ucfrec ope` for one rule."""
    says = "The policy has a higher return: +1" if reliable else "Do not rely on this: 7 users"
    details = {"verdict": says, "verdict_of": "DR", "reliable": reliable, **more}
    names = {LOGGED: 2.0, "DM": 99.0, "DR": value}
    return [
        estimate(name, x, "behavior" if name == LOGGED else "ucf", details=details)
        for name, x in names.items()
    ]


def test_the_picture_has_the_logged_return_and_no_number_that_does_not_stand(
    tmp_path: Path,
) -> None:
    rules = {"decision_rule": {"temperature": 1.0}}, {"decision_rule": {"temperature": 0.5}}
    files = call(4.0, True, **rules[0]), call(9.0, False, **rules[1])
    picture, first, second = findings_of(tmp_path, *files)
    assert picture.chart is not None
    assert picture.chart.summary == (
        "ucf, temperature 1: 4 [3.5, 5.5]. ucf, temperature 0.5: the data cannot say. "
        "For comparison, logged: 2"
    )
    assert [first.subject, second.subject] == ["ucf, temperature 1", "ucf, temperature 0.5"]
    assert first.answer == "The policy has a higher return: +1"
    assert second.answer == "Do not rely on this"  # of several, without the reasons
    _, alone = findings_of(tmp_path, files[1])
    assert (alone.subject, alone.answer) == ("ucf", "Do not rely on this: 7 users")
    doubted = {"value": 0.7, "low": None, "high": None, "reasons": ["few users"]}
    sure = doubted | {"low": 0, "high": 1, "reasons": []}
    groups = [{"name": "young", "difference": doubted}, {"name": "old", "difference": sure}]
    _, grouped = findings_of(tmp_path, call(4.0, True, groups=groups))
    assert grouped.parts[0].rows == [("young", ["–; few users"]), ("old", ["0.7 [0, 1]"])]
    chosen, *_ = findings_of(tmp_path, call(4.0, True, selection="first is best"))
    assert chosen.answer == "first is best"
    (_, unknown) = findings_of(tmp_path, [estimate("DR", 2.0)])
    assert "no verdict" in unknown.answer


def compared(folder: Path, *rows: ResultRow) -> str:
    (finding,) = findings_of(folder, rows)
    return finding.answer


def earned(policy: str, value: float, **more: Any) -> ResultRow:
    return row("a", policy, value, **{"interval": (value - 0.1, value + 0.1)} | more)


def test_the_best_is_named_with_its_interval_and_what_it_lies_above(tmp_path: Path) -> None:
    said = compared(
        tmp_path,
        earned("random", 1.0), earned("optimal", 9.0), earned("logging", 2.95),
        earned("dt", 2.0, training_seed=0), earned("ucf", 3.0, training_seed=0),
    )  # fmt: skip
    assert "ucf (3) has the highest return per episode of 2 trained: 95%" in said
    assert "95% intervals 2.9 to 3.1; trainings: 1. Lower: dt (2), random (1)." in said
    assert "Higher: optimal (9)." in said
    assert "Open, as intervals overlap or are not known: logging (2.95). It was tr" in said
    without = earned("dt", 1.0, training_seed=0, interval=None)
    said = compared(tmp_path, without, earned("ucf", 3.0, training_seed=0))
    assert "not known: dt (1). No built-in policy" in said
    said = compared(tmp_path, earned("random", 1.0))
    assert said == "Only built-in policies: random (1)."


def test_seeds_of_training_are_taken_together(tmp_path: Path) -> None:
    rows = [earned("ucf", value, training_seed=seed) for seed, value in enumerate((3.0, 4.0, 5.0))]
    said = compared(tmp_path, *rows, earned("random", 3.5), earned("bad", 1.0))
    assert "intervals 2.9 to 5.1; trainings: 3." in said
    assert "not known: random (3.5)" in said
    assert "Lower: bad (1)." in said
    assert "trained once" not in said
    # Checkpoints of one run are no seeds.
    best, last = (earned("ucf", value, training_seed=0, checkpoint=name)
                  for name, value in (("best", 3.0), ("last", 2.0)))  # fmt: skip
    said = compared(tmp_path, best, last)
    assert "ucf, checkpoint best (3) has the highest return" in said
    assert "trained once" in said


def test_rows_of_any_metric_have_a_picture_and_a_table_from_the_best(tmp_path: Path) -> None:
    measured = {"ucf": 0.25, "popular": 0.5}
    ranked = [row("a", n, x, metric="hit", metrics={"hit": x}) for n, x in measured.items()]
    seeds = [earned("ucf", 3.0, training_seed=seed, metrics={"length": 7.5}) for seed in (0, 1)]
    returns, other, hits = findings_of(tmp_path, seeds, [row("b", "ucf", 8.0)], ranked)
    assert returns.chart is not None
    assert returns.chart.summary.startswith("ucf, training seed 0: 3 [2.9, 3.1]. ucf, training")
    assert returns.tables[0].rows[0] == ("ucf, training seed 0", ["3 [2.9, 3.1]", "7.5"])
    assert (other.subject, other.tables[0].columns) == ("evaluate, b", ["R_cum"])
    assert [name for name, _ in hits.tables[0].rows] == ["popular", "ucf"]


def test_an_ab_test_an_update_and_other_objects_are_shown(tmp_path: Path) -> None:
    counts: dict[str, Any] = {"without_user": 0, "without_arm": 0, "in_several": 3}
    pairs = dict.fromkeys(("users", "in_arm", "units", "without_value"), (500, 500))
    test = Comparison(
        column="clicks", per="item", arms=("old", "new"), values=(1.0, 1.5), shares=(0.5, 0.5),
        planned=Evidence(0.5, 0.3, 0.7), always=Evidence(0.5, 0.125, 0.875),
        several_names=("a", "b"),
        **pairs, **counts,
    )  # fmt: skip
    doubtful = Evidence(-9.0, -10.0, -8.0, ("few users",))
    differences = {"reward": Evidence(2.0, 1.0, 3.0), "ndcg": doubtful}
    verdict = UpdateVerdict(decided_by="reward", differences=differences, steps=9, users=5)
    record = {"update": {"of": "run-1", "verdict": verdict.model_dump()}}
    screened = {"dropped": 3, "columns": [1, 2], "verdict": "no effect"}
    ab, update, others = findings_of(tmp_path, asdict(test), record, screened)
    assert ab.answer == test.conclusion
    assert ab.chart is not None
    assert "whenever looked at: 0.5 [0.125, 0.875]. For comparison, no difference: 0" in (
        ab.chart.summary
    )
    assert any("3 users were in more than one arm" in text for text in ab.remarks)
    assert update == conclude_update("run-1", verdict)
    assert update.answer == "Better, by reward on the newest 9 rows of 5 users"
    assert update.chart is not None
    assert "reward: 2 [1, 3]. ndcg: the data cannot say" in update.chart.summary
    assert (others.answer, others.tables[0].rows) == (
        "", [("dropped", ["3"]), ("verdict", ["no effect"])]
    )  # fmt: skip
    rows = [{"guardrails": part} for part in ("abc", [1], [{}], [{"m": 1, "change": {"low": 1}}])]
    rows += [{"warnings": 5}, {"intervals": {"R_cum": [1]}}, {"decision_rule": "abc"}]
    for content in ({"always": 1}, *(call(4.0, True, **details) for details in rows)):
        with pytest.raises(InputError, match="is damaged"):
            findings_of(tmp_path, content, call(1.0, True))
