"""Rows of several targets and seeds become one as their names say."""

from typing import Any

from tests.support.result_rows import result_row
from ucfrec_control.benchmark.seeds import average_seeds, select_best_target


def test_of_several_targets_the_best_in_the_mean_counts() -> None:
    scores = {1.0: (50.0, 10.0), 2.0: (20.0, 45.0), 3.0: (0.0, 49.0)}
    rows = [result_row(5.0, method="iql")]
    for target, seeds in scores.items():
        for seed, score in enumerate(seeds):
            rows.append(result_row(score, method="dt", training_seed=seed, target_return=target))
    kept = select_best_target(rows)
    assert [(row.target_return, row.value) for row in kept] == [(None, 5), (2, 20), (2, 45)]


def test_what_was_not_measured_is_a_dash() -> None:
    rows: list[dict[str, Any]] = [{"method": "dt", "score": 1.0, "other": None}]
    rows += [{"method": "dc", "score": 5.0}, {"method": "dt", "score": 3.0, "other": 4.0}]
    assert average_seeds(rows, ("method",), ("score", "other")) == [
        {"method": "dt", "score": "2 ± 1.4", "other": "4"},
        {"method": "dc", "score": "5", "other": "–"},
    ]
