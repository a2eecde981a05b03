"""Rows of `ope` as result rows, and back."""

import json
import math

import pytest

from ucfrec.reporting.estimate_rows import as_estimate, estimate_row
from ucfrec.results.row import row_from_json

ROW = {
    "estimator": "DR", "policy": "ucf", "choice": "softmax", "R_cum": 3.5, "R_cum_low": 3.0,
    "R_cum_high": 4.0, "R_cum_error": 0.25, "parameter": None, "target_return": 7.0,
    "discount": 0.9, "pages": False, "sessions": 600, "steps": 1800, "overlap": 1.01,
    "warnings": ["few users"], "verdict": "Do not rely on this estimate", "reliable": False,
    "weight_tests": [{"name": "step 1", "mean": math.inf, "error": 0.1, "passed": False}],
    "bounds": [0.0, math.nan], "pareto_tail": math.nan, "run": "/home/me/runs/ucf", "seed": 3,
    "rule": "0123456789ab", "decision_rule": {"target": 7.0, "temperature": 1.0},
    "fingerprint": "abc", "checkpoint": "best", "command": "ucfrec ope", "commit": None,
    "versions": {"python": "3.11"},
}  # fmt: skip


def test_a_row_goes_to_json_and_back() -> None:
    row = estimate_row(ROW, training_seed=1, config_hash="c0ffee")
    assert (row.suite, row.method, row.value, row.interval) == ("off-policy", "DR", 3.5, (3.0, 4.0))
    assert row.conditions["run"] == "ucf"  # no path of any machine
    assert row.conditions["discount"] == 0.9
    assert row.metrics["overlap"] == 1.01
    assert "pareto_tail" not in row.metrics
    again = row_from_json(json.loads(json.dumps(row.to_json(), allow_nan=False)), "here")
    assert again == row
    found = as_estimate(again)
    changed = {"run", "parameter", "weight_tests", "bounds", "pareto_tail"}
    for name in ROW.keys() - changed:
        assert found[name] == ROW[name], name
    assert found["weight_tests"][0]["mean"] is None


@pytest.mark.parametrize("name", ["R_cum_low", "R_cum_high"])
def test_an_estimate_may_have_no_interval(name: str) -> None:
    open_ended = ROW | {"R_cum_low": None, "R_cum_high": None}
    row = estimate_row(open_ended, training_seed=1, config_hash="c0ffee")
    assert row.interval is None
    assert as_estimate(row)[name] is None
