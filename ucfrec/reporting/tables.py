"""Tables as text and as Markdown, and how numbers are written in them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ucfrec.reporting.statistics import Summary, summary

NONE = "–"
"""In the place of a value that there is not."""
_EVALUATION = (
    *("world", "policy", "R_cum", "R_avg_pooled", "R_avg_episode", "length", "episodes", "seed"),
)


@dataclass(frozen=True)
class Table:
    """Cells as the report shows them; every row has one for each column."""

    caption: str
    corner: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, Sequence[str]]]


def text_table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """An aligned table for a terminal; the first two columns to the left, the others right."""
    table = [list(head), *([_text(cell) for cell in line] for line in lines)]
    widths = [max(len(line[i]) for line in table) for i in range(len(head))]
    written = []
    for line in table:
        cells = [line[i].ljust(w) if i < 2 else line[i].rjust(w) for i, w in enumerate(widths)]
        written.append("  ".join(cells).rstrip())
    written.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(written)


def markdown_table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A table of GitHub's Markdown."""
    body = [head, ["---"] * len(head), *([_text(cell) for cell in line] for line in lines)]
    return "\n".join("| " + " | ".join(line) + " |" for line in body)


def format_rows(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = _EVALUATION) -> str:
    """`columns` of rows as an aligned table; a value with `_low` and `_high` beside it, as R_cum of
    `evaluate`, with its interval."""
    return text_table(columns, [[_cell(row, name) for name in columns] for row in rows])


def number(value: float) -> str:
    """Three decimals, or, of click rates and the like, three digits."""
    return f"{value:.3f}" if value == 0 or abs(value) >= 0.1 else f"{value:#.3g}"


def mean_and_sd(values: Iterable[float]) -> str:
    """Mean ± standard deviation; of one value the value alone, of none a dash."""
    found = summary(values)
    if not found.count:
        return NONE
    return f"{found.mean:.4g}" + (f" ± {found.sd:.2g}" if found.count > 1 else "")


def signed_difference(found: Summary) -> str:
    """A mean difference with its sign ± its standard error."""
    return f"{found.mean:+.3g} ± {found.standard_error:.2g}"


def shown(value: Any) -> str:
    """`value` for a reader: four digits of a number, a dash for none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return NONE
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"
    return f"{value:,}" if type(value) is int else str(value)


def _cell(row: Mapping[str, Any], name: str) -> str:
    value = row[name]
    if isinstance(value, float) and {f"{name}_low", f"{name}_high"} <= row.keys():
        return f"{number(value)} [{_text(row[f'{name}_low'])}, {_text(row[f'{name}_high'])}]"
    return _text(value)


def _text(value: object) -> str:
    if value is None:
        return NONE
    return number(value) if isinstance(value, float) else str(value)
