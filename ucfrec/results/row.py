"""Result rows of all benchmarks: the measurement, its numbers and their origin."""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Final

from ucfrec.errors import InputError

Scalar = str | int | float | bool | None


@dataclass(frozen=True, kw_only=True)
class RowKey:
    """Identifies a measurement; rows with equal keys are of the same one."""

    suite: str
    """The benchmark suite, e.g. recommendation, control, robustness, step-time."""
    table: str
    """Table of the suite."""
    task: str
    """Benchmark task or data file: the training data and the environment of the evaluation."""
    method: str
    """Row of the table."""
    policy: str
    """Learner, or built-in policy of an environment, that `method` uses."""
    training_seed: int | None = None
    log_seed: int | None = None
    """Seed of simulated logs; None for real logs."""
    evaluation_seed: int | None = None
    """Seed of the evaluated episodes; the same for every training seed."""
    conditions: Mapping[str, Scalar] = field(default_factory=dict)
    """Other settings of the measurement: budget, episodes, distractor, …"""
    config_hash: str | None = None
    """Hash of the training configuration, which `configurations.jsonl` holds."""
    data_fingerprint: str | None = None
    """Fingerprint of the store."""

    def covers(self, row: "ResultRow") -> bool:
        """Whether `row` is of this measurement; `row` may have more conditions."""
        values = {name: getattr(self, name) for name in _KEY_FIELDS}
        return all(getattr(row, name) == value for name, value in values.items()) and all(
            name in row.conditions and row.conditions[name] == value
            for name, value in self.conditions.items()
        )


_KEY_FIELDS: Final = tuple(f.name for f in fields(RowKey) if f.name != "conditions")


@dataclass(frozen=True, kw_only=True)
class ResultRow(RowKey):
    """One measurement and its numbers; a line of a file of result rows is its `to_json`."""

    metric: str
    """Name of the metric that tables show."""
    metrics: Mapping[str, float]
    """Name to finite number, of the measured metrics only."""
    interval: tuple[float, float] | None = None
    """95% interval of the value of `metric`, over episodes."""
    environment: str | None = None
    """Simulator of the evaluation."""
    checkpoint: str | None = None
    """Evaluated weights, e.g. "best" or "last"."""
    target_return: float | None = None
    """Target return of the evaluation, in reward units."""
    rule: str | None = None
    """How the policy acts and how its target return was chosen, in words."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """JSON values other than metrics, e.g. the screening result of each dimension."""
    wall_time_s: float | None = None
    """Wall time of the evaluation in seconds; that of the training is `train_wall_time_s`."""
    peak_memory_mib: float | None = None
    """Peak resident memory of the process during the measurement, in MiB."""
    command: str = ""
    commit: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def value(self) -> float:
        """Value of `metric`, which tables show."""
        return self.metrics[self.metric]

    def as_line(self) -> dict[str, Any]:
        """Every field, condition and metric in one flat mapping, for tables and figures."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NESTED}
        low, high = self.interval or (None, None)
        ends = {f"{self.metric}_low": low, f"{self.metric}_high": high}
        return {**plain, **self.conditions, **ends, **self.metrics}

    def to_json(self) -> dict[str, Any]:
        """The row as JSON values, without fields at their default."""
        written = {}
        for each in fields(self):
            value = getattr(self, each.name)
            factory = each.default_factory
            default = each.default if factory is MISSING else factory()
            if value != default:
                written[each.name] = list(value) if isinstance(value, tuple) else value
        return written


_NESTED: Final = ("conditions", "metrics", "interval", "details", "versions")


def row_from_json(value: object, where: str) -> ResultRow:
    """Inverse of `ResultRow.to_json`.

    Args:
        value: JSON value.
        where: origin of `value` (file and line), for messages.

    Raises:
        InputError: `value` is no object, or a field is missing, unknown or of a wrong type.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where} is no result row; delete it to measure it again")
    if unknown := sorted(set(map(str, value)) - _READERS.keys()):
        raise InputError(f"{where} is no result row: it has an unknown field {unknown[0]!r}")
    if lacking := [name for name in _REQUIRED if name not in value]:
        raise InputError(f"{where} is no result row: it has no {lacking[0]}")
    given: dict[str, Any] = {}
    for name, content in value.items():
        try:
            given[name] = _READERS[name](content)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{where} is no result row: its {name} is {content!r:.60}") from None
    row = ResultRow(**given)
    if row.metric not in row.metrics:
        raise InputError(f"{where} is no result row: its metrics lack {row.metric!r:.60}")
    return row


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value


def _seed(value: object) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError
    return value


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError
    if not math.isfinite(number := float(value)):
        raise ValueError
    return number


def _scalar(value: object) -> Scalar:
    if value is None or isinstance(value, (str, bool)):
        return value
    return value if isinstance(value, int) and abs(value) < 2**63 else _number(value)


def _interval(value: object) -> tuple[float, float]:
    if not isinstance(value, list):
        raise TypeError
    low, high = map(_number, value)
    return low, high


def _json(value: object) -> object:
    """Check that every number of a JSON value is finite."""
    if isinstance(value, list):
        return [_json(item) for item in value]
    if isinstance(value, dict):
        return {_text(name): _json(item) for name, item in value.items()}
    return _scalar(value)


def _mapping(read: Callable[[object], object]) -> Callable[[object], dict[str, object]]:
    def read_all(value: object) -> dict[str, object]:
        if not isinstance(value, dict):
            raise TypeError
        return {_text(name): read(item) for name, item in value.items()}

    return read_all


def _optional(read: Callable[[object], object]) -> Callable[[object], object]:
    return lambda value: None if value is None else read(value)


_READERS: Final[Mapping[str, Callable[[object], object]]] = {
    **dict.fromkeys(("suite", "table", "task", "method", "policy", "metric", "command"), _text),
    **dict.fromkeys(("training_seed", "log_seed", "evaluation_seed"), _optional(_seed)),
    **dict.fromkeys(("config_hash", "data_fingerprint"), _optional(_text)),
    **dict.fromkeys(("environment", "checkpoint", "rule", "commit"), _optional(_text)),
    **dict.fromkeys(("target_return", "wall_time_s", "peak_memory_mib"), _optional(_number)),
    "conditions": _mapping(_scalar),
    "metrics": _mapping(_number),
    "interval": _optional(_interval),
    "details": _mapping(_json),
    "versions": _mapping(_text),
}
_REQUIRED: Final = tuple(
    f.name for f in fields(ResultRow) if f.default is MISSING and f.default_factory is MISSING
)
