"""The forest plot draws what each verdict is of, and whether it stands."""

from pathlib import Path

import pytest

from tests.support.random_runs import random_run
from tests.support.report_page import Page, estimate
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting.forest import forest, quoted
from ucfrec.reporting.page_results import Estimates, Results
from ucfrec.results.rows_file import write_results


def of(*estimates: Estimates) -> Results:
    return Results({}, estimates)


def test_a_line_a_policy_hollow_where_the_verdict_forbids() -> None:
    good = [
        estimate("IPS", 3.0),
        estimate("DR", 4.0, details={"verdict_of": "DR", "reliable": True}),
    ]
    bad = [estimate("DR", 9.0, details={"verdict_of": "DR", "reliable": False})]
    logged = estimate(LOGGED, 2.0)
    drawn = forest(of(Estimates("good", logged, good, ()), Estimates("bad", logged, bad, ())))
    assert drawn is not None
    assert [point.stands for point in drawn.points] == [True, False]
    first, second = drawn.points
    assert first.name == ("good: DR",)
    assert "95% interval 3.5 to 5.5, the estimate stands" in first.summary
    assert "do not rely on it" in second.summary
    assert first.low < first.at < first.high
    assert first.at < second.at
    assert first.y < second.y < drawn.height
    assert drawn.logged is not None
    assert drawn.logged < first.at


def test_without_an_interval_there_is_no_line() -> None:
    models = [estimate("DM", 1.0, interval=None), estimate("FQE", 2.0, interval=None)]
    assert forest(of(Estimates("ucf", estimate(LOGGED, 2.0), models, ()))) is None
    assert forest(of()) is None
    snips = estimate("SNIPS", 1.0, details={"verdict_of": "SNIPS"})
    assert quoted([*models, snips]) == snips


def test_logs_that_differ_have_no_common_reference() -> None:
    rows = [estimate("DR", 4.0, details={"verdict_of": "DR"})]
    drawn = forest(
        of(
            Estimates("a", estimate(LOGGED, 2.0), rows, ()),
            Estimates("b", estimate(LOGGED, 3.0), rows, ()),
        )
    )
    assert drawn is not None
    assert drawn.logged is None
    assert not any(point.stands for point in drawn.points)


def test_rows_of_ope_are_drawn_in_the_report(folder: Path, tmp_path: Path) -> None:
    from ucfrec.reporting.page import write_report

    said = "The policy has a higher return than the logged one: +2"
    about = {
        "conditions": {"choice": "softmax", "run": "runs/ucf", "sessions": 10},
        "details": {"warnings": [], "verdict": said, "verdict_of": "DR", "reliable": True},
    }
    rows = [
        estimate(name, value, policy, **about)
        for name, policy, value in ((LOGGED, "behavior", 2.0), ("DR", "ucf", 4.0))
    ]
    write_results(tmp_path / "ope.json", rows)
    write_report(tmp_path / "report.html", [folder / "ucf"], [tmp_path / "ope.json"])
    page = Page(tmp_path / "report.html")
    verdict = "The policy has a higher return than the logged one"
    assert f"For ucf (softmax) of runs/ucf: {verdict}" in page.text
    (group,) = [found for tag, found in page.elements if tag == "g" and found.get("class")]
    assert group["class"] == "stands"
    assert any(tag == "circle" for tag, _ in page.elements)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on random sessions."""
    return random_run(tmp_path_factory.mktemp("forest"), "dt", name="ucf").parent
