"""The verdict claims what intervals allow, and no more."""

from typing import Any

import pytest

from tests.support.report_page import estimate, row
from ucfrec.reporting.page_results import Estimates, Results
from ucfrec.reporting.verdict import NO_RESULTS, verdict
from ucfrec.results.row import ResultRow


def earned(policy: str, value: float, **more: Any) -> ResultRow:
    return row("a", policy, value, interval=(value - 0.1, value + 0.1), **more)


def of_environment(*rows: ResultRow) -> str:
    (said,) = verdict(Results({"a": rows}, ()))
    return said


def estimated(name: str, value: float) -> ResultRow:
    return estimate(name, value, interval=(value - 0.1, value + 0.1))


def of_logs(*rows: ResultRow, warnings: tuple[str, ...] = (), logged: bool = True) -> str:
    of_logged = estimated("logged", 1.0) if logged else None
    (said,) = verdict(Results({}, [Estimates("ucf", of_logged, rows, warnings)]))
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


@pytest.mark.parametrize(
    ("dr", "ips", "says"),
    [
        (2.0, 3.0, "Every weighted estimate (IPS and DR) says that its return is higher"),
        (0.2, 0.1, "Every weighted estimate (IPS and DR) says that its return is lower"),
        (1.1, 0.9, "No weighted estimate (IPS and DR) distinguishes it from the logging policy"),
        (2.0, 1.0, "disagree (DR higher than the logging policy, of IPS and DR)"),
        (2.0, 0.1, "disagree (DR higher; IPS lower than the logging policy, of IPS and DR)"),
    ],
)
def test_estimates_conclude_only_where_all_of_them_do(dr: float, ips: float, says: str) -> None:
    said = of_logs(estimated("DM", 9.0), estimated("IPS", ips), estimated("DR", dr))
    assert f"DR estimates {dr:g} [" in said
    assert "logged sessions have 1 [0.9, 1.1]" in said
    assert says in said


def test_an_estimate_with_warnings_is_not_relied_on() -> None:
    said = of_logs(estimated("DR", 5.0), warnings=("effective sample 3",))
    assert "DR estimates 5 [4.9, 5.1] per session, which is not reliable: effective" in said
    assert "is higher" not in said


def test_models_alone_conclude_nothing() -> None:
    said = of_logs(estimated("DM", 5.0), estimated("FQE", 6.0), warnings=("no propensity",))
    assert "allow no weighted estimate (no propensity)" in said
    assert "Models alone (no conclusion): DM 5 [4.9, 5.1] and FQE 6 [5.9, 6.1]." in said
    assert "The rows lack the return of the logged sessions" in of_logs(
        estimated("DR", 5.0), logged=False
    )
