"""The verdict claims what intervals allow, and no more."""

from typing import Any

from tests.support.report_page import estimate, row
from ucfrec.reporting.page_results import Estimates, Results
from ucfrec.reporting.verdict import NO_RESULTS, verdict
from ucfrec.results.row import ResultRow


def earned(policy: str, value: float, **more: Any) -> ResultRow:
    return row("a", policy, value, interval=(value - 0.1, value + 0.1), **more)


def of_environment(*rows: ResultRow) -> str:
    (said,) = verdict(Results({"a": rows}, ()))
    return said


def test_without_results_nothing_is_said_of_returns() -> None:
    assert verdict(Results({}, ())) == [NO_RESULTS]
    assert "the returns of these policies are unknown" in NO_RESULTS


def test_the_best_is_named_with_its_interval_and_what_it_lies_above() -> None:
    said = of_environment(
        earned("random", 1.0), earned("optimal", 9.0), earned("logging", 2.95),
        earned("dt", 2.0, training_seed=0), earned("ucf", 3.0, training_seed=0),
    )  # fmt: skip
    assert "ucf has the highest return of 2 trained policies: 3 (95% interval 2.9 to 3.1)" in said
    assert "lies above those of the others, the next being dt (2)" in said
    assert "higher than that of random (1), and lower than that of optimal (9)" in said
    assert "Whether it is higher or lower than that of logging (2.95) is open" in said
    assert "Each policy was trained once" in said


def test_intervals_that_overlap_leave_it_open() -> None:
    said = of_environment(earned("dt", 2.9, training_seed=0), earned("ucf", 3.0, training_seed=0))
    assert "overlaps that of dt (2.9): which of them has the higher return is open" in said
    assert "to compare it with" in said


def test_seeds_of_training_are_taken_together() -> None:
    rows = [earned("ucf", value, training_seed=seed) for seed, value in enumerate((3.0, 4.0, 5.0))]
    said = of_environment(*rows, earned("random", 3.5), earned("bad", 1.0))
    assert "4 in the mean of 3 trainings (their 95% intervals span 2.9 to 5.1)" in said
    assert "higher than that of bad (1)" in said
    assert "lower than that of random (3.5) is open" in said
    assert "trained once" not in said


def test_checkpoints_of_one_run_are_no_seeds() -> None:
    rows = [earned("ucf", 3.0, training_seed=0, checkpoint="best"),
            earned("ucf", 2.0, training_seed=0, checkpoint="last")]  # fmt: skip
    said = of_environment(*rows)
    assert "ucf, checkpoint best has the highest return of 2 trained policies: 3 (" in said
    assert "trained once" in said


def test_built_in_policies_alone_say_nothing_of_trained_ones() -> None:
    assert of_environment(earned("random", 1.0)) == (
        "In a, only built-in policies were evaluated: random (1)."
    )


def test_of_logs_the_verdict_of_ope_is_quoted() -> None:
    rows = [estimate("DM", 9.0), estimate("DR", 2.0, details={"verdict": "higher"})]
    (said,) = verdict(Results({}, [Estimates("ucf", None, rows, ())]))
    assert said == "For ucf: higher."
    (said,) = verdict(Results({}, [Estimates("ucf", None, rows[:1], ())]))
    assert "no verdict" in said
