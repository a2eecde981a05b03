"""Any log: columns mapped by the user, features in files next to the log."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping, log_files, table_name


def _resolve(paths: Sequence[str | Path], given: LogMapping) -> tuple[tuple[Path, ...], LogMapping]:
    """Files and folders called `items.*` and `users.*`, and those that the mapping names as
    features, are feature tables, all others logs."""
    files = log_files(paths)
    kinds = {file: table_name(file).partition(".")[0] for file in files}
    items = tuple(file for file in files if kinds[file] == "items")
    users = tuple(file for file in files if kinds[file] == "users")
    defaults = LogMapping(
        item_features=(FeatureTable(items, schema.ITEM_ID),) if items else (),
        user_features=(FeatureTable(users, schema.USER_ID),) if users else (),
    )
    mapping = given.over(defaults)
    features = {file.resolve() for file in (*items, *users, *_feature_files(mapping))}
    logs = tuple(file for file in files if file.resolve() not in features)
    if not logs:
        raise InputError(
            f"{files[0]}: every file is called items.* or users.* or named as features, so none is "
            "the log; name the log too, or rename it"
        )
    return logs, mapping


def _feature_files(mapping: LogMapping) -> Iterator[Path]:
    """Files of one row per item or user; a table with `first_by` may be the log itself."""
    for table in (*mapping.item_features, *mapping.user_features):
        if not table.first_by:
            yield from log_files(table.files)


DATASET: Final = Dataset(
    summary="any Parquet or CSV log, columns mapped by name; features in items.* and users.*",
    resolve=_resolve,
)
