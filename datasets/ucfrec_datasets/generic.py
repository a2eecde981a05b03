"""Any log: columns mapped by the user, features in files next to the log."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping, log_files, table_name


def _resolve(
    paths: Sequence[str | Path], mapping: LogMapping
) -> tuple[tuple[Path, ...], LogMapping]:
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
    mapping = mapping.over(defaults)
    features = {file.resolve() for file in (*items, *users, *_feature_files(mapping))}
    logs = tuple(file for file in files if file.resolve() not in features)
    if not logs:
        raise InputError(
            f"{files[0]}: every file is called items.* or users.* or named as features, so none is "
            "the log; name the log too, or rename it"
        )
    return logs, mapping


def official_files(
    paths: Sequence[str | Path], log: str, features: Collection[str]
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """The logs among files and folders of a release, and the files that may hold features.

    Args:
        log: name of the log's file in the release; another file is a log if it is named by itself.
        features: names of the other files in the release.

    Raises:
        InputError: there is no log.
    """
    files = log_files(paths)
    folders = [Path(path) for path in paths if Path(path).is_dir()]
    logs = tuple(
        file
        for file in files
        if stem(file) == log or (stem(file) not in features and file.parent not in folders)
    )
    if not logs:
        raise InputError(
            f"no log among {len(files)} file(s) such as {files[0]}; name a folder or file with "
            f"{log}, or the log by itself"
        )
    return logs, (*files, *log_files([logs[0].parent]))


def official_table(
    files: Sequence[Path], name: str, key: str, columns: tuple[str, ...], first_by: str = ""
) -> tuple[FeatureTable, ...]:
    """The first file of a name as a table; empty if there is none."""
    file = next((file for file in files if stem(file) == name), None)
    return () if file is None else (FeatureTable((file,), key, columns, first_by),)


def stem(file: Path) -> str:
    """The name of a file without its endings."""
    return file.name.partition(".")[0]


def _feature_files(mapping: LogMapping) -> Iterator[Path]:
    """Files of one row per item or user; a table with `first_by` may be the log itself."""
    for table in (*mapping.item_features, *mapping.user_features):
        if not table.first_by:
            yield from log_files(table.files)


DATASET: Final = Dataset(
    summary="any Parquet or CSV log, columns mapped by name; features in items.* and users.*",
    resolve=_resolve,
)
