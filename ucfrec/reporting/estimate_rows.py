"""Convert rows of `ucfrec ope` to result rows and back."""

import math
from collections.abc import Mapping
from typing import Any, Final

from ucfrec.provenance import without_folders
from ucfrec.results.row import ResultRow

SUITE: Final = "off-policy"
_FIELDS: Final = (
    *("estimator", "policy", "choice", "seed", "fingerprint", "checkpoint", "target_return"),
    *("R_cum_low", "R_cum_high", "command", "commit", "versions", "rule"),
)
"""Keys of an estimate's row that are fields of the result row."""
_CONDITIONS: Final = ("run", "discount", "pages", "anonymous", "sessions", "steps")


def estimate_row(estimate: Mapping[str, Any], *, training_seed: int, config_hash: str) -> ResultRow:
    """Convert a row of `ucfrec.off_policy.evaluate` to a result row.

    Numbers become metrics; whatever else the row has, the verdict first of all, becomes details.

    Args:
        estimate: the row, with `checkpoint`.
        training_seed: of the run.
        config_hash: of the run's configuration.
    """
    others = {
        name: value
        for name, value in estimate.items()
        if name not in (*_FIELDS, *_CONDITIONS) and value is not None
    }
    metrics = {name: float(value) for name, value in others.items() if _is_number(value)}
    low, high = estimate["R_cum_low"], estimate["R_cum_high"]
    conditions = {name: estimate[name] for name in _CONDITIONS if name in estimate}
    if "run" in conditions:
        conditions["run"] = without_folders(conditions["run"])
    return ResultRow(
        suite=SUITE,
        table="estimates",
        task="logs",
        method=estimate["estimator"],
        policy=estimate["policy"],
        training_seed=training_seed,
        evaluation_seed=estimate["seed"],
        conditions={**conditions, "choice": estimate["choice"]},
        config_hash=config_hash,
        data_fingerprint=estimate["fingerprint"],
        metric="R_cum",
        metrics=metrics,
        interval=None if low is None else (low, high),
        checkpoint=estimate["checkpoint"],
        target_return=estimate["target_return"],
        rule=estimate["rule"],
        details={name: _plain(value) for name, value in others.items() if name not in metrics},
        command=estimate["command"],
        commit=estimate["commit"],
        versions=estimate["versions"],
    )


def as_estimate(row: ResultRow) -> dict[str, Any]:
    """A result row with the keys of a row of `ucfrec.off_policy.evaluate`."""
    return {
        **row.details,
        **row.as_line(),
        "estimator": row.method,
        "seed": row.evaluation_seed,
        "fingerprint": row.data_fingerprint,
        "versions": dict(row.versions),
    }


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _plain(value: Any) -> Any:
    """JSON without numbers that are not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(name): _plain(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value
