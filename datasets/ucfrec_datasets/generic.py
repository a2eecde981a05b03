"""Any log: columns mapped by the user, features in files next to the log."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping, log_files, table_name

Resolved = tuple[tuple[Path, ...], LogMapping]
"""The logs among some paths, and the mapping with that of their data set."""


def _resolve(paths: Sequence[str | Path], mapping: LogMapping) -> Resolved:
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
    # A table with `first_by`, of several rows per item or user, may be the log itself.
    tables = (*mapping.item_features, *mapping.user_features)
    table_files = (file for t in tables if not t.first_by for file in log_files(t.files))
    features = {file.resolve() for file in (*items, *users, *table_files)}
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

    A log is called `log`, or is named by itself and not called as the `features` are. Raises
    InputError if there is none.
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
    """The files of a name as one table, of a name with `_` at its end all that begin with it.

    Of files with the same name, only the first counts; empty if there is none.
    """
    by_name = {
        stem(file): file
        for file in reversed(files)
        if stem(file) == name or (name.endswith("_") and file.name.startswith(name))
    }
    parts = tuple(by_name[part] for part in sorted(by_name))
    return (FeatureTable(parts, key, columns, first_by),) if parts else ()


def stem(file: Path) -> str:
    """The name of a file without its endings."""
    return file.name.partition(".")[0]


DATASET: Final = Dataset(
    summary="any Parquet or CSV log, columns mapped by name; features in items.* and users.*",
    resolve=_resolve,
)
