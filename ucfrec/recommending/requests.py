"""One user's request for recommendations, as JSON, the history that it holds, and its rewards."""

import json
import math
import time
from array import array
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NotRequired

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StrictFloat,
    StrictInt,
    ValidationError,
)

# Of typing's TypedDict, pydantic cannot read the configuration before Python 3.12.
from typing_extensions import TypedDict

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array
from ucfrec.episodes.store import LONGEST_HISTORY
from ucfrec.errors import InputError
from ucfrec.logs.engine import bind, engine, explain_errors
from ucfrec.logs.expressions import Expression, columns_of, computes_with_reward
from ucfrec.logs.histories import FrameTable, Histories
from ucfrec.logs.rows import DAY_MS, choose_rows
from ucfrec.logs.tables import is_number
from ucfrec.settings import settings_table

_Integer = Annotated[StrictInt, Field(ge=-(2**63), lt=2**63)]
"""Of 64 bits: the largest that identifiers have, and small enough to be a float."""
Id = _Integer | Annotated[str, Field(max_length=1000)]
Number = Annotated[StrictFloat, Field(allow_inf_nan=False)] | _Integer
_EARLIEST_MS = 365 * DAY_MS
"""Times before 1971 are hardly milliseconds; seconds of today would be there."""
_LARGEST_FLOAT = float(np.finfo(np.float32).max)
_MOST_FAULTS = 1000
"""Beyond this number, it would take too long to look at each."""
_TYPES = ("constrained-str", "float", "constrained-int", "int", "str")
"""Last part of pydantic's place of an error in one of several types."""
_ROWS = "history"
"""Name of the rows in messages and in the engine."""
_MEMORY = "512MB"
"""Half of it is the engine's: a request has some megabytes, and no expression needs much more."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
TIME_FORMS = "give milliseconds, or an ISO 8601 time such as 2024-05-01T10:00:00+02:00"


def parse_time(value: float | str) -> float:
    """A time of a request in milliseconds since 1970; ValueError for text that is not ISO 8601."""
    if not isinstance(value, str):
        return value
    if value.isdecimal():
        return float(value)
    try:
        time = datetime.fromisoformat(value.strip())
        return (time.replace(tzinfo=time.tzinfo or UTC) - _EPOCH) // timedelta(milliseconds=1)
    except (ValueError, OverflowError):
        raise ValueError(TIME_FORMS) from None


@settings_table("")
class Limits:
    """The largest request that is answered."""

    bytes: Annotated[int, Field(ge=1_000, le=2**30)] = 2**21
    """Bytes of a request's JSON."""
    k: Annotated[int, Field(ge=1, le=1_000_000)] = 1_000
    """Items that may be requested."""
    history: Annotated[int, Field(ge=1, le=1_000_000)] = 5_000
    """Rows of a user's history."""
    candidates: Annotated[int, Field(ge=1, le=10_000_000)] = 10_000
    """Items in a list of candidates."""


class Row(TypedDict):
    """One interaction of the user; other entries are feedback, for the run's reward."""

    __pydantic_config__ = ConfigDict(extra="allow", strict=True)  # type: ignore[misc]

    item_id: Id
    timestamp: Annotated[
        Number | Annotated[str, Field(max_length=64)],
        Field(description="Milliseconds since 1970, UTC; or ISO 8601 text, UTC without a zone."),
        AfterValidator(parse_time),
    ]
    reward: NotRequired[
        Annotated[Number, Field(description="Without it, the run's reward of the feedback.")]
    ]
    session_id: NotRequired[Id]
    position: NotRequired[Annotated[Number, Field(description="Place in the list shown.")]]
    observation: NotRequired[Annotated[list[Number], Field(max_length=100_000, fail_fast=True)]]


class Request(BaseModel):
    """A user, what they were shown, and what is requested.

    Lists are read up to their first fault: a message about every element would take seconds.
    """

    model_config = ConfigDict(extra="forbid", strict=True, use_attribute_docstrings=True)

    user_id: Id
    """Identifier in the training logs, or any other."""
    history: Annotated[list[Row], Field(fail_fast=True)] = []
    """The user's interactions, in any order; empty for a new user."""
    k: Annotated[int, Field(ge=1)] | None = None
    """Number of items."""
    # Not `Id`, as checking the range of every one takes as long as reading it.
    candidates: Annotated[list[int | str], Field(min_length=1, fail_fast=True)] | None = None
    """The only items to recommend."""
    new_session: bool | None = None
    """Whether the user begins a new session, or the latest one of the history goes on. Without it,
    a pause since then that is longer than the run's gap ends that one."""
    request_id: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """Identifies the request: a repetition gets the same items. Without one, the server makes one.
    """


class StreamRequest(Request):
    """A request of a stream, which remembers its users."""

    interactions: Annotated[list[Row], Field(fail_fast=True)] = []
    """Rows after the history or, without one, after what the stream has had of the user."""


def parse(kind: type[Request], text: bytes, limits: Limits) -> Any:
    """Read a request of a kind, `Request` or a subclass; InputError for another or a larger one."""
    if len(text) > limits.bytes:
        raise InputError(f"the request has more than {limits.bytes:,} bytes; send fewer rows")
    try:
        request = kind.model_validate_json(text)
    except ValidationError as error:
        if (faults := error.error_count()) > _MOST_FAULTS:
            raise InputError(
                f"the request has {faults:,} faults; most are entries that requests do not have"
            ) from None
        raise InputError(_describe(error.errors(include_url=False))) from None
    counts = {
        "items (k)": (request.k or 1, limits.k),
        "rows of history": (len(request.history), limits.history),
        "candidates": (len(request.candidates or ()), limits.candidates),
        "interactions": (len(getattr(request, "interactions", ())), limits.history),
    }
    for name, (count, most) in counts.items():
        if count > most:
            raise InputError(f"{count:,} {name}: the limit is {most:,}; request less")
    return request


def _describe(errors: Sequence[Any]) -> str:
    """The first of pydantic's errors in one line, and how many there are: one a place."""
    first = errors[0]
    places = [tuple(part for part in error["loc"] if part not in _TYPES) for error in errors]
    if first["type"] == "json_invalid":
        return f"the request is not JSON ({_uncapitalise(first['msg'])})"
    where = ".".join(map(str, places[0])) or "the request"
    more = len(set(places)) - 1
    same = zip(errors, places, strict=True)
    texts = (e["msg"] for e, place in same if place == places[0])
    messages = dict.fromkeys(map(_uncapitalise, texts))
    value = first.get("input")
    actual = "" if isinstance(value, dict | list) else f", not {json.dumps(value, default=str):.60}"
    return (
        f"{where}: {' or '.join(messages)}{actual}"
        f"{f'; {more} more fault' + 's' * (more > 1) if more else ''}"
    )


def _uncapitalise(message: str) -> str:
    message = message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:]


class RowRewards:
    """Computes the rewards of rows, one request after the other; not for several threads at once.

    A row's `reward` counts, unless the run's reward expression computes with a column of that name.
    Rows without one have feedback, from which that expression makes it: at once if it is the name
    of a column, otherwise by the engine, which takes some milliseconds.
    """

    def __init__(self, expression: Expression) -> None:
        self._expression = expression
        self._computed = computes_with_reward(expression)
        self._stack = ExitStack()
        self.close = self._stack.close
        """Close the engine."""

    @cached_property
    def _connection(self) -> duckdb.DuckDBPyConnection:
        return self._stack.enter_context(engine((), None, _MEMORY))

    def of_rows(self, rows: Sequence[Mapping[str, Any]]) -> list[float]:
        """Rewards (N,) of rows; InputError for one that is missing, not finite or too large."""
        if not rows:
            return []
        rewards = [row.get(schema.REWARD) for row in rows]
        if not self._computed and any(value is not None for value in rewards):
            return _require_numbers(rewards, f"no {schema.REWARD}, as other rows have")
        name = str(self._expression)
        if name.isidentifier():
            either = "no" if name == schema.REWARD else f"neither {schema.REWARD} nor"
            return _require_numbers(_column(rows, name), f"{either} {name}")
        return _require_numbers(self._evaluate(rows), "no reward")

    def _evaluate(self, rows: Sequence[Mapping[str, Any]]) -> list[Any]:
        connection = self._connection
        source = Path(_ROWS)
        names = {name.casefold() for row in rows for name in row}
        columns: dict[str, Any] = {}
        for name in columns_of(connection, self._expression):
            if name.casefold() not in names:
                what = f"no {name}" if self._computed else f"neither {schema.REWARD} nor {name}"
                raise InputError(
                    f"history has {what}, which the run's reward ({self._expression}) needs; give "
                    f"{'it' if self._computed else 'one of them'}"
                )
            try:
                columns[name] = pa.array(_column(rows, name))
            except (pa.ArrowException, OverflowError) as error:
                reason = str(error).splitlines()[0]
                raise InputError(
                    f"history: {name} has values of several types ({reason})"
                ) from None
        connection.register(_ROWS, pa.table(columns or {_ROWS: [0] * len(rows)}))  # a constant
        described = connection.sql(f"DESCRIBE {_ROWS}").fetchall()
        table = FrameTable((source,), tuple((row[0], row[1]) for row in described))
        try:
            with explain_errors(connection, (table,)):
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


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """The entry `name` of each row, in whatever case it is written; None where there is none."""
    folded = name.casefold()
    return [
        next((row[n] for n in row if n.casefold() == folded and row[n] is not None), None)
        if row.get(name) is None
        else row[name]
        for row in rows
    ]


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


class HistoryReader(NamedTuple):
    """Cleans the rows of requests as `ucfrec recommend` cleans those of a log."""

    duplicates: str
    """See `ucfrec.logs.prepare.PrepareOptions.duplicates`."""
    by_session_id: bool
    observation_size: int
    """Of the logs: columns that the policy does not see are given too."""
    rewards: RowRewards
    """Has to be closed."""

    def read(self, rows: Sequence[Row], user_id: int | str) -> Histories:
        """The history of the rows of one user; InputError for a row that lacks something, or has a
        time or reward that cannot be used."""
        if self.observation_size and not rows:
            raise InputError("the policy needs the last observation; give a row of history with it")
        items = id_array([row["item_id"] for row in rows])
        columns = {
            "user": np.repeat(id_array([user_id]), len(rows)),
            schema.TIMESTAMP: np.asarray(_read_times(rows), dtype=np.int64),
            schema.ITEM: items,
            "row": np.arange(len(rows)),
            schema.POSITION: np.asarray([row.get("position", np.inf) for row in rows], dtype=float),
        }
        sessions = None
        if self.by_session_id:
            ids: list[Any] = [row.get("session_id") for row in rows]
            if None in ids:
                raise InputError(
                    f"history.{ids.index(None)} has no session_id, by which the run splits sessions"
                )
            sessions = id_array(ids)
            columns["session"] = np.unique(sessions, return_inverse=True)[1]
        if self.observation_size:
            observed: list[Any] = [row.get("observation") or () for row in rows]
            if {*map(len, observed)} == {self.observation_size}:
                columns[schema.OBSERVATION] = np.asarray(observed, dtype=np.float64)
        columns[schema.REWARD] = np.asarray(self.rewards.of_rows(rows), dtype=np.float64)
        order = choose_rows(columns, self.duplicates)[-LONGEST_HISTORY:]
        observations = None
        if self.observation_size:
            latest = int(order[-1])
            observations = self._require_observation(observed[latest], latest)
        seen = pd.unique(items)
        return Histories(
            users=id_array([user_id]),
            owner=np.zeros(len(order), dtype=np.int64),
            item_ids=items[order],
            rewards=columns[schema.REWARD][order].astype(np.float32),
            timestamps=columns[schema.TIMESTAMP][order],
            session_ids=None if sessions is None else sessions[order],
            seen_owner=np.zeros(len(seen), dtype=np.int64),
            seen_ids=seen,
            observations=observations,
        )

    def _require_observation(self, values: Sequence[float], row: int) -> Float32Array:
        if len(values) != self.observation_size:
            raise InputError(
                f"history.{row}: the observation has {len(values)} numbers; the policy needs "
                f"{self.observation_size}"
            )
        if max(map(abs, values)) > _LARGEST_FLOAT:
            raise InputError(
                f"history.{row}: the observation has numbers beyond ±{_LARGEST_FLOAT:.2g}"
            )
        return np.asarray([values], dtype=np.float32)


def _read_times(rows: Sequence[Row]) -> list[int]:
    latest = time.time() * 1000 + DAY_MS
    # DuckDB rounds halves away from zero.
    times = [math.floor(float(row["timestamp"]) + 0.5) for row in rows]
    for n, when in enumerate(times):
        if not _EARLIEST_MS <= when <= latest:
            raise InputError(
                f"history.{n}: timestamp {rows[n]['timestamp']} is before 1971 or more than a day "
                "ahead of now; give milliseconds since 1970, or ISO 8601 text"
            )
    return times


def id_array(ids: Sequence[int | str]) -> Array:
    """Identifiers as int64 if all are integers of 64 bits, otherwise as text."""
    try:
        return np.asarray(array("q", ids), dtype=np.int64)  # type: ignore[type-var]
    except (TypeError, OverflowError):
        return np.asarray(list(map(str, ids)), dtype=object)
