"""Sample recommendations of a run in the report."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as csv
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import read_json
from ucfrec.files.parquet import require_regular
from ucfrec.reporting.tables import Table, format_value
from ucfrec.runs.samples import SAMPLES
from ucfrec.runs.trained_policy import ITEMS

_CHARACTERS = 120
"""Most characters of the shown features of an item."""


def tabulate_samples(run: Path, features: pa.Table | None) -> tuple[str, list[Table]] | None:
    """The decision rule of the samples and one table per session; None if a run has no samples.

    Args:
        features: one row per item with its `item_id` and features to show; None for none.
    """
    if not (run / SAMPLES).exists() or not (run / ITEMS).exists():
        return None
    samples = read_json(run / SAMPLES)
    require_regular(run / ITEMS)
    with damage_explained(run / SAMPLES, "restore it or train again"):
        sessions = samples["sessions"]
        numbers = {n for s in sessions for n in (*s["history"], s["logged"], *s["recommended"])}
        items = _item_cells(pq.read_table(run / ITEMS), sorted(numbers), features)
        tables = [_tabulate(number, session, items) for number, session in enumerate(sessions, 1)]
        return str(samples["rule"]), tables


def read_features(path: Path, text_ids: bool = False) -> pa.Table:
    """Read item features with a column `item_id` from CSV (file name `.csv`) or Parquet.

    Args:
        text_ids: whether the ids of a CSV are read as they are written, e.g. 007.

    Raises:
        InputError: the file cannot be read as that or lacks the column.
    """
    require_regular(path)
    try:
        types = csv.ConvertOptions(column_types={schema.ITEM_ID: pa.string()} if text_ids else None)
        text = path.suffix == ".csv"
        table = csv.read_csv(path, convert_options=types) if text else pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path} cannot be read as Parquet or CSV: {reason}") from None
    if schema.ITEM_ID not in table.column_names:
        raise InputError(f"{path} has no column {schema.ITEM_ID!r}; add one with the item ids")
    return table


def _item_cells(
    items: pa.Table, numbers: Sequence[int], features: pa.Table | None
) -> dict[int, dict[str, str]]:
    """Item number to the cells (column: text) of its row in `items` and of its features."""
    rows = items.take(pa.array(numbers, pa.int64())).to_pylist()
    cells = {
        number: {name: str(value) for name, value in row.items()}
        for number, row in zip(numbers, rows, strict=True)
    }
    if features is not None:
        ids = pa.array([row[schema.ITEM_ID] for row in rows])
        try:
            matches = features.filter(pc.is_in(features[schema.ITEM_ID], value_set=ids)).to_pylist()
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError, TypeError):
            matches = []  # the ids are of another type, so none of them can match
        described = {row.pop(schema.ITEM_ID): _describe(row) for row in matches}
        for number, row in zip(numbers, rows, strict=True):
            cells[number]["features"] = described.get(row[schema.ITEM_ID], "–")
    return cells


def _describe(features: Mapping[str, Any]) -> str:
    """Text of the features that are neither missing nor zero, cut to `_CHARACTERS`."""
    parts = []
    for name, value in features.items():
        text = (
            ", ".join(map(format_value, value)) if isinstance(value, list) else format_value(value)
        )
        if value:
            parts.append(f"{name} {text}")
    described = "; ".join(parts) or "–"
    return described if len(described) <= _CHARACTERS else f"{described[: _CHARACTERS - 1]}…"


def _tabulate(
    number: int, session: Mapping[str, Any], items: Mapping[int, Mapping[str, str]]
) -> Table:
    history = zip(session["history"], session["rewards"], strict=True)
    lines = [("shown before", item, format_value(reward)) for item, reward in history]
    lines.append(("shown next in the log", session["logged"], "–"))
    for rank, item in enumerate(session["recommended"], start=1):
        again = " (shown before)" if item in session["history"] else ""
        lines.append((f"recommended {rank}{again}", item, "–"))
    columns = list(items[session["logged"]])
    body = [
        (what, [reward, *(items[item][name] for name in columns)]) for what, item, reward in lines
    ]
    return Table(f"Held-out session {number}", "", ["reward", *columns], body)
