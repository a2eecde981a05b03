"""Result rows of all measurements: what was measured, its numbers and their origin."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Annotated, Any, Final

from annotated_types import Ge, Lt
from pydantic import (
    AfterValidator,
    AllowInfNan,
    ConfigDict,
    Strict,
    TypeAdapter,
    ValidationError,
)

from ucfrec.errors import InputError

Text = Annotated[str, Strict()]
Number = Annotated[float, Strict(), AllowInfNan(False)]
Whole = Annotated[int, Strict()]


def plain(value: Any) -> Any:
    """`value` as JSON; numbers that are not finite are None."""
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _finite(value: Any) -> Any:
    if plain(value) != value:
        raise ValueError("every number should be finite")
    return value


Json = Annotated[Any, AfterValidator(_finite)]
Seed = Annotated[int, Strict(), Ge(0), Lt(2**63)]
Scalar = Text | Annotated[bool, Strict()] | Whole | Number | None


@dataclass(frozen=True, kw_only=True)
class RowKey:
    """Identifies a measurement; rows with equal keys are of the same one."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    suite: Text
    """Benchmark suite or command, e.g. recommendation, control, evaluate, off-policy."""
    table: Text
    """Table of the suite."""
    task: Text
    """Benchmark task or data file: the training data and the environment of the evaluation."""
    method: Text
    """Row of the table."""
    policy: Text
    """Policy that `method` uses: a trained one by its kind, or a built-in one of an environment."""
    training_seed: Seed | None = None
    log_seed: Seed | None = None
    """Seed of simulated logs; None for real logs."""
    evaluation_seed: Seed | None = None
    """Seed of the evaluated episodes; the same for every training seed."""
    conditions: Mapping[Text, Scalar] = field(default_factory=dict)
    """Other settings of the measurement: budget, episodes, distractor, …"""
    config_hash: Text | None = None
    """Hash of the training configuration, which `configurations.jsonl` holds."""
    data_fingerprint: Text | None = None
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

    metric: Text
    """Name of the metric that tables show."""
    metrics: Mapping[Text, Number]
    """Name to finite number, of the measured metrics only."""
    interval: tuple[Number, Number] | None = None
    """95% interval of the value of `metric`, over episodes."""
    environment: Text | None = None
    """Simulator of the evaluation."""
    checkpoint: Text | None = None
    """Evaluated weights, e.g. "best" or "last"."""
    target_return: Number | None = None
    """Target return of the evaluation, in reward units."""
    rule: Text | None = None
    """How the policy acts and how its target return was chosen, in words."""
    details: Mapping[Text, Json] = field(default_factory=dict)
    """JSON values other than metrics, e.g. the screening result of each dimension."""
    wall_time_s: Number | None = None
    """Wall time of the evaluation in seconds; that of the training is `train_wall_time_s`."""
    peak_memory_mib: Number | None = None
    """Peak resident memory of the process during the measurement, in MiB."""
    command: Text = ""
    commit: Text | None = None
    versions: Mapping[Text, Text] = field(default_factory=dict)

    @property
    def value(self) -> float:
        """Value of `metric`, which tables show."""
        return self.metrics[self.metric]

    def __getitem__(self, name: str) -> Any:
        """A field, condition, metric or end of the interval by its name, as in `as_line`."""
        return self.as_line()[name]

    def extended(self, values: Mapping[str, Any], **changes: Any) -> "ResultRow":
        """The row with further values: finite numbers are metrics, the rest that is not None are
        details.
        """
        metrics = {name: float(value) for name, value in values.items() if _is_number(value)}
        details = {
            name: plain(value)
            for name, value in values.items()
            if name not in metrics and plain(value) is not None
        }
        return replace(
            self,
            metrics={**self.metrics, **metrics},
            details={**self.details, **details},
            **changes,
        )

    def of(self, key: RowKey) -> "ResultRow":
        """The row as a measurement `key`, whose conditions are added to its own."""
        conditions = {**self.conditions, **key.conditions}
        return replace(self, **{**vars(key), "conditions": conditions})

    def as_line(self) -> dict[str, Any]:
        """Every field, condition and metric in one flat mapping, for tables and figures."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NESTED}
        low, high = self.interval or (None, None)
        ends = {f"{self.metric}_low": low, f"{self.metric}_high": high}
        return {**plain, **self.conditions, **ends, **self.metrics}

    def to_json(self) -> dict[str, Any]:
        """The row as JSON values, without fields at their default."""
        written = {}
        for f in fields(self):
            value = getattr(self, f.name)
            factory = f.default_factory
            default = f.default if factory is MISSING else factory()
            if value != default:
                written[f.name] = list(value) if isinstance(value, tuple) else value
        return written


_NESTED: Final = ("conditions", "metrics", "interval", "details", "versions")
_ROWS: Final = TypeAdapter(ResultRow)


def row_from_json(value: object, where: str) -> ResultRow:
    """Inverse of `ResultRow.to_json`.

    Args:
        where: origin of `value` (file and line), for messages.

    Raises:
        InputError: `value` is not an object, or a field is missing, unknown or of a wrong type.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where} is not a result row; delete it to measure it again")
    try:
        row = _ROWS.validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(f"{where} is not a result row: {place!r:.60}: {first['msg']}") from None
    except RecursionError:
        raise InputError(f"{where} is not a result row: it is nested too deeply") from None
    if row.metric not in row.metrics:
        raise InputError(f"{where} is not a result row: its metrics lack {row.metric!r:.60}")
    return row


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
