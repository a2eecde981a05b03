"""Further columns of logs, beside what a policy was trained on: measures, and groups."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import duckdb
import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.engine import bind, engine, explain_errors, text_of_column
from ucfrec.logs.expressions import Expression
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.prepare import PrepareOptions, feature_tables, prepare
from ucfrec.logs.tables import Table, open_tables
from ucfrec.logs.typed import open_log_tables
from ucfrec.off_policy.guardrails import Groups

MOST_GROUPS: Final = 20


def read_measure(
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    like: Path,
    keep_unknown: bool,
    measure: str,
    store: EpisodeStore,
) -> Float64Array:
    """(N,) values of an expression at the steps of a `store` that was prepared from logs with these
    options; InputError if other rows have one."""
    options = replace(options, reward=Expression(measure, "--guardrail"))
    folder = store.path.with_name(f"measure-{measure.encode().hex():.99}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputNote)
        prepare(files, mapping, folder, options, like, keep_unknown)
    values = EpisodeStore.open(folder)
    if values.n_steps != store.n_steps:
        raise InputError(
            f"{files[0]}: --guardrail {measure} has a value in {values.n_steps:,} rows, the reward "
            f"in {store.n_steps:,}; give a default, such as coalesce({measure}, 0)"
        )
    return values.column(schema.REWARD).astype(np.float64)


def read_groups(
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    column: str,
    ids: dict[str, tuple[Array, IntArray]],
) -> Groups:
    """Groups by a column of a feature table, or by one of the logs that has one value per user, or
    per item.

    Args:
        ids: of USER_ID and ITEM_ID: (n,) the ids, and (N,) the place there of each step's.

    Raises:
        InputError: there is no such column, or it has too many values, or several per id.
    """
    folder = options.temp_folder or files[0].parent
    parts = (part for tables in feature_tables(mapping).values() for part in tables)
    inputs = [*files, *(file for part in parts for file in log_files(part.files))]
    with engine(inputs, folder, options.memory_limit) as connection:
        for key, tables in _find_tables(connection, files, mapping, options, column):
            values = dict[str, str]()
            with explain_errors(connection, [table for table, _ in tables]):
                rows = [_read_values(connection, *table, key, column) for table in tables]
            for row in (row for part in rows for row in part):
                if row[2] > 1 or values.setdefault(row[0], row[1]) != row[1]:
                    break
            else:
                return _group_steps(column, values, *ids[key], key == schema.ITEM_ID)
    raise InputError(f"{files[0]}: --by {column}: a user, and an item, has several values of it")


def _find_tables(
    connection: duckdb.DuckDBPyConnection,
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    column: str,
) -> Iterator[tuple[str, list[tuple[Table, str]]]]:
    """Id column and the tables that may have a value for each id, with what the id is there."""
    for key, features in feature_tables(mapping).items():
        opened = [
            (table, part.key)
            for part in features
            for table in open_tables(connection, log_files(part.files))
        ]
        if named := [pair for pair in opened if column in pair[0].columns]:
            yield key, named
            return
    log = open_log_tables(connection, files, mapping, options.reward or "0", options.session_by)
    for key in (schema.USER_ID, schema.ITEM_ID):
        yield key, [(t, text_of_column(connection, t, log.mapping, key)) for t in log.tables]


def _read_values(
    connection: duckdb.DuckDBPyConnection, table: Table, id_: str, key: str, column: str
) -> list[tuple[str, str, int]]:
    """Each id with a value of the column, and how many values it has."""
    named, by = bind(connection, table, key, id_), bind(connection, table, "--by", column)
    texts = named.columns if named.is_column else ()
    text = table.text_of(texts[0]) if texts else f"CAST({named.sql} AS VARCHAR)"
    source = table.with_texts([*named.columns, *by.columns], texts).sql
    value = f"CAST({by.sql} AS VARCHAR)"
    return connection.execute(
        f"SELECT {text} AS id, min({value}), count(DISTINCT {value}) FROM {source} "
        f"WHERE {text} IS NOT NULL AND {value} IS NOT NULL GROUP BY id"
    ).fetchall()


def _group_steps(
    column: str, values: dict[str, str], ids: Array, place: IntArray, of_items: bool
) -> Groups:
    """The groups of steps, at a place each in the ids (n,), the largest first."""
    of_id, lookup = np.full(len(ids) + 1, -1), IdLookup(ids).numbers(np.array([*values], object))
    names, codes = np.unique([*values.values()], return_inverse=True)
    of_id[lookup[lookup >= 0]] = codes[lookup >= 0]
    number = of_id[place]
    sizes = np.bincount(number[number >= 0], minlength=len(names))
    if not 0 < np.count_nonzero(sizes) <= MOST_GROUPS:
        raise InputError(
            f"--by {column} has {np.count_nonzero(sizes):,} values in these logs; name a column of "
            f"1 to {MOST_GROUPS} values"
        )
    order = np.argsort(-sizes, kind="stable")[: np.count_nonzero(sizes)]
    rank = np.append(np.full(len(names), -1), -1)
    rank[order] = np.arange(len(order))
    return Groups(tuple(str(names[code]) for code in order), rank[number], of_items)
