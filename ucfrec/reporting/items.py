"""Features of items, as the report and the explorer show them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.episodes.record import Source
from ucfrec.errors import InputError
from ucfrec.files.atomic import require_file
from ucfrec.reporting.tables import format_value

Features = Mapping[str, Mapping[str, Any]]
"""Id of an item, as text, to its features by name."""
_MOST_CHARACTERS = 120
"""Most characters of the text of an item's features."""
_TITLES = ("title", "name")
_IMAGES = ("image_url", "image", "picture_url", "picture", "thumbnail")


def read_features(path: Path, logs: Iterable[Source] = (), text_ids: bool = False) -> pa.Table:
    """Read item features with a column `item_id` from CSV (file name `.csv`) or Parquet. InputError
    if the file cannot be read as that or lacks the column.

    Args:
        logs: of runs; their own name of the column is accepted in the file, too.
        text_ids: whether ids in CSV stay as they are written.
    """
    require_file(path, "name another file")
    mapped = ((log.mapping.get(schema.ITEM_ID) or schema.ITEM_ID).strip('"') for log in logs)
    names = dict.fromkeys((schema.ITEM_ID, *mapped))
    try:
        texts = dict.fromkeys(names, pa.string()) if text_ids else None
        types = csv.ConvertOptions(column_types=texts)
        text = path.suffix == ".csv"
        table = csv.read_csv(path, convert_options=types) if text else pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(f"{path} cannot be read as Parquet or CSV: {error}") from None
    column = next((name for name in names if name in table.column_names), None)
    if column is None:
        heads = " or ".join(map(repr, names))
        raise InputError(f"{path} has no column {heads}; add one with the item ids")
    return table.rename_columns({column: schema.ITEM_ID})


def features_by_id(features: pa.Table | None) -> Features:
    """The rows of `read_features`; none without a table."""
    rows = [] if features is None else features.to_pylist()
    return {str(row.pop(schema.ITEM_ID)): row for row in rows}


def describe_features(features: Mapping[str, Any]) -> str:
    """Text of the features that are neither missing nor zero, cut to `_MOST_CHARACTERS`."""
    parts = []
    for name, value in features.items():
        values = value if isinstance(value, list) else [value]
        texts = (str(v) if type(v) is int else format_value(v) for v in values)  # of 2026, a year
        if value:
            parts.append(f"{name} {', '.join(texts)}")
    text = "; ".join(parts)
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 1]}…"


def describe_item(items: Features, item_id: object) -> dict[str, str]:
    """Title, address of a picture, "" for none, and text of the other features of an item."""
    row = items.get(str(item_id), {})
    image = next((str(row[name]) for name in _IMAGES if row.get(name)), "")
    columns = [name for name in row if name not in (*_TITLES, *_IMAGES)]
    return {
        "title": next((str(row[name]) for name in _TITLES if row.get(name)), str(item_id)),
        "image": image if image.startswith(("http://", "https://")) else "",
        "features": describe_features({name: row[name] for name in columns}),
    }
