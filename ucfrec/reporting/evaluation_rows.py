"""Convert rows of `ucfrec evaluate` and `ucfrec demo` to result rows and back."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.reporting.estimate_rows import SUITE, as_estimate
from ucfrec.results.row import ResultRow, RowKey, row_from_json
from ucfrec.results.rows_file import read_lines

_NOT_METRICS: Final = (
    *("environment", "policy", "seed", "train_seed", "fingerprint", "config", "wall_time_s"),
    *("command", "commit", "versions", "target_return", "run", "checkpoint"),
    *("rule", "decision_rule"),
)
"""Keys of an evaluation row that are not statistics of its episodes."""


def evaluation_row(evaluation: Mapping[str, Any], key: RowKey, **more: Any) -> ResultRow:
    """Convert a row of `ucfrec.evaluation.evaluate` to the result row of a measurement.

    Args:
        evaluation: row with R_cum, its interval, the other metrics and their origin.
        key: the measurement.
        more: further fields of the result row; they override those of `evaluation`.
    """
    numbers = {k: v for k, v in evaluation.items() if k not in _NOT_METRICS and v is not None}
    low, high = numbers.pop("R_cum_low"), numbers.pop("R_cum_high")
    episodes = numbers.pop("episodes")
    given = vars(key) | {
        "conditions": {**key.conditions, "episodes": episodes},
        "metric": "R_cum",
        "metrics": numbers,
        "interval": (low, high),
        "environment": evaluation["environment"],
        "target_return": evaluation.get("target_return"),
        "rule": evaluation.get("rule"),
        **{name: evaluation[name] for name in ("wall_time_s", "command", "commit", "versions")},
    }
    return ResultRow(**given | more)


def as_evaluation(row: ResultRow) -> dict[str, Any]:
    """A result row with the keys of `ucfrec evaluate --json`; `seed` is the evaluation seed."""
    return {
        **row.as_line(),
        "environment": row.environment or row.task,
        "policy": row.method,
        "seed": row.evaluation_seed,
        "train_seed": row.training_seed,
        "fingerprint": row.data_fingerprint,
        "config": row.config_hash,
        "versions": dict(row.versions),
    }


def read_evaluations(path: Path) -> list[Any]:
    """Read rows with the keys of `ucfrec evaluate --json`; their values are not checked.

    Args:
        path: JSON of `ucfrec evaluate` or `ucfrec demo`, or JSON lines (.jsonl) of such rows or of
            result rows.

    Raises:
        InputError: the file is missing, is not JSON, or does not hold a list.
    """
    if path.suffix == ".jsonl" and path.exists():
        return [_evaluation(value, f"{path}, line {n}") for n, value in read_lines(path)]
    rows = read_json(path)
    if isinstance(rows, list):
        rows = [_evaluation(value, f"{path}, row {n}") for n, value in enumerate(rows, start=1)]
    if not isinstance(rows, list):
        raise InputError(
            f"{path} holds no list of result rows; give a file that `ucfrec evaluate` wrote"
        )
    return rows


def _evaluation(value: object, where: str) -> object:
    if isinstance(value, dict) and "suite" in value:
        row = row_from_json(value, where)
        return as_estimate(row) if row.suite == SUITE else as_evaluation(row)
    return value
