"""Tables of the benchmarks are what their rows say."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from tests.support.result_rows import distractor_rows, result_row
from ucfrec.benchmark.tables import difference_table, distractor_table, method_table, score_table
from ucfrec.results.rows import ResultRow


def scored(task: str, method: str, seed: int, score: float, **more: Any) -> ResultRow:
    fields = {"task": task, "method": method, "training_seed": seed, "checkpoint": "last"}
    return result_row(score, metric="score", **fields | more)


def test_a_table_of_scores_has_the_spread_over_seeds_and_a_mean_where_nothing_is_missing() -> None:
    scores = {
        ("dt", "a"): (10.0, 20.0), ("dt", "b"): (40.0, 50.0), ("iql", "a"): (30.0,),
    }  # fmt: skip
    rows, kept = [], {"best_step": 7.0}
    for (method, task), seeds in scores.items():
        for seed, score in enumerate(seeds):
            last = scored(task, method, seed, score, metrics=kept if method == "dt" else {})
            best = scored(task, method, seed, score + 1, checkpoint="best", metrics=kept)
            rows += [last, best] if method == "dt" else [last]
    dt, iql = score_table(rows, "last")
    # Of 10 and 20 the standard error is 5.
    scores_of_dt = {"a": "15.0 ± 5", "b": "**45.0 ± 5**", "mean": "**30.0 ± 5**"}
    assert dt == {"method": "dt", "seeds": "2", **scores_of_dt}
    assert iql == {"method": "iql", "seeds": "1", "a": "**30.0**", "b": "–", "mean": "–"}
    best_dt, best_iql = score_table(rows, "best")
    assert best_dt["mean"] == "**31.0 ± 5**"
    assert best_iql == iql
    more = scored("a", "dt", 2, 18.0, metrics=kept)
    assert score_table([*rows, more], "last")[0]["seeds"] == "2–3"


@pytest.mark.parametrize("scores", [(100.0, 95.1, 94.9), (-10.0, -10.4, -10.6)])
def test_bold_is_what_comes_within_a_twentieth_of_the_best(scores: tuple[float, ...]) -> None:
    rows = [scored("t", method, 0, score) for method, score in zip("abc", scores, strict=True)]
    bold = [line["t"].startswith("**") for line in score_table(rows, "last")]
    assert bold == [True, True, False]


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


def test_tables_give_means_spreads_and_paired_drops() -> None:
    every = distractor_rows({None: (10.0, 20.0), 0.0: (5.0, 15.0), 1.0: (8.0, 16.0)})
    clean = [r for r in every if r.conditions == {"distractor": None, "quantiles": "1"}]
    last = replace(clean[0], checkpoint="last", metrics={"R_cum": 99.0})
    line = method_table([*clean, last]).splitlines()[2]
    assert line == "| w | m | 2 | 15 ± 7.1 | 0.5 ± 0 | 0.5 ± 0 | 2 ± 0 | – | 3 | – | – |"
    line, less = distractor_table(every).splitlines()[2:]
    assert less == line.replace("| 1 |", "| 0.99 |")
    assert line == "| w | 1 | m | 2 | 15 ± 7.1 | 10 ± 7.1 | 12 ± 5.7 | 37.5 ± 18 |"
    # Seed 0 of another log is another pair: drops of 50, 25 and −100%.
    other = distractor_rows({None: (30.0,), 0.0: (60.0,), 1.0: (40.0,)})
    both = [*every, *(replace(row, log_seed=1) for row in other)]
    line = distractor_table(both).splitlines()[2]
    assert line.endswith("| 3 | 20 ± 10 | 26.67 ± 29 | 21.33 ± 17 | -8.333 ± 80 |")


def test_methods_are_compared_with_ucf_by_log_and_seed() -> None:
    def rows(method: str, values: Mapping[tuple[int | None, int | None], float]) -> list[ResultRow]:
        return [
            result_row(value, method=method, log_seed=log, training_seed=seed)
            for (log, seed), value in values.items()
        ]

    ours = {(0, 0): 10.0, (0, 1): 12.0, (1, 0): 20.0, (1, 1): 22.0}
    other = {(0, 0): 9.0, (0, 1): 10.0, (1, 0): 15.0, (1, 1): 16.0, (1, 2): 99.0}
    given = [*rows("random", {(None, None): 1.0}), *rows("dt", other), *rows("ucf", ours)]
    random, dt, ucf = (line.split(" | ")[-1] for line in method_table(given).splitlines()[2:])
    # −1, −2, −5, −6; of the logs −1.5 and −5.5.
    assert dt == "-3.5 ± 1.2 (2) |"
    # UCF's values less 1: ± their standard error.
    assert random == "-15 ± 2.9 (5) |"
    assert ucf == "– |"
    one = method_table([*rows("dt", {(0, 0): 9.0}), *rows("ucf", ours)]).splitlines()[2]
    assert one.endswith("| -1 |")
    assert method_table(rows("dt", other)).endswith("| – |")
