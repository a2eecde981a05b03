"""Recommendations as a stream: lines of requests in, lines of answers out."""

from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator, Sequence
from typing import IO, Any

from ucfrec.errors import InputError
from ucfrec.files.atomic import json_text
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.requests import Request, Row, StreamRequest, parse
from ucfrec.recommending.responder import Responder, exact_id

REMEMBERED = 1_000_000
"""Rows that a stream keeps; the least recently active users are dropped first."""
_BLOCK = 2**16
_AT_ONCE = 256
"""Most requests of a forward pass."""


_Line = tuple[int, bytes]
"""Number of a line, from 1, and what it holds."""
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
    counts, answers = Counter[str](), _Answers(responder, remember, exposures)
    for lines in _read_lines(source, responder.limits.bytes):
        for answer in answers.answer(lines):
            sink.write(json_text(answer).encode() + b"\n")
            counts["errors" if "error" in answer else "answers"] += 1
        sink.flush()
    return counts


class _Answers:
    """Answers lines, and remembers the rows of users who were heard of last; user 7 is user "7"."""

    def __init__(
        self,
        responder: Responder,
        most: int,
        exposures: ExposureLog | None,
    ) -> None:
        self._responder, self._exposures = responder, exposures
        self._most, self._count = most, 0
        self._rows: OrderedDict[str, list[Row]] = OrderedDict()

    def answer(self, lines: Sequence[_Line]) -> Iterator[dict[str, Any]]:
        """The answers to lines."""
        waiting: dict[str | int, _Read] = {}
        for number, line in lines:
            request: StreamRequest | InputError
            try:
                request = parse(StreamRequest, line, self._responder.limits)
            except InputError as error:
                request = error
            user = number if isinstance(request, InputError) else str(request.user_id)
            # Whether rows are remembered is known once they have been answered.
            if user in waiting or len(waiting) == _AT_ONCE:
                yield from self._answer_together(waiting.values())
                waiting = {}
            waiting[user] = number, request
        yield from self._answer_together(waiting.values())

    def _answer_together(self, waiting: Collection[_Read]) -> Iterator[dict[str, Any]]:
        """The answers to requests of different users, with one forward pass."""
        whole = {n: self._add_history(r) for n, r in waiting if isinstance(r, StreamRequest)}
        answers = dict(zip(whole, self._responder.answers(list(whole.values())), strict=True))
        for number, request in waiting:
            if isinstance(request, InputError):
                yield {"error": str(request), "line": number}
                continue
            answer = answers[number]
            if isinstance(answer, InputError):
                yield {"user_id": exact_id(request.user_id), "error": str(answer), "line": number}
            else:
                self._remember(str(request.user_id), whole[number].history)
                if self._exposures is not None:
                    self._exposures.add(request.user_id, answer)
                yield answer.as_dict(request.user_id)

    def _add_history(self, request: StreamRequest) -> Request:
        """The request with all rows of its user as its history."""
        replaced, most = "history" in request.model_fields_set, self._responder.limits.history
        earlier = request.history if replaced else self._rows.get(str(request.user_id), [])
        rows = [*earlier, *request.interactions]
        if len(rows) > most:
            rows = sorted(rows, key=lambda row: row["timestamp"])[-most:]
        return request.model_copy(update={"history": rows})

    def _remember(self, user: str, rows: list[Row]) -> None:
        """Remember all rows of a user, if there are any."""
        self._count += len(rows) - len(self._rows.pop(user, ()))
        if rows:
            self._rows[user] = rows
        while self._count > self._most:
            self._count -= len(self._rows.popitem(last=False)[1])


def _read_lines(source: IO[bytes], most: int) -> Iterator[list[_Line]]:
    """Lines that arrive together; of one of over `most` bytes, one byte more than these or all."""
    number, buffer = 0, b""
    while block := source.read(_BLOCK):
        *lines, buffer = (buffer + block).split(b"\n")
        buffer = buffer[: most + 1]
        if lines:
            yield [*enumerate(lines, number + 1)]
        number += len(lines)
    if buffer:
        yield [(number + 1, buffer)]
