"""The web server's application: recommendations, health, metrics of Prometheus, a page on them."""

import asyncio
import re
import sys
import time
import traceback
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from ipaddress import IPv6Address
from typing import Annotated, Any, Final, NotRequired

from fastapi import FastAPI, Response
from fastapi import Request as HTTPRequest
from fastapi_offline import FastAPIOffline
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

# Of typing's TypedDict, pydantic cannot read the types before Python 3.12.
from typing_extensions import TypedDict

from ucfrec import __version__
from ucfrec.errors import InputError
from ucfrec.files.atomic import json_text
from ucfrec.recommending.batcher import Batcher, QueueFullError
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.metrics import ServingMetrics
from ucfrec.recommending.requests import Request, parse
from ucfrec.recommending.responder import Answer, Responder
from ucfrec.recommending.served import Served
from ucfrec.recommending.server import AllowedHosts
from ucfrec.settings import settings_table

_HOST: Final = re.compile(r"\*|(\*\.)?[\w.-]+")
_PATH: Final = "/recommendations"
_JSON: Final = "application/json"


class _Error(TypedDict):
    error: str


class _Item(TypedDict):
    item_id: int | str
    score: Annotated[float, Field(description="Log-probability among the items left, nats.")]
    propensity: Annotated[
        float,
        Field(description="Probability of the item at its position, given those before it."),
    ]


class _Recommendations(TypedDict):
    user_id: int | str
    request_id: str
    run: Annotated[str, Field(description="Fingerprint of the run.")]
    rule: Annotated[str, Field(description="Hash of the decision rule.")]
    arm: NotRequired[
        Annotated[str, Field(description="Run of the user's arm, if runs share the users.")]
    ]
    items: Annotated[list[_Item], Field(description="In the order to show.")]


_FAULTS: Final = {
    400: "Not JSON, no such request, or beyond a limit.",
    408: "The request's body did not arrive in time.",
    413: "The body is too large.",
    431: "Too many headers, or too long ones.",
    500: "A bug, or out of memory; see the server's standard error.",
    503: "Too many requests wait; try again later.",
    504: "No answer in time.",
}
_MOST_HEADERS: Final = 100
_MOST_HEADER_BYTES: Final = 2**16
"""Of the address, names and values of a request. The server itself stops reading a head that is not
whole by then."""
_ALLOW: Final = (
    "start the server with --allowed-hosts and this host, or ask for one that it answers"
)
_HUNG_UP: Final = 499
"""For the metrics, as no client receives it; nginx calls it so."""


@settings_table("")
class ServerLimits:
    """What the server as a whole takes on."""

    batch: Annotated[int, Field(ge=1, le=4096)] = 64
    """Requests of a forward pass."""
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = 1024
    """Requests that may wait."""
    timeout: Annotated[float, Field(gt=0, le=3600)] = 5.0
    """Seconds for a request to arrive and to be answered."""


def _host(host: str) -> str:
    """A host as the header `Host` has it: addresses of IP version 6 are in brackets."""
    with suppress(ValueError):
        return f"[{IPv6Address(host.strip('[]'))}]"
    if not _HOST.fullmatch(host):
        raise InputError(
            f"--allowed-hosts: {host!r} is not a host; write names or addresses without a port, "
            "*.example.org, or *"
        )
    return host


class _HeaderLimits:
    """ASGI middleware that answers 431 to requests with too many or too long headers."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = scope.get("headers", ())
        size = len(scope.get("raw_path", b"")) + len(scope.get("query_string", b""))
        size += sum(len(name) + len(value) for name, value in headers)
        if len(headers) <= _MOST_HEADERS and size <= _MOST_HEADER_BYTES:
            await self._app(scope, receive, send)
            return
        most = f"{_MOST_HEADERS} headers and {_MOST_HEADER_BYTES:,} bytes of them are allowed"
        refusal = _response(431, {"error": most}, {"connection": "close"})
        await refusal(scope, receive, send)


class _Direct:
    """ASGI middleware that answers requests for recommendations. The framework's routing would take
    as long as computing one of many that share a forward pass."""

    def __init__(self, app: ASGIApp, answer: Callable[[HTTPRequest], Awaitable[Response]]) -> None:
        self._app, self._answer = app, answer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope.get("path") == _PATH and scope.get("method") == "POST":
            response = await self._answer(HTTPRequest(scope, receive))
            await response(scope, receive, send)
        else:
            await self._app(scope, receive, send)


class _TooLargeError(Exception):
    """The body of a request has too many bytes."""


def application(
    responder: Responder | Served,
    limits: ServerLimits,
    allowed_hosts: Sequence[str] = ("*",),
    exposures: ExposureLog | None = None,
    shared_metrics: bool = False,
) -> FastAPI:
    """The application of one model; it keeps no state but the model and its metrics.

    Args:
        allowed_hosts: values of the header `Host`, without a port, that are answered: names,
            addresses, *.example.org for all names below, or * for any.
        exposures: gets every answer; None for none.
        shared_metrics: `/metrics` has the totals of several processes; see `ServingMetrics`.

    Raises:
        InputError: a host is written otherwise.
    """
    hosts = [_host(host) for host in allowed_hosts]
    metrics = ServingMetrics(responder.drift, shared_metrics)
    batcher = Batcher(responder.answers, metrics, limits.batch, limits.queue)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        await batcher.close()
        responder.close()

    app = FastAPIOffline(
        title="ucfrec", version=__version__, lifespan=lifespan, redoc_url=None, docs_url="/docs"
    )

    @app.exception_handler(HTTPException)
    async def refuse(_: HTTPRequest, error: HTTPException) -> Response:
        return _response(error.status_code, {"error": str(error.detail)}, error.headers)

    faults: dict[int | str, dict[str, Any]] = {
        status: {"description": text, "model": _Error} for status, text in _FAULTS.items()
    }

    @app.post(_PATH, openapi_extra=_DESCRIBED, responses=faults, response_model=_Recommendations)
    async def recommendations(http: HTTPRequest) -> Response:
        """The next items for one user."""
        began = time.perf_counter()
        status, body = await _answer_http(http, responder, batcher, limits, exposures)
        metrics.request(status, time.perf_counter() - began)
        return _response(status, body, {"Retry-After": "1"} if status == 503 else None)

    app.add_middleware(_Direct, answer=recommendations)
    app.add_middleware(AllowedHosts, allowed=hosts, remedy=_ALLOW)
    app.add_middleware(_HeaderLimits)  # the last one added comes first

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """That the server answers, and with what model."""
        return {"status": "ok", **responder.described(), "version": __version__}

    @app.get("/metrics", response_class=Response)
    async def prometheus() -> Response:
        """Metrics in Prometheus' text format."""
        return Response(metrics.text(), media_type=CONTENT_TYPE_LATEST)

    return app


async def _answer_http(
    http: HTTPRequest,
    responder: Responder | Served,
    batcher: Batcher,
    limits: ServerLimits,
    exposures: ExposureLog | None,
) -> tuple[int, dict[str, Any]]:
    """HTTP status and JSON of the answer."""
    arrived = False
    try:
        async with asyncio.timeout(limits.timeout):
            body = await _body(http, responder.limits.bytes)
            arrived = True
            request: Request = parse(Request, body, responder.limits)
            outcome = await batcher.answer(request)
    except _TooLargeError as error:
        return 413, {"error": str(error)}
    except InputError as error:
        return 400, {"error": str(error)}
    except QueueFullError:
        return 503, {"error": "too many requests wait; try again later"}
    except TimeoutError:
        status = 504 if arrived else 408
        return status, {"error": f"not done within {limits.timeout:g} s; try again later"}
    except ClientDisconnect:
        return _HUNG_UP, {"error": "the client closed the connection"}
    except Exception:
        traceback.print_exc(file=sys.stderr)
        return 500, {"error": "internal error (a bug, or out of memory); see the server's log"}
    if isinstance(outcome, Answer):
        if exposures is not None:
            exposures.add(request.user_id, outcome)
        return 200, outcome.as_dict(request.user_id)
    return 400, {"error": str(outcome)}


async def _body(http: HTTPRequest, most: int) -> bytes:
    """The body of a request, of which no more than `most` bytes are read."""
    too_large = _TooLargeError(f"the body has more than {most:,} bytes; send fewer rows")
    stated = http.headers.get("content-length", "")
    if stated.isdecimal() and int(stated[:20]) > most:
        raise too_large
    body = bytearray()
    async for chunk in http.stream():
        body += chunk
        if len(body) > most:
            raise too_large
    return bytes(body)


def _response(status: int, body: Any, headers: Any = None) -> Response:
    # One-line errors may quote text that is not Unicode; \u escapes can carry it.
    return Response(json_text(body), status, headers, media_type=_JSON)


def _inline(schema: dict[str, Any]) -> dict[str, Any]:
    """A JSON schema without references, which lie elsewhere in OpenAPI."""
    definitions = schema.pop("$defs", {})

    def inline(value: Any) -> Any:
        if isinstance(value, dict):
            if "$ref" in value:
                return inline(definitions[value["$ref"].rpartition("/")[2]])
            return {name: inline(entry) for name, entry in value.items()}
        return [inline(entry) for entry in value] if isinstance(value, list) else value

    result: dict[str, Any] = inline(schema)
    return result


_DESCRIBED: Final = {
    "requestBody": {
        "required": True,
        "content": {_JSON: {"schema": _inline(Request.model_json_schema())}},
    }
}
