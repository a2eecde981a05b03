"""The forest plot draws what each verdict is of, and whether it stands."""

from typing import Any

from tests.support.report_page import estimate, row
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting.results import NO_RESULTS, Estimates, conclude, draw_forest, find_quoted
from ucfrec.results.rows import ResultRow


def forest_of(*policies: tuple[float, list[ResultRow]]) -> Any:
    """The forest of policies a, b, … with the logged return and the rows of each."""
    named = zip("ab", policies, strict=False)
    estimates = [Estimates(name, [estimate(LOGGED, own), *rows]) for name, (own, rows) in named]
    return draw_forest(estimates)


def test_a_line_a_policy_hollow_where_the_verdict_forbids() -> None:
    doubly = estimate("DR", 4.0, details={"verdict_of": "DR", "reliable": True})
    good = [estimate("IPS", 3.0), doubly]
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


def earned(policy: str, value: float, **more: Any) -> ResultRow:
    return row("a", policy, value, interval=(value - 0.1, value + 0.1), **more)


def of_environment(*rows: ResultRow) -> str:
    (said,) = conclude({"a": rows}, ())
    return said


def test_the_best_is_named_with_its_interval_and_what_it_lies_above() -> None:
    said = of_environment(
        earned("random", 1.0), earned("optimal", 9.0), earned("logging", 2.95),
        earned("dt", 2.0, training_seed=0), earned("ucf", 3.0, training_seed=0),
    )  # fmt: skip
    assert "ucf (3) has the highest return per episode of 2 trained (95%" in said
    assert "(95% intervals 2.9 to 3.1; trainings: 1). Lower: dt (2), random (1)." in said
    assert "Higher: optimal (9). Open, as intervals overlap: logging (2.95). It was tr" in said
    said = of_environment(earned("dt", 2.9, training_seed=0), earned("ucf", 3.0, training_seed=0))
    assert "Open, as intervals overlap: dt (2.9). No built-in policy" in said
    said = of_environment(earned("random", 1.0))
    assert said == "In a, only built-in policies were evaluated: random (1)."
    assert conclude({}, ()) == [NO_RESULTS]


def test_seeds_of_training_are_taken_together() -> None:
    rows = [earned("ucf", value, training_seed=seed) for seed, value in enumerate((3.0, 4.0, 5.0))]
    said = of_environment(*rows, earned("random", 3.5), earned("bad", 1.0))
    assert "(95% intervals 2.9 to 5.1; trainings: 3). Open, as intervals overlap: random" in said
    assert "Lower: bad (1)." in said
    assert "trained once" not in said
    # Checkpoints of one run are no seeds.
    best, last = (earned("ucf", value, training_seed=0, checkpoint=name)
                  for name, value in (("best", 3.0), ("last", 2.0)))  # fmt: skip
    said = of_environment(best, last)
    assert "ucf, checkpoint best (3) has the highest return" in said
    assert "trained once" in said


def test_of_logs_the_verdict_of_ope_is_quoted() -> None:
    rows = [estimate("DM", 9.0), estimate("DR", 2.0, details={"verdict": "higher"})]
    (said,) = conclude({}, [Estimates("ucf", rows)])
    assert said == "For ucf: higher."
    (said,) = conclude({}, [Estimates("ucf", rows[:1])])
    assert "no verdict" in said
