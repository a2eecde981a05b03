"""Tables and charts of what `prepare` read, dropped and kept."""

from collections.abc import Mapping
from dataclasses import dataclass

from ucfrec.episodes.record import Distribution, Source
from ucfrec.logs.kept import REASONS
from ucfrec.reporting import charts
from ucfrec.reporting.tables import Table, shown

_DISTRIBUTIONS = {
    "session_lengths": ("Sessions by length", "steps of a session"),
    "rewards": ("Steps by reward", "reward"),
    "item_popularity": ("Items by popularity", "steps that show the item"),
}
"""Name of a distribution in the `summary` of `prepare` to its title and x-axis label."""
_LEVELS = ("0", "0.25", "0.5", "0.75", "0.99", "1")
_COUNTS = {
    "rows_read": "rows read",
    "unsorted_rows": "rows out of order (sorted)",
    "equal_times": "rows at equal times (in no order that could be learned)",
    "steps": "steps kept",
    "users": "users",
    "items": "items",
    "sessions": "sessions",
    "sessions_cut": "sessions cut at a split",
    "unknown_propensities": "steps with an unknown propensity",
}


@dataclass(frozen=True)
class DataQuality:
    """Tables and charts of the logs that a store was made from."""

    rows: Table | None
    """None if nothing is recorded, as for stores not made by `prepare`."""
    dropped: Table | None
    quantiles: Table | None
    pictures: list[tuple[charts.Histogram, Table]]


def data_quality(source: Source) -> DataQuality:
    """Tables and charts of what a store was made from."""
    if source.rows_read is None:
        return DataQuality(None, None, None, [])
    counts = {name: getattr(source, key) for key, name in _COUNTS.items()}
    rows = [(name, [shown(count)]) for name, count in counts.items() if count is not None]
    distributions = {
        name: source.summary[name] for name in _DISTRIBUTIONS if name in source.summary
    }
    return DataQuality(
        Table("Rows of the logs", "", ["count"], rows),
        _dropped(source.dropped, source.rows_read),
        _quantiles(distributions),
        [_picture(name, one) for name, one in distributions.items() if any(one.counts)],
    )


def _dropped(dropped: Mapping[str, int], read: int) -> Table:
    reasons = {
        **REASONS,
        "long_session": "its session, or the part of it in one split, is too long",
        "short_episode": "its session, or the part of it in one split, is too short",
    }
    body = [
        (
            f"{reason.replace('_', ' ')}: {reasons.get(reason, 'dropped')}",
            [shown(rows), f"{rows / read:.2%}" if read else "–"],
        )
        for reason, rows in dropped.items()
    ]
    return Table("Rows dropped, by reason", "", ["rows", "share of rows read"], body)


def _quantiles(distributions: Mapping[str, Distribution]) -> Table | None:
    body = [
        (_DISTRIBUTIONS[name][0], [shown(one.quantiles.get(level)) for level in _LEVELS])
        for name, one in distributions.items()
    ]
    columns = ["smallest", "25%", "median", "75%", "99%", "largest"]
    return Table("Quantiles", "", columns, body) if body else None


def _picture(name: str, one: Distribution) -> tuple[charts.Histogram, Table]:
    title, x_label = _DISTRIBUTIONS[name]
    chart = charts.histogram(title, x_label, one.counts, one.edges, one.values)
    total = sum(one.counts)
    body = [
        (column.name, [shown(count), f"{count / total:.2%}"])
        for column, count in zip(chart.columns, one.counts, strict=True)
    ]
    return chart, Table(title, x_label, ["count", "share"], body)
