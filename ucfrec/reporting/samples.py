"""Sample recommendations of a run, as the report shows them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as csv
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.reporting.tables import Table, shown
from ucfrec.runs.samples import SAMPLES
from ucfrec.runs.trained_policy import ITEMS

_CHARACTERS = 120
"""Most characters of an item's features."""


def sample_tables(run: Path, features: pa.Table | None) -> tuple[str, list[Table]] | None:
    """The target return and a table a session; None where a run recorded no samples.

    Args:
        features: further features of items, one row an item, with their `item_id`.
    """
    if not (run / SAMPLES).exists() or not (run / ITEMS).exists():
        return None
    samples = read_json(run / SAMPLES)
    sessions = samples["sessions"]
    numbers = {n for s in sessions for n in (*s["history"], s["logged"], *s["recommended"])}
    about = _about(pq.read_table(run / ITEMS), sorted(numbers), features)
    tables = [_session(place, one, about) for place, one in enumerate(sessions, start=1)]
    return shown(samples["target_return"]), tables


def read_features(path: Path) -> pa.Table:
    """A table of item features with a column `item_id`, Parquet or (by its name) CSV.

    Raises:
        InputError: the file is missing, is something else, or lacks the column.
    """
    try:
        table = csv.read_csv(path) if path.suffix == ".csv" else pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path} cannot be read as Parquet or CSV: {reason}") from None
    if schema.ITEM_ID not in table.column_names:
        raise InputError(f"{path} has no column {schema.ITEM_ID!r}, so its features fit no item")
    return table


def _about(
    items: pa.Table, numbers: Sequence[int], features: pa.Table | None
) -> dict[int, dict[str, str]]:
    """What is known of each item, by its number: columns of `items`, then its features."""
    rows = items.take(pa.array(numbers, pa.int64())).to_pylist()
    known = {
        number: {name: str(value) for name, value in row.items()}
        for number, row in zip(numbers, rows, strict=True)
    }
    if features is not None:
        ids = pa.array([row[schema.ITEM_ID] for row in rows])
        try:
            found = features.filter(pc.is_in(features[schema.ITEM_ID], value_set=ids)).to_pylist()
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError, TypeError):
            found = []  # ids of another type, so that none is the same
        described = {row.pop(schema.ITEM_ID): _described(row) for row in found}
        for number, row in zip(numbers, rows, strict=True):
            known[number]["features"] = described.get(row[schema.ITEM_ID], "–")
    return known


def _described(features: Mapping[str, Any]) -> str:
    """Features that are neither missing nor zero, in a few words."""
    parts = []
    for name, value in features.items():
        text = ", ".join(map(shown, value)) if isinstance(value, list) else shown(value)
        if value:
            parts.append(f"{name} {text}")
    described = "; ".join(parts) or "–"
    return described if len(described) <= _CHARACTERS else f"{described[: _CHARACTERS - 1]}…"


def _session(
    place: int, session: Mapping[str, Any], about: Mapping[int, Mapping[str, str]]
) -> Table:
    earned = zip(session["history"], session["rewards"], strict=True)
    lines = [("shown before", item, shown(reward)) for item, reward in earned]
    lines.append(("shown next in the log", session["logged"], "–"))
    for rank, item in enumerate(session["recommended"], start=1):
        again = " (shown before)" if item in session["history"] else ""
        lines.append((f"recommended {rank}{again}", item, "–"))
    columns = list(about[session["logged"]])
    body = [
        (what, [reward, *(about[item][name] for name in columns)]) for what, item, reward in lines
    ]
    return Table(f"Held-out session {place}", "", ["reward", *columns], body)
