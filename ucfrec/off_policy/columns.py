"""Result rows of estimates, and the verdict and diagnosis as their columns."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from ucfrec.acting.decision import DecisionRule
from ucfrec.off_policy.diagnostics import Diagnosis
from ucfrec.off_policy.estimators import LOGGED, Estimate
from ucfrec.off_policy.verdict import Verdict
from ucfrec.provenance import config_hash, provenance
from ucfrec.results.row import ResultRow, Scalar
from ucfrec.runs.trained_policy import TrainedPolicy

SUITE: Final = "off-policy"
"""Suite of the rows."""


@dataclass(frozen=True)
class Subject:
    """What the rows of one evaluation share."""

    trained: TrainedPolicy
    """The evaluated policy."""
    rule: DecisionRule
    """By which it would act."""
    seed: int
    """Of the estimates."""
    fingerprint: str | None
    """Of the logs."""
    conditions: Mapping[str, Scalar]
    """How the logs were read."""
    about: Mapping[str, Any]
    """Further columns, e.g. the verdict."""

    def rows(self, found: Mapping[str, Estimate], per_step: bool = False) -> list[ResultRow]:
        """The result rows of estimates by name of the estimator, which is the row's method.

        `R_cum` is the mean return, as in `ucfrec.evaluation.session_metrics`, and `R_step` the
        mean reward of a step; a row may have no interval.

        Args:
            per_step: whether the estimates are of `step_value`.
        """
        return [self._row(name, one, per_step) for name, one in found.items()]

    def _row(self, name: str, found: Estimate, per_step: bool) -> ResultRow:
        metric, units = ("R_step", "steps") if per_step else ("R_cum", "sessions")
        choice = "softmax" if self.rule.draws else "greedy"
        logged, record = name == LOGGED, self.trained.record
        row = ResultRow(
            suite=SUITE,
            table="per step" if per_step else "estimates",
            task="logs",
            method=name,
            policy="behavior" if logged else self.trained.name,
            training_seed=record.seed,
            evaluation_seed=self.seed,
            conditions={**self.conditions, "choice": "as logged" if logged else choice},
            config_hash=config_hash(record.settings),
            data_fingerprint=self.fingerprint,
            metric=metric,
            metrics={metric: found.value},
            interval=None if found.low is None or found.high is None else (found.low, found.high),
            target_return=self.rule.target,
            rule=self.rule.hash,
            **provenance(),
        )
        own = {
            f"{metric}_error": found.error,
            f"effective_{units}": found.effective_sessions,
            "largest_weight": found.largest_weight,
            "parameter": found.parameter,
            "decision_rule": self.rule.as_dict(),
        }
        return row.extended({**own, **self.about})


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
        "unsupported_from_step": diagnosis.unsupported_from_step,
        "weight_tests": [asdict(test) for test in diagnosis.tests],
        "mean_weight": diagnosis.mean_weight,
        "pareto_tail": diagnosis.tail,
        "bounds": None if diagnosis.bounds is None else list(diagnosis.bounds),
    }
