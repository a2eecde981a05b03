"""The forest plot draws what each verdict is of, and whether it stands."""

from typing import Any

from tests.support.report_page import estimate
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting.page_results import Estimates, Results, draw_forest, find_quoted
from ucfrec.results.row import ResultRow


def forest_of(*policies: tuple[float, list[ResultRow]]) -> Any:
    """The forest of policies a, b, … with the logged return and the rows of each."""
    estimates = [
        Estimates(name, estimate(LOGGED, logged), rows, ())
        for name, (logged, rows) in zip("ab", policies, strict=False)
    ]
    return draw_forest(Results({}, estimates))


def test_a_line_a_policy_hollow_where_the_verdict_forbids() -> None:
    good = [
        estimate("IPS", 3.0),
        estimate("DR", 4.0, details={"verdict_of": "DR", "reliable": True}),
    ]
    bad = [estimate("DR", 9.0, details={"verdict_of": "DR", "reliable": False})]
    first, second, _ = forest_of((2.0, good), (2.0, bad)).summary.split(". ")
    assert first == "a: DR: 4, 95% interval 3.5 to 5.5, the estimate stands"
    assert second == "b: DR: 9, 95% interval 8.5 to 10.5, do not rely on it"


def test_without_an_interval_there_is_no_line() -> None:
    models = [estimate("DM", 1.0, interval=None), estimate("FQE", 2.0, interval=None)]
    assert forest_of((2.0, models)) is None
    assert forest_of() is None
    snips = estimate("SNIPS", 1.0, details={"verdict_of": "SNIPS"})
    assert find_quoted([*models, snips]) == snips


def test_logs_that_differ_have_no_common_reference() -> None:
    rows = [estimate("DR", 4.0, details={"verdict_of": "DR"})]
    alike, different = forest_of((2.0, rows), (2.0, rows)), forest_of((2.0, rows), (3.0, rows))
    assert alike.summary.endswith("For comparison, logged sessions: 2")
    assert "logged sessions" not in different.summary
    assert different.summary.count("do not rely on it") == 2
