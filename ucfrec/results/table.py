"""Result rows as data frames, charts and HTML, for notebooks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from ucfrec.errors import InputError
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import write_results

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_IDENTITY = ("suite", "table", "command", "commit", "config_hash", "data_fingerprint", "checkpoint")
"""Fields that a frame leaves out; a file of the rows has them."""


class ResultTable:
    """What is shown of result rows, and how they are kept."""

    rows: Sequence[ResultRow]
    shown: ClassVar[tuple[str, ...]] = ()
    """Columns of the HTML table, after `method`; empty for those of the rows' own metrics."""

    def __iter__(self) -> Iterator[ResultRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return "\n".join([self._table().to_string(index=False), *self._said()])

    def _said(self) -> list[str]:
        """What to know of the rows, shown below them."""
        return []

    def to_frame(self) -> "pd.DataFrame":
        """One row per method: its metrics, each with the ends of its 95% interval where it has one
        (`NAME_low`, `NAME_high`), then the conditions of the measurement."""
        import pandas as pd

        frame = pd.DataFrame([_line(row) for row in self.rows])
        return frame.dropna(axis="columns", how="all")

    def plot(self, metric: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draw one metric of every method with its 95% interval.

        Args:
            metric: name of a metric; None for the one that the rows are about.
            ax: matplotlib axes to draw on; None for new ones.

        Raises:
            InputError: no row has the metric.
        """
        from matplotlib import pyplot

        metric, frame = metric or self.rows[0].metric, self.to_frame()
        names = dict.fromkeys(name for row in self.rows for name in row.metrics)
        if metric not in names:
            raise InputError(f"no row has the metric {metric!r}; they have {', '.join(names)}")
        frame = frame[frame[metric].notna()].iloc[::-1]
        axes = pyplot.subplots()[1] if ax is None else ax
        low, high = (
            frame.get(f"{metric}_{end}", frame[metric]).fillna(frame[metric])
            for end in ("low", "high")
        )
        errors = [frame[metric] - low, high - frame[metric]]
        axes.errorbar(frame[metric], range(len(frame)), xerr=errors, fmt="o", capsize=3)
        axes.set_yticks(range(len(frame)), frame["method"].tolist())
        axes.set_xlabel(f"{metric}, with 95% intervals")
        return axes

    def save(self, file: Path | str) -> None:
        """Write the rows as JSON, as `--json` of the commands does, for `report`."""
        write_results(Path(file), self.rows)

    def _table(self) -> "pd.DataFrame":
        frame = self.to_frame()
        columns = self.shown or tuple(dict.fromkeys(n for row in self.rows for n in row.metrics))
        return frame[["method", *(name for name in columns if name in frame)]]

    def _repr_html_(self) -> str:
        table = self._table().to_html(index=False, float_format="{:.4g}".format, na_rep="–")
        return str(table) + "".join(f"<p>{escape(text)}</p>" for text in self._said())


def _line(row: ResultRow) -> dict[str, Any]:
    """The cells of a row: the method, metrics with intervals, conditions, other fields."""
    ends = {name: ends for name, ends in row.details.get("intervals", {}).items() if ends}
    if row.interval is not None:
        ends[row.metric] = row.interval
    line: dict[str, Any] = {"method": row.method}
    for name, value in row.metrics.items():
        line[name] = value
        if name in ends:
            line[f"{name}_low"], line[f"{name}_high"] = ends[name]
    fields = {name: v for name, v in row.as_line().items() if name not in _IDENTITY}
    return {**line, **{name: value for name, value in fields.items() if name not in line}}


@dataclass(frozen=True, repr=False)
class Measured(ResultTable):
    """Results of one measurement of several methods."""

    rows: Sequence[ResultRow]
    warnings: Sequence[str] = ()
    """What makes the numbers less reliable."""

    def _said(self) -> list[str]:
        return [f"warning: {text}" for text in self.warnings]


class Evaluation(Measured):
    """Returns in a simulator, one row per policy."""

    shown = ("R_cum", "R_cum_low", "R_cum_high", "R_avg_pooled", "length", "coverage", "diversity")


class Ranking(Measured):
    """How policies and baselines rank what users were shown and liked later."""

    shown = (
        *("hit_rate_shown", "hit_rate_liked", "ndcg_liked", "recall_liked", "gauc", "item_rate"),
        "coverage",
    )
