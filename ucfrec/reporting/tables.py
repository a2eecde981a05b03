"""Text and Markdown tables, and the number formats in them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ucfrec.errors import one_line
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import summary

NONE = "–"
"""Cell of a missing value."""


@dataclass
class Table:
    """A table of the report, whose values become texts as `format_value` writes them."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, Sequence[object]]]
    """(name, one value per column) of each row."""
    corner: str = ""
    """Head of the column of row names."""

    @classmethod
    def of_columns(cls, caption: str, columns: Mapping[str, Mapping[Any, object]]) -> "Table":
        """A table of columns by name, with a row for every name in at least one of them."""
        names = dict.fromkeys(name for column in columns.values() for name in column)
        rows = [(name, [column.get(name) for column in columns.values()]) for name in names]
        return cls(caption, list(columns), rows)

    def __post_init__(self) -> None:
        self.rows = [(name, [format_value(v) for v in values]) for name, values in self.rows]


def text_table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """An aligned table for a terminal; the first two columns are left-aligned, others right."""
    table = [list(map(_format_text, line)) for line in (head, *lines)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    table.insert(1, ["-" * width for width in widths])
    form = "  ".join(f"{{:{'<' if i < 2 else '>'}{width}}}" for i, width in enumerate(widths))
    return "\n".join(form.format(*line).rstrip() for line in table)


def markdown_table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A table in GitHub Markdown."""
    table = (head, ["---"] * len(head), *lines)
    return "\n".join(f"| {' | '.join(map(_format_text, line))} |" for line in table)


def evaluation_table(rows: Iterable[ResultRow]) -> str:
    """Rows of evaluations as an aligned text table."""
    returns = ("R_cum", "R_avg_pooled", "R_avg_episode")
    columns = ("environment", "policy", *returns, "length", "episodes", "seed")
    lines = [{**row.as_line(), "policy": row.method, "seed": row.evaluation_seed} for row in rows]
    return format_rows(lines, columns)


def format_rows(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """The `columns` of rows as an aligned text table; a value `x` of a row that has `x_low` and
    `x_high`, such as R_cum, gets its interval."""
    return text_table(columns, [[_format_cell(row, name) for name in columns] for row in rows])


def format_number(value: float) -> str:
    """`value` with three decimals, or three significant digits if it is below 0.1."""
    return f"{value:.3f}" if value == 0 or abs(value) >= 0.1 else f"{value:#.3g}"


def mean_and_sd(values: Iterable[float]) -> str:
    """Mean ± standard deviation; a single value without ±, a dash for no values."""
    sample = summary(values)
    if not sample.count:
        return NONE
    return f"{sample.mean:.4g}" + (f" ± {sample.sd:.2g}" if sample.count > 1 else "")


def format_value(value: Any) -> str:
    """Cell text of `value`: floats with four significant digits, a dash if missing or infinite."""
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"
    if value is None or isinstance(value, float):
        return NONE
    return f"{value:,}" if type(value) is int else str(value)


def _format_cell(row: Mapping[str, Any], name: str) -> str:
    value = row[name]
    if isinstance(value, float) and {f"{name}_low", f"{name}_high"} <= row.keys():
        low, high = (_format_text(row[f"{name}_{end}"]) for end in ("low", "high"))
        return f"{format_number(value)} [{low}, {high}]"
    return _format_text(value)


def _format_text(value: object) -> str:
    if value is None:
        return NONE
    if isinstance(value, float):
        return format_number(value)
    text = str(value)
    return text if text.isprintable() else one_line(text)
