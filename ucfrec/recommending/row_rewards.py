"""Rewards of rows in memory: as given, or by a run's reward expression."""

import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import duckdb
import pyarrow as pa

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.engine import bind, engine_in_memory, explain_errors
from ucfrec.logs.expressions import Expression, columns_of, computes_with_reward
from ucfrec.logs.histories import FrameTable
from ucfrec.logs.tables import is_number

_ROWS: Final = "history"
"""Name of the rows in messages and in the engine."""
_MEMORY: Final = "256MB"
"""Of the engine: a request is some megabytes, and no expression makes much more of it."""
_NAME: Final = re.compile(r"[A-Za-z_]\w*")


class RowRewards:
    """Computes the rewards of rows, one request after the other; not for several threads at once.

    A row's `reward` counts, unless the run's reward expression computes with a column of that name.
    Rows without one have feedback, from which that expression makes it: at once if it is the name
    of a column, otherwise by the engine, which takes some milliseconds.
    """

    def __init__(self, expression: Expression) -> None:
        self._expression, self._computed = expression, computes_with_reward(expression)
        self._stack = ExitStack()
        self._connection: duckdb.DuckDBPyConnection | None = None

    def close(self) -> None:
        """Close the engine."""
        self._stack.close()

    def of_rows(self, rows: Sequence[Mapping[str, Any]]) -> list[float]:
        """Rewards (N,) of rows.

        Raises:
            InputError: a reward or feedback is missing, not finite or too large.
        """
        if not rows:
            return []
        rewards = [row.get(schema.REWARD) for row in rows]
        if not self._computed and any(value is not None for value in rewards):
            return _require_numbers(rewards, f"no {schema.REWARD}, as other rows have")
        name = str(self._expression)
        if _NAME.fullmatch(name):
            either = "no" if name == schema.REWARD else f"neither {schema.REWARD} nor"
            return _require_numbers(_column(rows, name), f"{either} {name}")
        return _require_numbers(self._evaluate(rows), "no reward")

    def _evaluate(self, rows: Sequence[Mapping[str, Any]]) -> list[Any]:
        if self._connection is None:
            self._connection = self._stack.enter_context(engine_in_memory(_MEMORY))
        connection = self._connection
        names = {name.casefold() for row in rows for name in row}
        columns = {}
        for name in columns_of(connection, self._expression):
            values = _column(rows, name)
            if name.casefold() not in names:
                what = f"no {name}" if self._computed else f"neither {schema.REWARD} nor {name}"
                raise InputError(
                    f"history has {what}, which the run's reward ({self._expression}) needs; give "
                    f"{'it' if self._computed else 'one of them'}"
                )
            try:
                columns[name] = pa.array(values)
            except (pa.ArrowException, OverflowError) as error:
                reason = str(error).splitlines()[0]
                raise InputError(
                    f"history: {name} has values of several types ({reason})"
                ) from None
        source = Path(_ROWS)
        connection.register(_ROWS, pa.table(columns))
        try:
            described = connection.sql(f"DESCRIBE {_ROWS}").fetchall()
            table = FrameTable((source,), tuple((row[0], row[1]) for row in described))
            try:
                with explain_errors(connection, (table,), source):
                    sql, kind, *_ = bind(connection, table, "for the reward", self._expression)
                    query = f"SELECT TRY(CAST({sql} AS DOUBLE)) FROM {table.sql}"
                    values = [row[0] for row in connection.sql(query).fetchall()]
            except InputError:
                # Its text names files of the server.
                types = ", ".join(f"{row[0]} is {row[1]}" for row in described)
                raise InputError(
                    f"history: the run's reward ({self._expression}) cannot be computed where "
                    f"{types}; give values of the types that the training log has"
                ) from None
            if not (is_number(kind) or kind == "BOOLEAN"):
                raise InputError(f"history: the run's reward is {kind} here; give numbers")
            return values
        finally:
            connection.unregister(_ROWS)


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """The entry `name` of each row, in whatever case it is written; None where there is none."""
    values = [row.get(name) for row in rows]
    if any(value is None for value in values):
        folded = name.casefold()
        for column in set().union(*rows) - {name}:
            if column.casefold() == folded:
                more = (row.get(column) for row in rows)
                values = [b if a is None else a for a, b in zip(values, more, strict=True)]
    return values


def _require_numbers(values: Sequence[Any], missing: str) -> list[float]:
    for n, value in enumerate(values):
        if value is None:
            raise InputError(f"history.{n} has {missing}; give every row its reward")
        # Integers of JSON have any number of digits, more than a float has: they are only compared.
        if not isinstance(value, (int, float)) or not abs(value) <= schema.LARGEST_REWARD:
            raise InputError(
                f"history.{n}: the reward is {value!r:.60}; give a number within "
                f"±{schema.LARGEST_REWARD:g}"
            )
    return [float(value) for value in values]
