"""What `ucfrec evaluate` and the demo measured, as result rows and back."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.reporting.result_row import ResultRow, RowKey, row_from_json
from ucfrec.reporting.rows_file import read_lines

_ABOUT: Final = (
    *("world", "policy", "seed", "train_seed", "fingerprint", "config", "wall_time_s"),
    *("command", "commit", "versions", "target_return", "run", "checkpoint"),
)
"""Keys of an evaluation that are no numbers of its episodes."""


def evaluation_row(found: Mapping[str, Any], key: RowKey, **more: Any) -> ResultRow:
    """A row of `ucfrec.evaluation.evaluate` as the result row of a measurement.

    Args:
        more: further fields of the row, or others than `found` has.
    """
    numbers = {k: v for k, v in found.items() if k not in _ABOUT and v is not None}
    low, high = numbers.pop("R_cum_low"), numbers.pop("R_cum_high")
    episodes = numbers.pop("episodes")
    given = vars(key) | {
        "conditions": {**key.conditions, "episodes": episodes},
        "metric": "R_cum",
        "metrics": numbers,
        "interval": (low, high),
        "world": found["world"],
        "target_return": found.get("target_return"),
        **{name: found[name] for name in ("wall_time_s", "command", "commit", "versions")},
    }
    return ResultRow(**given | more)


def as_evaluation(row: ResultRow) -> dict[str, Any]:
    """A result row with the keys of `ucfrec evaluate --json`: `seed` is that of the evaluation."""
    return {
        **row.as_line(),
        "world": row.world or row.task,
        "policy": row.method,
        "seed": row.evaluation_seed,
        "train_seed": row.training_seed,
        "fingerprint": row.data_fingerprint,
        "config": row.config_hash,
        "versions": dict(row.versions),
    }


def read_evaluations(path: Path) -> list[Any]:
    """Rows with the keys of `ucfrec evaluate --json`, from its JSON, the demo's, JSON lines of such
    rows, or a file of result rows; what else their values are is not looked at.

    Raises:
        InputError: the file is missing or holds no list.
    """
    if path.suffix == ".jsonl" and path.exists():
        return [_evaluation(value, f"{path}, line {n}") for n, value in read_lines(path)]
    rows = read_json(path)
    if not isinstance(rows, list):
        raise InputError(f"{path} holds no list of result rows; give what `ucfrec evaluate` wrote")
    return rows


def _evaluation(value: object, where: str) -> object:
    if isinstance(value, dict) and "suite" in value:
        return as_evaluation(row_from_json(value, where))
    return value
