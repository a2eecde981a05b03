"""Any log: columns mapped by the user, features in files next to the log."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping, log_files, table_name


def _resolve(paths: Sequence[str | Path], given: LogMapping) -> tuple[tuple[Path, ...], LogMapping]:
    """Files and folders called `items.*` and `users.*` are feature tables, all others logs."""
    files = log_files(paths)
    kinds = [table_name(file).partition(".")[0] for file in files]
    items = tuple(f for f, kind in zip(files, kinds, strict=True) if kind == "items")
    users = tuple(f for f, kind in zip(files, kinds, strict=True) if kind == "users")
    defaults = LogMapping(
        item_features=(FeatureTable(items, schema.ITEM_ID),) if items else (),
        user_features=(FeatureTable(users, schema.USER_ID),) if users else (),
    )
    return tuple(f for f in files if f not in items + users), given.over(defaults)


DATASET: Final = Dataset(
    summary="any Parquet or CSV log, columns mapped by name; features in items.* and users.*",
    resolve=_resolve,
)
