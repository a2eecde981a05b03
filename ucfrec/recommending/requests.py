"""One user's request for recommendations, as JSON, and the history that it holds."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Final, NamedTuple, NotRequired

import numpy as np
import pandas as pd
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
from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.episodes.earlier import LONGEST_HISTORY
from ucfrec.errors import InputError
from ucfrec.logs.kept import DAY_MS, kept_in_order
from ucfrec.recommending.row_rewards import RowRewards
from ucfrec.runs.later_logs import reward_of
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import settings_table

_Integer = Annotated[StrictInt, Field(ge=-(2**63), lt=2**63)]
"""Of 64 bits: the largest that identifiers have, and small enough to be a float."""
Id = _Integer | Annotated[str, Field(max_length=1000)]
Number = Annotated[StrictFloat, Field(allow_inf_nan=False)] | _Integer
_EARLIEST_MS: Final = 365 * DAY_MS
"""Times before 1971 are hardly milliseconds; seconds of today would be there."""
_LARGEST_FLOAT: Final = float(np.finfo(np.float32).max)
_MOST_FAULTS: Final = 1000
"""Beyond this number, it would take too long to look at each."""
_SHOWN: Final = 60
"""Most characters of a wrong value in a message."""


def _milliseconds(given: float | str) -> float:
    """A time of a request in milliseconds since 1970.

    Raises:
        ValueError: it is text, but not of ISO 8601.
    """
    if not isinstance(given, str):
        return given
    try:
        time = datetime.fromisoformat(given.strip())
        return (time.replace(tzinfo=time.tzinfo or UTC) - _EPOCH) // timedelta(milliseconds=1)
    except (ValueError, OverflowError):
        raise ValueError(
            "give milliseconds, or an ISO 8601 time such as 2024-05-01T10:00:00+02:00"
        ) from None


_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


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
        AfterValidator(_milliseconds),
    ]
    reward: NotRequired[
        Annotated[Number, Field(description="Without it, the run's reward of the feedback.")]
    ]
    session_id: NotRequired[Id]
    observation: NotRequired[Annotated[list[Number], Field(max_length=100_000, fail_fast=True)]]


class Request(BaseModel):
    """A user, what they were shown, and what is requested.

    Lists are read up to their first fault: a message about every element would take seconds.
    """

    model_config = ConfigDict(extra="forbid", strict=True)

    user_id: Id
    """Identifier in the training logs, or any other."""
    history: Annotated[
        list[Row],
        Field(
            description="The user's interactions, in any order; empty for a new user.",
            fail_fast=True,
        ),
    ] = []
    k: Annotated[int, Field(ge=1, description="Number of items.")] | None = None
    candidates: (
        Annotated[
            list[Id],
            Field(min_length=1, description="The only items to recommend.", fail_fast=True),
        ]
        | None
    ) = None
    new_session: Annotated[
        bool,
        Field(
            description="Whether the user begins a new session. Otherwise the latest one of the "
            "history goes on."
        ),
    ] = False
    request_id: (
        Annotated[
            str,
            Field(
                min_length=1,
                max_length=200,
                description="Identifies the request: a repetition gets the same items. Without "
                "one, the server makes one.",
            ),
        ]
        | None
    ) = None


class StreamRequest(Request):
    """A request of a stream, which remembers its users."""

    interactions: Annotated[list[Row], Field(fail_fast=True)] = []
    """Rows that are added to the history or, without one, to what the stream has had of the
    user."""


class UserHistory(NamedTuple):
    """What a request says about its user: n rows in the order of time."""

    item_ids: Array
    """(n,) integers or text."""
    rewards: Float32Array
    """(n,) in reward units."""
    timestamps: IntArray
    """(n,) milliseconds."""
    session_ids: Array | None
    """(n,) integers or text; None if sessions are not split by them."""
    seen: Array
    """(m,) all items of the request's rows, also of those before the n."""
    observation: list[float] | None
    """(O,) of the last row; None if the policy has none."""


def parsed(kind: type[Request], text: bytes, limits: Limits) -> Any:
    """Read a request.

    Args:
        kind: `Request` or a subclass.

    Raises:
        InputError: it is not such a request, or too large.
    """
    if len(text) > limits.bytes:
        raise InputError(f"the request has more than {limits.bytes:,} bytes; send fewer rows")
    try:
        request = kind.model_validate_json(text)
    except ValidationError as error:
        if (faults := error.error_count()) > _MOST_FAULTS:
            raise InputError(
                f"the request has {faults:,} faults; most are entries that requests do not have"
            ) from None
        raise InputError(fault_of(error.errors(include_url=False))) from None
    require_within(request, limits)
    return request


def fault_of(errors: Sequence[Any]) -> str:
    """The first of pydantic's errors in one line, and how many there are: one a place."""
    first, faults = errors[0], len({_place(error) for error in errors})
    if first["type"] == "json_invalid":
        return f"the request is not JSON ({_lower(first['msg'])})"
    where = ".".join(map(str, _place(first))) or "the request"
    given = first.get("input")
    shown = "" if isinstance(given, (dict, list)) else f", not {_short(given)}"
    more = f"; {faults - 1} more fault{'s' * (faults > 2)}" if faults > 1 else ""
    return f"{where}: {_wanted(errors)}{shown}{more}"


def _wanted(errors: Sequence[Any]) -> str:
    """What the place of the first error takes."""
    first = errors[0]
    same = [error for error in errors if _place(error) == _place(first)]
    if len(same) == 1:
        return _lower(first["msg"])
    for error in same:
        if error["type"] == "string_too_long":
            return _lower(error["msg"])
    kinds = {error["loc"][-1] for error in same}
    if "float" in kinds:
        kinds.discard("constrained-int")
    return f"give {' or '.join(words for kind, words in _KINDS.items() if kind in kinds)}"


def _place(error: Any) -> tuple[str | int, ...]:
    """Where an error is, whichever of the types that the place takes it is about."""
    place: tuple[str | int, ...] = error["loc"]
    named = error["type"] == "extra_forbidden" or place[-1:] == () or place[-1] not in _KINDS
    return place if named else place[:-1]


def _lower(message: str) -> str:
    message = message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:]


_KINDS: Final = {
    "constrained-str": "text",
    "float": "a finite number",
    "constrained-int": "an integer of 64 bits",
}
"""Last part of pydantic's place of an error in one of several types, and what that type takes."""


def _short(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def require_within(request: Request, limits: Limits) -> None:
    """Check the limits of a request, but for its bytes.

    Raises:
        InputError: it requests too much.
    """
    counts = {
        "items (k)": (request.k or 1, limits.k),
        "rows of history": (len(request.history), limits.history),
        "candidates": (len(request.candidates or ()), limits.candidates),
    }
    if isinstance(request, StreamRequest):
        counts["interactions"] = (len(request.interactions), limits.history)
    for name, (given, most) in counts.items():
        if given > most:
            raise InputError(f"{given:,} {name}: the limit is {most:,}; request less")


@dataclass(frozen=True)
class HistoryReader:
    """Cleans the rows of requests as `ucfrec recommend` cleans those of a log."""

    duplicates: str
    """See `ucfrec.logs.prepare.PrepareOptions.duplicates`."""
    by_session_id: bool
    observation_size: int
    """Of the logs: columns that the policy does not see are given too."""
    rewards: RowRewards

    @classmethod
    def of(cls, trained: TrainedPolicy) -> "HistoryReader":
        """The reader for a policy; its `rewards` have to be closed."""
        return cls(
            trained.record.data.duplicates,
            trained.record.session_by == schema.SESSION_ID,
            trained.logged_observation_size,
            RowRewards(reward_of(trained)),
        )

    def read(self, rows: Sequence[Row], user_id: int | str) -> UserHistory:
        """The history of the rows of one user.

        Raises:
            InputError: a row lacks something, or has a time or reward that cannot be used.
        """
        if self.observation_size and not rows:
            raise InputError("the policy needs the last observation; give a row of history with it")
        items = id_array([row["item_id"] for row in rows])
        columns = {
            "user": np.zeros(len(rows), dtype=np.int64),
            schema.TIMESTAMP: np.asarray(_times(rows), dtype=np.int64),
            schema.ITEM: items,
            "row": np.arange(len(rows)),
        }
        sessions = None
        if self.by_session_id:
            _require(rows, schema.SESSION_ID)
            sessions = id_array([row["session_id"] for row in rows])
            columns["session"] = np.unique(sessions, return_inverse=True)[1]
        if self.observation_size:
            given = [row.get("observation") or () for row in rows]
            if {*map(len, given)} == {self.observation_size}:
                columns[schema.OBSERVATION] = np.asarray(given, dtype=np.float64)
        columns[schema.REWARD] = np.asarray(self.rewards.of_rows(rows), dtype=np.float64)
        order = kept_in_order(columns, self.duplicates, user_id)[-LONGEST_HISTORY:]
        observation = None
        if self.observation_size:
            observation = self._observation(rows, int(order[-1]))
        return UserHistory(
            items[order],
            columns[schema.REWARD][order].astype(np.float32),
            columns[schema.TIMESTAMP][order],
            None if sessions is None else sessions[order],
            pd.unique(items),
            observation,
        )

    def _observation(self, rows: Sequence[Row], last: int) -> list[float]:
        given = rows[last].get("observation")
        if given is None or len(given) != self.observation_size:
            size = "none" if given is None else f"{len(given)} numbers"
            raise InputError(
                f"history.{last}: the observation has {size}; the policy needs "
                f"{self.observation_size}"
            )
        if max(map(abs, given)) > _LARGEST_FLOAT:
            raise InputError(
                f"history.{last}: the observation has numbers beyond ±{_LARGEST_FLOAT:.2g}"
            )
        return [float(value) for value in given]


def _times(rows: Sequence[Row]) -> list[int]:
    latest = time.time() * 1000 + DAY_MS
    times = []
    for n, row in enumerate(rows):
        # DuckDB rounds halves away from zero.
        when = math.floor(float(row["timestamp"]) + 0.5)
        if not _EARLIEST_MS <= when <= latest:
            raise InputError(
                f"history.{n}: timestamp {row['timestamp']} is before 1971 or more than a day "
                "ahead of now; give milliseconds since 1970, or ISO 8601 text"
            )
        times.append(when)
    return times


def id_array(ids: Sequence[int | str]) -> Array:
    """Identifiers as int64 if all are integers, otherwise as text."""
    if all(isinstance(each, int) for each in ids):
        return np.asarray(ids, dtype=np.int64)
    return np.asarray(list(map(str, ids)), dtype=object)


def _require(rows: Sequence[Mapping[str, Any]], name: str) -> None:
    for n, row in enumerate(rows):
        if row.get(name) is None:
            raise InputError(f"history.{n} has no {name}, by which the run splits sessions")
