"""Estimates, verdict and diagnosis as columns of result rows."""

import math
from dataclasses import asdict
from typing import Any

from ucfrec.off_policy.diagnostics import Diagnosis
from ucfrec.off_policy.estimators import Estimate
from ucfrec.off_policy.verdict import Verdict


def as_row(name: str, found: Estimate) -> dict[str, Any]:
    """Turn an estimate into a result row.

    Args:
        name: name of the estimator.
        found: its estimate.

    Returns:
        The row. `R_cum` is the mean return, as in `ucfrec.evaluation.metrics`; the ends of its
        interval are None if there is no interval.
    """
    return {
        "estimator": name,
        "R_cum": found.value,
        "R_cum_low": found.low,
        "R_cum_high": found.high,
        "R_cum_error": found.error,
        "effective_sessions": found.effective_sessions,
        "largest_weight": found.largest_weight,
        "parameter": found.parameter if found.parameter != math.inf else None,
    }


def verdict_columns(verdict: Verdict) -> dict[str, Any]:
    """The verdict's fields by name, without its reasons, and its text."""
    columns = asdict(verdict) | {"verdict": str(verdict), "verdict_of": verdict.estimator}
    return {name: value for name, value in columns.items() if name not in ("estimator", "reasons")}


def diagnosis_columns(diagnosis: Diagnosis) -> dict[str, Any]:
    """What speaks against the estimates, by name."""
    return {
        "overlap": diagnosis.overlap,
        "users": diagnosis.users,
        "sessions_without_propensity": diagnosis.left_out,
        "effective_users": diagnosis.effective_users,
        "effective_by_step": list(diagnosis.effective_by_step),
        "stops_telling_at": diagnosis.stops_telling_at,
        "weight_tests": [asdict(test) for test in diagnosis.tests],
        "mean_weight": diagnosis.mean_weight,
        "pareto_tail": diagnosis.tail,
        "bounds": None if diagnosis.bounds is None else list(diagnosis.bounds),
    }
