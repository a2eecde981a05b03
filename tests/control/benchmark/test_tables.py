"""Printed tables of the control benchmarks are what their rows say."""

from typing import Any

import pytest

from tests.support.result_rows import result_row
from ucfrec.reporting.result_row import ResultRow
from ucfrec_control.benchmark.tables import (
    difference_table,
    of_best_target,
    over_seeds,
    score_table,
)


def scored(task: str, method: str, seed: int, score: float, **more: Any) -> ResultRow:
    fields = {"task": task, "method": method, "training_seed": seed, "checkpoint": "last"}
    return result_row(score, metric="score", **fields | more)


def test_a_table_of_scores_has_the_spread_over_seeds_and_a_mean_where_nothing_is_missing() -> None:
    scores = {
        ("dt", "a"): (10.0, 20.0), ("dt", "b"): (40.0, 50.0), ("iql", "a"): (30.0,),
    }  # fmt: skip
    rows = [
        scored(
            task,
            method,
            seed,
            score + shift,
            checkpoint=checkpoint,
            metrics={} if method == "iql" else {"best_step": 7.0},
        )
        for (method, task), seeds in scores.items()
        for seed, score in enumerate(seeds)
        for checkpoint, shift in (("last", 0.0), ("best", 1.0))
        if method != "iql" or checkpoint == "last"
    ]
    dt, iql = score_table(rows, "last")
    # Of 10 and 20 the standard error is 5.
    scores_of_dt = {"a": "15.0 ± 5", "b": "**45.0 ± 5**", "mean": "**30.0 ± 5**"}
    assert dt == {"method": "dt", "seeds": "2", **scores_of_dt}
    assert iql == {"method": "iql", "seeds": "1", "a": "**30.0**", "b": "–", "mean": "–"}
    best_dt, best_iql = score_table(rows, "best")
    assert best_dt["mean"] == "**31.0 ± 5**"
    assert best_iql == iql
    more = scored("a", "dt", 2, 18.0, checkpoint="last", metrics={"best_step": 7.0})
    assert score_table([*rows, more], "last")[0]["seeds"] == "2–3"


@pytest.mark.parametrize(("best", "near", "far"), [(100.0, 95.1, 94.9), (-10.0, -10.4, -10.6)])
def test_bold_is_what_comes_within_a_twentieth_of_the_best(
    best: float, near: float, far: float
) -> None:
    scores = {"a": best, "b": near, "c": far}
    found = score_table([scored("t", method, 0, s) for method, s in scores.items()], "last")
    assert [line["t"].startswith("**") for line in found] == [True, True, False]


def test_of_several_targets_the_best_in_the_mean_counts() -> None:
    scores = {1.0: (50.0, 10.0), 2.0: (20.0, 45.0), 3.0: (0.0, 49.0)}
    rows = [
        scored("t", "dt", seed, score, target_return=target)
        for target, seeds in scores.items()
        for seed, score in enumerate(seeds)
    ] + [scored("t", "iql", 0, 5.0)]
    kept = of_best_target(rows)
    assert [(row.method, row.target_return, row.value) for row in kept] == [
        ("dt", 2.0, 20.0), ("dt", 2.0, 45.0), ("iql", None, 5.0),
    ]  # fmt: skip


def test_what_was_not_measured_is_a_dash() -> None:
    rows = [
        {"method": "dt", "seed": 0, "score": 1.0, "other": None},
        {"method": "dc", "seed": 0, "score": 5.0},
        {"method": "dt", "seed": 1, "score": 3.0, "other": 4.0},
    ]
    found = over_seeds(rows, ("method",), ("score", "other"))
    assert [row["method"] for row in found] == ["dt", "dc"]
    assert [row["other"] for row in found] == ["4", "–"]
    mean, _, deviation = found[0]["score"].partition(" ± ")
    assert (float(mean), float(deviation)) == (2.0, pytest.approx(2**0.5, abs=0.05))


def test_methods_are_compared_seed_by_seed() -> None:
    scores = {
        ("none", "a"): (10.0, 50.0, 90.0), ("copies", "a"): (13.0, 51.0), ("lonely", "a"): (1.0,),
        ("none", "b"): (20.0, 20.0, 20.0), ("copies", "b"): (22.0, 26.0),
    }  # fmt: skip
    rows = [
        scored(task, method, seed, score)
        for (method, task), seeds in scores.items()
        for seed, score in enumerate(seeds)
    ]
    copies, lonely = difference_table(rows, "none")
    # Of 3 and 1, and of 2 and 6: their deviation over √2. In the mean over tasks 2.5 and 3.5.
    assert copies == {"method": "copies", "a": "+2 ± 1", "b": "+4 ± 2", "mean": "+3 ± 0.5"}
    assert lonely == {"method": "lonely", "a": "-9", "b": "–", "mean": "–"}
    more = scored("a", "copies", 2, 91.0)
    found = difference_table([*rows, more], "none")[0]
    assert found["mean"] == "+2.83", "no error where datasets differ in their seeds"
    assert difference_table(rows, "none", "unknown") == []
    assert difference_table(rows, "missing") == []
