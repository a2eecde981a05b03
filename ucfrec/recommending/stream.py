"""Recommendations as a stream: lines of requests in, lines of answers out."""

from collections import Counter, OrderedDict
from collections.abc import Iterator, Sequence
from typing import IO, Any, Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import json_text
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.requests import Limits, Request, Row, StreamRequest, parse
from ucfrec.recommending.responder import Responder, exact_id

REMEMBERED: Final = 1_000_000
"""Rows that a stream keeps; the least recently active users are dropped first."""
_BLOCK: Final = 2**16
_AT_ONCE: Final = 256
"""Most requests of a forward pass."""


_Line = tuple[int, bytes | None]
"""Number of a line, from 1, and what it holds; None if it is too long."""
_Read = tuple[int, StreamRequest | InputError]
"""Number of a line, and the request, or what is wrong with it."""


def answer_stream(
    responder: Responder,
    source: IO[bytes],
    sink: IO[bytes],
    remember: int = REMEMBERED,
    exposures: ExposureLog | None = None,
) -> Counter[str]:
    """Answer every line of `source` until it ends: the nth answer is that of the nth line.

    What has arrived is answered with one forward pass, and each answer is written at once. A line
    that is not a request, a blank one too, is answered with `{"error": …, "line": …}`, and the
    stream goes on. Returns the numbers of `answers` and `errors`.

    Args:
        source: lines of JSON, UTF-8, unbuffered; see `ucfrec.recommending.requests.StreamRequest`.
        remember: rows that are remembered, of all users together.
        exposures: gets every answer; None for none.
    """
    counts, remembered = Counter[str](), _Remembered(remember, responder.limits)
    for lines in _read_lines(source, responder.limits.bytes):
        for answer in _answer(responder, remembered, lines, exposures):
            sink.write(json_text(answer).encode() + b"\n")
            counts["errors" if "error" in answer else "answers"] += 1
        sink.flush()
    return counts


def _answer(
    responder: Responder,
    remembered: "_Remembered",
    lines: Sequence[_Line],
    exposures: ExposureLog | None,
) -> Iterator[dict[str, Any]]:
    """The answers to lines."""
    waiting: list[_Read] = []
    users: set[str] = set()
    for number, line in lines:
        request = _parse_line(line, responder.limits)
        user = None if isinstance(request, InputError) else str(request.user_id)
        # Whether rows are remembered is known once they have been answered.
        if user in users or len(waiting) == _AT_ONCE:
            yield from _answer_together(responder, remembered, waiting, exposures)
            waiting, users = [], set()
        waiting.append((number, request))
        users |= set() if user is None else {user}
    yield from _answer_together(responder, remembered, waiting, exposures)


def _parse_line(line: bytes | None, limits: Limits) -> StreamRequest | InputError:
    if line is None:
        return InputError(f"the line has more than {limits.bytes:,} bytes; send fewer rows")
    if not line.strip():
        return InputError("the line is blank; send a request on each line")
    try:
        request: StreamRequest = parse(StreamRequest, line, limits)
    except InputError as error:
        return error
    return request


def _answer_together(
    responder: Responder,
    remembered: "_Remembered",
    waiting: Sequence[_Read],
    exposures: ExposureLog | None,
) -> Iterator[dict[str, Any]]:
    """The answers to requests of different users, with one forward pass."""
    whole = {n: remembered.whole(r) for n, r in waiting if isinstance(r, StreamRequest)}
    answers = dict(zip(whole, responder.answers(list(whole.values())), strict=True))
    for number, request in waiting:
        if isinstance(request, InputError):
            yield {"error": str(request), "line": number}
            continue
        answer = answers[number]
        if isinstance(answer, InputError):
            yield {"user_id": exact_id(request.user_id), "error": str(answer), "line": number}
        else:
            remembered.keep(request, whole[number].history)
            if exposures is not None:
                exposures.add(request.user_id, answer)
            yield answer.as_dict(request.user_id)


class _Remembered:
    """The rows of the users who were heard of last; user 7 is user "7"."""

    def __init__(self, most: int, limits: Limits) -> None:
        self._most, self._limits, self._count = most, limits, 0
        self._rows: OrderedDict[str, list[Row]] = OrderedDict()

    def whole(self, request: StreamRequest) -> Request:
        """The request with all rows of its user as its history."""
        replaced = "history" in request.model_fields_set
        earlier = request.history if replaced else self._rows.get(str(request.user_id), [])
        rows = [*earlier, *request.interactions]
        if len(rows) > self._limits.history:
            rows = sorted(rows, key=lambda row: row["timestamp"])[-self._limits.history :]
        return request.model_copy(update={"history": rows})

    def keep(self, request: StreamRequest, rows: list[Row]) -> None:
        """Remember all rows of a user, if there are any."""
        user = str(request.user_id)
        self._count += len(rows) - len(self._rows.pop(user, ()))
        if rows:
            self._rows[user] = rows
        while self._count > self._most:
            self._count -= len(self._rows.popitem(last=False)[1])


def _read_lines(source: IO[bytes], most: int) -> Iterator[list[_Line]]:
    """Lines that arrive together; None for one of over `most` bytes."""
    number, buffer, too_long = 0, bytearray(), False
    while block := source.read(_BLOCK):
        first, *following_parts = block.split(b"\n")
        buffer += first
        lines: list[_Line] = []
        for following in following_parts:
            number += 1
            whole = not (too_long or len(buffer) > most)
            lines.append((number, bytes(buffer) if whole else None))
            buffer, too_long = bytearray(following), False
        if len(buffer) > most:
            buffer, too_long = bytearray(), True
        if lines:
            yield lines
    if buffer or too_long:
        yield [(number + 1, None if too_long else bytes(buffer))]
