"""The one kind of result row: what was measured, of what, by which code, and what came of it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Final

from ucfrec.errors import InputError

Scalar = str | int | float | bool | None


@dataclass(frozen=True, kw_only=True)
class RowKey:
    """What is measured: rows that agree in it, code version included, are the same measurement."""

    suite: str
    """The benchmark, e.g. recommendation, control, robustness, step-time."""
    table: str
    task: str
    """Benchmark task or data file: what is learned from, and what that is played in."""
    method: str
    """Line of the table."""
    policy: str
    """The learner, or the built-in policy of a world, that `method` is made of."""
    training_seed: int | None = None
    log_seed: int | None = None
    """Of simulated logs; None where logs are given."""
    evaluation_seed: int | None = None
    """Of the episodes that are reported; the same for every training seed."""
    conditions: Mapping[str, Scalar] = field(default_factory=dict)
    """Whatever else tells measurements apart: budget, episodes, distractor, …"""
    config_hash: str | None = None
    """Of the training's configuration; what it stands for lies in `configurations.jsonl`."""
    code_version: str | None = None
    """See `ucfrec.code_version`; None of rows from before rows had one."""
    data_fingerprint: str | None = None
    """Of the store."""

    def covers(self, row: "ResultRow") -> bool:
        """Whether `row` is of this measurement; it may have further conditions of its own."""
        own = {name: getattr(self, name) for name in _KEY_FIELDS}
        return all(getattr(row, name) == value for name, value in own.items()) and all(
            name in row.conditions and row.conditions[name] == value
            for name, value in self.conditions.items()
        )


_KEY_FIELDS: Final = tuple(f.name for f in fields(RowKey) if f.name != "conditions")


@dataclass(frozen=True, kw_only=True)
class ResultRow(RowKey):
    """One measurement and its numbers. A line of a rows file is this as JSON, less the defaults."""

    metric: str
    """The one of `metrics` that tables are about."""
    metrics: Mapping[str, float]
    """Finite numbers by name; what was not measured is not there."""
    interval: tuple[float, float] | None = None
    """95% interval of the value of `metric`, over episodes."""
    world: str | None = None
    """Where the policy was played."""
    checkpoint: str | None = None
    target_return: float | None = None
    rule: str | None = None
    """How the policy acts and how its target return was chosen, in words."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """JSON beyond numbers, e.g. what a screening says of every dimension."""
    wall_time_s: float | None = None
    """Of the evaluation; that of the training is the metric `train_wall_time_s`."""
    peak_memory_mib: float | None = None
    """Most resident memory of the process while the row's cell was measured."""
    command: str = ""
    commit: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def value(self) -> float:
        """The number that tables are about."""
        return self.metrics[self.metric]

    def as_line(self) -> dict[str, Any]:
        """Every field, condition and metric in one flat mapping, for tables and pictures."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NESTED}
        low, high = self.interval or (None, None)
        ends = {f"{self.metric}_low": low, f"{self.metric}_high": high}
        return {**own, **self.conditions, **ends, **self.metrics}

    def to_json(self) -> dict[str, Any]:
        """The row as JSON has it; fields at their default are left out."""
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
    """The row that `to_json` made into `value`.

    Args:
        where: what `value` was read from, for messages.

    Raises:
        InputError: it is no mapping, or a field is missing, unknown or of another kind.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where} is no result row; delete it to measure it again")
    if unknown := sorted(set(map(str, value)) - _READERS.keys()):
        raise InputError(f"{where} is no result row: it has an unknown field {unknown[0]!r}")
    if lacking := [name for name in _REQUIRED if name not in value]:
        raise InputError(f"{where} is no result row: it has no {lacking[0]}")
    given: dict[str, Any] = {}
    for name, found in value.items():
        try:
            given[name] = _READERS[name](found)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{where} is no result row: its {name} is {found!r:.60}") from None
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
    if not math.isfinite(found := float(value)):
        raise ValueError
    return found


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
    """JSON in which every number is finite."""
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
    **dict.fromkeys(("config_hash", "code_version", "data_fingerprint"), _optional(_text)),
    **dict.fromkeys(("world", "checkpoint", "rule", "commit"), _optional(_text)),
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
