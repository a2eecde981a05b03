"""Results of `ucfrec-control evaluate` as result rows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.reporting.result_row import ResultRow, RowKey, row_from_json
from ucfrec.reporting.rows_file import read_rows

EVALUATE: Final = "evaluate"
"""Suite of the rows of `evaluate --json`."""
_METRICS: Final = (
    *("score", "score_std", "return", "length", "steps", "best_step", "validation_loss"),
    *("acceptance", "train_wall_time_s"),
)
_CONDITIONS: Final = ("episodes", "distractor_fixed_to", "lambda_mask")
_DETAILS: Final = ("distractors", "dataset_versions", "warnings")


def score_row(evaluation: Mapping[str, Any], key: RowKey, **fields: Any) -> ResultRow:
    """Convert a row of `ucfrec_control.training.evaluate.evaluate_run` to a result row.

    Args:
        evaluation: the row of `evaluate_run`.
        key: key of the result row.
        fields: further fields; `metrics` and `details` are added to those of `evaluation`.
    """
    conditions = {**key.conditions, **_values(evaluation, _CONDITIONS)}
    metrics = _values(evaluation, _METRICS) | fields.pop("metrics", {})
    details = _values(evaluation, _DETAILS) | fields.pop("details", {})
    row = vars(key) | {
        "conditions": conditions,
        "metric": "score",
        "metrics": {name: float(value) for name, value in metrics.items()},
        "interval": (evaluation["score_low"], evaluation["score_high"]),
        "environment": evaluation["env_id"],
        "checkpoint": evaluation["checkpoint"],
        "target_return": evaluation["target_return"],
        "rule": evaluation.get("rule"),
        "details": {name: value for name, value in details.items() if value},
        "wall_time_s": evaluation["wall_time_s"],
    }
    return ResultRow(**row | fields)


def read_scores(path: Path) -> list[ResultRow]:
    """Rows of a benchmark (`.jsonl`), or of `ucfrec-control evaluate --json` (`.json`).

    Raises:
        InputError: the file is missing or has other content.
    """
    if path.suffix != ".json":
        if not path.exists():
            raise InputError(f"{path} does not exist; check the path")
        return read_rows(path)
    rows = read_json(path)
    if not isinstance(rows, list):
        raise InputError(
            f"{path} is not a list of rows; write one with `ucfrec-control evaluate --json`"
        )
    return [_evaluated(row, f"{path}, row {n}") for n, row in enumerate(rows, start=1)]


def _evaluated(evaluation: object, where: str) -> ResultRow:
    try:
        assert isinstance(evaluation, dict)
        key = RowKey(
            suite=EVALUATE,
            table=EVALUATE,
            task=evaluation["dataset"],
            method=evaluation["method"],
            policy=evaluation["config"]["policy_name"],
            training_seed=evaluation["seed"],
            evaluation_seed=evaluation["evaluation_seed"],
            config_hash=evaluation["config_hash"],
            data_fingerprint=evaluation["fingerprint"],
        )
        row = score_row(evaluation, key).to_json()
    except (AssertionError, AttributeError, KeyError, TypeError, ValueError, OverflowError):
        raise InputError(
            f"{where}, is not a row of `ucfrec-control evaluate --json`; evaluate the run again"
        ) from None
    return row_from_json(row, where)


def _values(evaluation: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: evaluation[name] for name in names if evaluation.get(name) is not None}
