"""Which columns of a later log are those that a run remembers of its training log."""

from collections.abc import Sequence
from dataclasses import replace

import duckdb

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.expressions import NotScalarError, columns_of
from ucfrec.logs.mapping import KEY_COLUMNS, LogMapping
from ucfrec.logs.tables import Table


def settled(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[Table],
    mapping: LogMapping,
    reward: str,
) -> tuple[LogMapping, str]:
    """The mapping and the reward of a log, whose columns have the names of a run's training log or
    the plain ones.

    What is given counts. Otherwise a remembered column, condition or reward counts if all files
    have the columns that it needs; if not, the plain name does, and no condition. The column
    `reward` stands for the reward of a log whose columns were mapped.

    Raises:
        InputError: a file has neither the remembered column nor the plain one that it must have.
    """
    remembered = mapping.remembered
    if remembered is None:
        return mapping, reward
    missing = _Missing(connection, tables)
    columns = dict(mapping.columns)
    for name, text in remembered.columns.items():
        if name in columns:
            continue
        if not text or missing.of(text) is None:
            columns[name] = text
        elif name in KEY_COLUMNS and (table := missing.of(name)) is not None:
            raise InputError(
                f"{table.files[0]} has neither {str(text)!r}, which is {name} in the log that the "
                f"run was trained on, nor a column {name!r}; map it with --column {name}=..."
            )
    usual = remembered.columns.get(schema.TIMESTAMP) or schema.TIMESTAMP
    if mapping.time_format is None and (columns.get(schema.TIMESTAMP) or schema.TIMESTAMP) == usual:
        mapping = replace(mapping, time_format=remembered.time_format)
    where = mapping.where
    if where is None and remembered.where and missing.of(remembered.where) is None:
        where = remembered.where
    mapped = any(remembered.columns.values())
    if mapped and missing.of(reward) is not None and missing.of(schema.REWARD) is None:
        reward = schema.REWARD
    return replace(mapping, columns=columns, where=where, remembered=None), reward


class _Missing:
    """Finds tables that lack a column that an expression needs."""

    def __init__(self, connection: duckdb.DuckDBPyConnection, tables: Sequence[Table]) -> None:
        self._connection, self._tables = connection, tables
        self._names = [{name.casefold() for name in table.columns} for table in tables]

    def of(self, text: str) -> Table | None:
        """The first of them; None if all tables have what the column or expression reads."""
        for table, names in zip(self._tables, self._names, strict=True):
            if text.casefold() in names:
                continue
            if text.isidentifier():
                return table
            try:
                needed = columns_of(self._connection, text)
            except (duckdb.Error, NotScalarError):
                # It is refused where it is bound, with the reason.
                continue
            if not {name.casefold() for name in needed} <= names:
                return table
        return None
