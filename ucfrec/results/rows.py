"""Result rows of all measurements: what was measured, its numbers and their origin. They are lines
of JSON in files that several processes may append to, and a table in Python."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from annotated_types import Ge, Lt
from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError

from ucfrec.errors import InputError
from ucfrec.files import atomic

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from ucfrec.results.charts import Interval


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
Seed = Annotated[int, Ge(0), Lt(2**63)]
Scalar = str | bool | int | float | None


@dataclass(frozen=True, kw_only=True)
class RowKey:
    """Identifies a measurement: rows with equal keys belong to the same one."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    suite: str
    """Benchmark suite or command, e.g. recommendation, control, evaluate, off-policy."""
    table: str
    """Table of the suite."""
    task: str
    """Benchmark task or data file: the training data and the environment of the evaluation."""
    method: str
    """Row of the table."""
    policy: str
    """Policy that `method` uses: a trained one by its kind, or a built-in one of an environment."""
    training_seed: Seed | None = None
    log_seed: Seed | None = None
    """Seed of simulated logs; None for real logs."""
    evaluation_seed: Seed | None = None
    """Seed of the evaluated episodes; the same for every training seed."""
    conditions: Mapping[str, Scalar] = field(default_factory=dict)
    """Other settings of the measurement: budget, episodes, distractor, …"""
    config_hash: str | None = None
    """Hash of the training configuration, which the run's record holds."""
    data_fingerprint: str | None = None
    """Fingerprint of the store."""

    def covers(self, row: "ResultRow") -> bool:
        """Whether `row` belongs to this measurement; `row` may have more conditions."""
        return (
            all(getattr(row, name) == getattr(self, name) for name in _KEY_FIELDS)
            and self.conditions.items() <= row.conditions.items()
        )


_KEY_FIELDS = tuple(f.name for f in fields(RowKey) if f.name != "conditions")


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
    details: Mapping[str, Json] = field(default_factory=dict)
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

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95% intervals by metric."""
        ends = {self.metric: self.interval, **self.details.get("intervals", {})}
        return {name: (pair[0], pair[1]) for name, pair in ends.items() if pair}

    def __getitem__(self, name: str) -> Any:
        """A field, condition, metric or end of the interval by its name, as in `as_line`."""
        return self.as_line()[name]

    def extended(self, values: Mapping[str, Any], **changes: Any) -> "ResultRow":
        """The row with further values: finite numbers are metrics, others but None are details."""
        metrics, details = {**self.metrics}, {**self.details}
        for name, value in values.items():
            if plain(value) is None:
                continue
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                metrics[name] = float(value)
            else:
                details[name] = plain(value)
        return replace(self, metrics=metrics, details=details, **changes)

    def of(self, key: RowKey) -> "ResultRow":
        """The row as a measurement `key`, whose conditions are added to its own."""
        conditions = {**self.conditions, **key.conditions}
        return replace(self, **{**vars(key), "conditions": conditions})

    def as_line(self) -> dict[str, Any]:
        """Every field, condition and metric in one flat mapping, for tables and figures."""
        flat = {name: value for name, value in vars(self).items() if name not in _NESTED}
        low, high = self.interval or (None, None)
        ends = {f"{self.metric}_low": low, f"{self.metric}_high": high}
        return {**flat, **self.conditions, **ends, **self.metrics}

    def to_json(self) -> dict[str, Any]:
        """The row as JSON values, without fields at their default."""
        return {name: value for name, value in vars(self).items() if value not in (None, "", {})}


_NESTED = ("conditions", "metrics", "interval", "details", "versions")
_ROWS = TypeAdapter(ResultRow)


def row_from_json(text: str, where: str) -> ResultRow:
    """Inverse of `ResultRow.to_json`, of JSON; messages name the origin `where` (file and line).
    InputError if `text` is no object, or a field is missing, unknown or of a wrong type."""
    try:
        row = _ROWS.validate_json(text)
        if row.metric in row.metrics:
            return row
        fault = f"its metrics lack {row.metric!r:.60}"
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        fault = f"{'.'.join(map(str, first['loc']))!r:.60}: {first['msg']}"
    raise InputError(f"{where} is not a result row: {fault}; delete it, or name another file")


def read_rows(path: Path) -> list[ResultRow]:
    """Read the rows of a file; none if it does not exist. InputError if a line is not a result row,
    or the file is not UTF-8 text."""
    return [
        row_from_json(line, f"{path}, line {number}")
        for number, line in enumerate(_read_text(path).split("\n"), start=1)
        if line.strip()
    ]


def read_results(path: Path) -> list[ResultRow]:
    """Read the rows of JSON lines, or of a JSON list as commands write with `--json`. InputError if
    the file is missing or has other content."""
    if path.suffix != ".json" and path.exists() and not _read_text(path).startswith("["):
        return read_rows(path)
    rows = atomic.read_json(path)
    if not isinstance(rows, list):
        raise InputError(f"{path} holds no list of result rows; name a file that --json wrote")
    return [
        row_from_json(json.dumps(row), f"{path}, row {n}") for n, row in enumerate(rows, start=1)
    ]


def write_results(path: Path, rows: Sequence[ResultRow]) -> None:
    """Write rows as a JSON list, for `read_results`."""
    atomic.write_json(path, [row.to_json() for row in rows])


def append_rows(path: Path, rows: Sequence[ResultRow]) -> None:
    """Append rows to a file; after an interruption either all are in it or none. Other processes
    that append to the file wait. ValueError if a row has a number that is not finite."""
    with atomic.claim(path, wait=True):
        _write(path, _read_text(path), rows)


def remove_rows(path: Path, keys: Sequence[RowKey]) -> None:
    """Remove the rows of some measurements from a file; atomic, other rows stay as they are."""
    with atomic.claim(path, wait=True):
        rows = read_rows(path)
        _write(path, "", [row for row in rows if not any(key.covers(row) for key in keys)])


def latest(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """The last row of each measurement, regardless of data and configuration."""
    same = {*_KEY_FIELDS, "environment", "checkpoint"} - {"policy", *_ORIGIN}
    last = {
        (*(getattr(row, name) for name in same), str(sorted(row.conditions.items()))): row
        for row in rows
    }
    return list(last.values())


@contextmanager
def benchmarking(path: Path) -> Iterator[None]:
    """Let no other command measure for the file `path` of result rows; an `InputError` names one
    that does."""
    with atomic.lock_path(path, "filled", part="benchmark"):
        atomic.remove_leftovers(path.parent)
        yield


def _read_text(path: Path) -> str:
    """Whole lines; none if there is no file."""
    try:
        text = path.read_text(encoding="utf-8") if path.exists() else ""
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text; name a file of result rows") from None
    return text + "\n" if text and not text.endswith("\n") else text


def _write(path: Path, text: str, rows: Sequence[ResultRow]) -> None:
    """Replace a file by text and the lines of rows."""
    write = partial(json.dumps, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    lines = "".join(f"{write(row.to_json())}\n" for row in rows)
    with atomic.atomic_file(path) as scratch:
        scratch.write_bytes((text + lines).encode())


def name_rows(rows: Sequence[ResultRow]) -> list[str]:
    """A name of each row: its method, or of estimates from logs its policy, with what differs from
    rows of the same."""
    methods = [row.policy if _VERDICT in row.details else row.method for row in rows]
    parts: list[dict[str, object]] = [
        {
            **row.details.get("decision_rule", {}),
            **{name: value for name, value in row.conditions.items() if name not in _IMPLIED},
            "checkpoint": row.checkpoint,
            "seed": row.evaluation_seed,
            "training seed": row.training_seed,
        }
        for row in rows
    ]
    names = []
    for method, values in zip(methods, parts, strict=True):
        same = [part for name, part in zip(methods, parts, strict=True) if name == method]
        texts = [
            _describe_part(name.replace("_", " "), value)
            for name, value in values.items()
            if any(part.get(name) != value for part in same)
        ]
        names.append(", ".join([method, *texts]))
    return names


def _describe_part(name: str, value: object) -> str:
    if value is None or value is False:
        return f"no {name}"
    text = f"{value:g}" if type(value) is float else value
    return name if value is True else f"{name} {text}"


def select_intervals(
    rows: Sequence[ResultRow], metric: str | None = None
) -> "tuple[list[Interval], tuple[str, float] | None]":
    """What a picture of rows shows of a metric, by default that of each row: their intervals, and a
    level to compare them with. Of the estimates of `ucfrec ope`, these are the ones that verdicts
    are of, and the logged return, if the logs are the same for all."""
    from ucfrec.results.charts import Interval

    level, judged = None, metric is None and any(_VERDICT in row.details for row in rows)
    if judged:
        sessions = [row for row in rows if row.metric == "R_cum"]
        logged = {row.value for row in sessions if row.policy == _BEHAVIOR}
        level = ("logged", logged.pop()) if len(logged) == 1 else None
        rows = [row for row in sessions if row.policy != _BEHAVIOR]
    intervals = dict[object, Interval]()
    for number, (name, row) in enumerate(zip(name_rows(rows), rows, strict=True)):
        measure, key = metric or row.metric, name if judged else number
        is_quoted = row.method == row.details.get("verdict_of")
        if measure in row.metrics and (is_quoted or key not in intervals):
            value = row.metrics[measure]
            low, high = row.intervals.get(measure, (value, value))
            reliable = not judged or row.details.get("reliable") is True
            intervals[key] = Interval(name, value, low, high, reliable)
    return list(intervals.values()), level


_VERDICT, _BEHAVIOR = "verdict", "behavior"
"""Detail and policy of rows of `ucfrec ope`."""
_IMPLIED = ("steps", "choice")
"""Conditions that follow from others."""
_ORIGIN = ("config_hash", "data_fingerprint")
_IDENTITY = (*_ORIGIN, "suite", "table", "command", "commit", "checkpoint")
"""Fields that a frame leaves out; a file of the rows has them."""


@dataclass(frozen=True, repr=False)
class ResultTable:
    """Results of one measurement of several methods."""

    rows: Sequence[ResultRow]
    warnings: Sequence[str]
    """What makes the numbers less reliable."""
    headings: ClassVar[tuple[str, ...]] = ()
    """Columns of the table, after `method`; empty for those of the rows' own metrics."""

    def __iter__(self) -> Iterator[ResultRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return "\n".join([self._table().to_string(index=False), *self._said()])

    def _said(self) -> list[str]:
        """What to know of the rows, shown below them."""
        return [f"warning: {text}" for text in self.warnings]

    def to_frame(self) -> "pd.DataFrame":
        """One row per method: its metrics, each with the ends of its 95% interval where it has one
        (`NAME_low`, `NAME_high`), then the conditions of the measurement."""
        import pandas as pd

        lines = []
        for row in self.rows:
            line: dict[str, Any] = {"method": row.method}
            for name, value in row.metrics.items():
                line[name] = value
                if name in row.intervals:
                    line[f"{name}_low"], line[f"{name}_high"] = row.intervals[name]
            lines.append({**line, **row.as_line(), **line})
        frame = pd.DataFrame(lines).drop(columns=list(_IDENTITY), errors="ignore")
        return frame.dropna(axis="columns", how="all")

    def plot(self, metric: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draw the picture of `report`: a metric of every method, by default that of the rows, with
        its 95% interval; of `ope`, the estimate that the verdict is of and the logged return.
        InputError if no row has the metric."""
        from matplotlib import pyplot

        from ucfrec.results.charts import draw_intervals

        name, names = metric or self.rows[0].metric, self._list_metrics()
        if name not in names:
            raise InputError(f"no row has the metric {name!r}; they have {', '.join(names)}")
        axes = pyplot.subplots()[1] if ax is None else ax
        intervals, level = select_intervals(self.rows, metric)
        height = draw_intervals(axes, intervals, level)
        if ax is None:
            axes.figure.set_size_inches(6, height / 72)  # type: ignore[union-attr]
        axes.set_xlabel(name)
        return axes

    def save(self, file: Path | str) -> None:
        """Write the rows as JSON, as `--json` of the commands does, for `report`."""
        write_results(Path(file), self.rows)

    def _list_metrics(self) -> list[str]:
        return list(dict.fromkeys(name for row in self.rows for name in row.metrics))

    def _table(self) -> "pd.DataFrame":
        frame = self.to_frame()
        columns = self.headings or self._list_metrics()
        return frame[["method", *(name for name in columns if name in frame)]]

    def _repr_html_(self) -> str:
        table = self._table().to_html(index=False, float_format="{:.4g}".format, na_rep="–")
        return str(table) + "".join(f"<p>{escape(text)}</p>" for text in self._said())


class Evaluation(ResultTable):
    """Returns in a simulator, one row per policy."""

    headings = (
        *("R_cum", "R_cum_low", "R_cum_high", "R_avg_pooled", "length"),
        *("coverage", "diversity"),
    )


class Ranking(ResultTable):
    """How policies and baselines rank what users were shown and liked later."""

    headings = (
        *("hit_rate_shown", "hit_rate_liked", "ndcg_liked", "recall_liked", "gauc", "item_rate"),
        "coverage",
    )
