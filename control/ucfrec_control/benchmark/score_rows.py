"""What `ucfrec-control evaluate` measured, as result rows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.reporting.result_row import ResultRow, RowKey, row_from_json
from ucfrec.reporting.rows_file import read_rows

EVALUATE: Final = "evaluate"
"""The suite of rows that come from `evaluate --json`."""
_METRICS: Final = (
    *("score", "score_std", "return", "length", "steps", "best_step", "validation_loss"),
    *("acceptance", "train_wall_time_s"),
)
_CONDITIONS: Final = ("episodes", "distractor_fixed_to", "lambda_mask")
_DETAILS: Final = ("distractors", "dataset_versions", "warnings")


def score_row(found: Mapping[str, Any], key: RowKey, **more: Any) -> ResultRow:
    """A row of `ucfrec_control.learners.evaluate.evaluate_run` as that of a measurement.

    Args:
        more: further fields of the row, of which `metrics` and `details` are added to its own.
    """
    conditions = {**key.conditions, **_known(found, _CONDITIONS)}
    metrics = _known(found, _METRICS) | more.pop("metrics", {})
    details = _known(found, _DETAILS) | more.pop("details", {})
    given = vars(key) | {
        "conditions": conditions,
        "metric": "score",
        "metrics": {name: float(value) for name, value in metrics.items()},
        "interval": (found["score_low"], found["score_high"]),
        "world": found["env_id"],
        "checkpoint": found["checkpoint"],
        "target_return": found["target_return"],
        "details": {name: value for name, value in details.items() if value},
        "wall_time_s": found["wall_time_s"],
    }
    return ResultRow(**given | more)


def read_scores(path: Path) -> list[ResultRow]:
    """Rows of a benchmark (`.jsonl`), or of `ucfrec-control evaluate --json` (`.json`).

    Raises:
        InputError: the file is missing or holds something else.
    """
    if path.suffix != ".json":
        return read_rows(path)
    rows = read_json(path)
    if not isinstance(rows, list):
        raise InputError(
            f"{path} holds no list of rows; `ucfrec-control evaluate --json` makes one"
        )
    return [_evaluated(row, f"{path}, row {n}") for n, row in enumerate(rows, start=1)]


def _evaluated(found: object, where: str) -> ResultRow:
    try:
        assert isinstance(found, dict)
        key = RowKey(
            suite=EVALUATE,
            table=EVALUATE,
            task=found["dataset"],
            method=found["method"],
            policy=found["config"]["policy_name"],
            training_seed=found["seed"],
            evaluation_seed=found["evaluation_seed"],
            config_hash=found["config_hash"],
            data_fingerprint=found["fingerprint"],
        )
        row = score_row(found, key).to_json()
    except (AssertionError, AttributeError, KeyError, TypeError, ValueError):
        raise InputError(
            f"{where}, is none of `ucfrec-control evaluate --json`; measure it again"
        ) from None
    return row_from_json(row, where)


def _known(found: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: found[name] for name in names if found.get(name) is not None}
