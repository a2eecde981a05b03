"""The web server's application: recommendations, health, metrics of Prometheus, a page on them."""

import asyncio
import re
import sys
import time
import traceback
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from ipaddress import IPv6Address
from typing import Annotated, Any, NotRequired

from fastapi import FastAPI, Response
from fastapi import Request as HTTPRequest
from fastapi_offline import FastAPIOffline
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

# Of typing's TypedDict, pydantic cannot read the types before Python 3.12.
from typing_extensions import TypedDict

from ucfrec import __version__
from ucfrec.errors import InputError
from ucfrec.files.atomic import json_text
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.requests import Request, parse
from ucfrec.recommending.responder import Answer, Mean, Responder, Served
from ucfrec.settings import settings_table

_HOST = re.compile(r"\*|(\*\.)?[\w.-]+")
_PATH = "/recommendations"
_JSON = "application/json"
_FAULTS = {
    400: "Not JSON, no such request, or beyond a limit.",
    408: "The request's body did not arrive in time.",
    413: "The body is too large.",
    431: "Too many headers, or too long ones.",
    500: "A bug, or out of memory; see the server's standard error.",
    503: "Too many requests wait; try again later.",
    504: "No answer in time.",
}
_MOST_HEADERS = 100
_MOST_HEADER_BYTES = 2**16
"""Of the address, names and values of a request. The server itself stops reading a head that is not
whole by then."""
_HUNG_UP = 499
"""For the metrics, as no client receives it; nginx calls it so."""
_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_SIZES = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_DRIFT = "ucfrec_drift"
_WEIGHT = "ucfrec_drift_weight"


@settings_table("")
class ServerLimits:
    """What the server as a whole takes on."""

    batch: Annotated[int, Field(ge=1, le=4096)] = 64
    """Requests of a forward pass."""
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = 1024
    """Requests that may wait."""
    timeout: Annotated[float, Field(gt=0, le=3600)] = 5.0
    """Seconds for the head of a request to arrive, and then for it to be answered."""
    connections: Annotated[int, Field(ge=1, le=1_000_000)] = 1024
    """Open connections of each process; at most the files that it may open, less 192."""
    connections_of_address: Annotated[int, Field(ge=1, le=1_000_000)] = 512
    """Of these, connections of one address, for a proxy as many as of all."""


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


class _Metrics:
    """What a server has done, in a registry of its own."""

    def __init__(self, drift: Callable[[], Mapping[str, Mean]], shared: bool) -> None:
        """
        Args:
            drift: returns what is different in requests, or in the logs of the last update.
            shared: count for all processes that share the folder PROMETHEUS_MULTIPROC_DIR.
        """
        registry = CollectorRegistry()
        self._measure_drift = drift
        self._collector: Collector = registry
        text = "Requests for recommendations, by HTTP status."
        self._requests = Counter("ucfrec_requests", text, ["status"], registry=registry)
        text = "Time from the request's first byte to its answer."
        self._seconds = Histogram(
            "ucfrec_request_seconds", text, buckets=_SECONDS, registry=registry
        )
        text = "Requests of a forward pass."
        self._sizes = Histogram("ucfrec_batch_requests", text, buckets=_SIZES, registry=registry)
        text = "Time of reading and scoring the requests of a forward pass."
        self._passes = Histogram("ucfrec_batch_seconds", text, buckets=_SECONDS, registry=registry)
        live: dict[str, Any] = {"registry": registry, "multiprocess_mode": "livesum"}
        text = "Requests that wait for a forward pass."
        self.waiting = Gauge("ucfrec_waiting_requests", text, **live)
        text = (
            "Unknown items and users and new sessions of requests, shares since the run began to "
            "answer; and the drift that the run's update found (update_…)."
        )
        self._totals = Gauge(_DRIFT, text, ["measure"], **live)
        self._weights = Gauge(_WEIGHT, text, ["measure"], **live)
        self._used, self._cpu = 0.0, None
        if shared:
            self._collector = MultiProcessCollector(None)  # type: ignore[no-untyped-call]
            # `ProcessCollector` would describe whichever process is asked.
            text = "Total user and system CPU time spent in seconds."
            self._cpu = Counter("process_cpu_seconds", text, registry=registry)
            self._update()
        else:
            ProcessCollector(registry=registry)

    def count_request(self, status: int, seconds: float) -> None:
        """Count a request that was answered."""
        self._requests.labels(str(status)).inc()
        self._seconds.observe(seconds)

    def count_batch(self, requests: int, seconds: float) -> None:
        """Count a forward pass."""
        self._sizes.observe(requests)
        self._passes.observe(seconds)
        if self._cpu is not None:
            self._update()

    def write_text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        self._update()
        return generate_latest(self)

    def collect(self) -> Iterator[Metric]:
        """All metrics, as `prometheus_client` asks for them."""
        metrics = {metric.name: metric for metric in self._collector.collect()}
        totals, weights = (
            {sample.labels["measure"]: sample.value for sample in metrics[name].samples}
            for name in (_DRIFT, _WEIGHT)
        )
        del metrics[_WEIGHT]
        # A measure of a run that answered before is not removed from the files.
        metrics[_DRIFT].samples = [
            Sample(_DRIFT, {"measure": name}, Mean(totals[name], weights[name]).value)
            for name in self._drift
        ]
        yield from metrics.values()

    def _update(self) -> None:
        """Bring up to date what nothing else reports."""
        self._drift = self._measure_drift()
        for name, mean in self._drift.items():
            self._totals.labels(name).set(mean.total)
            self._weights.labels(name).set(mean.weight)
        if self._cpu is not None:
            seconds, self._used = self._used, time.process_time()
            self._cpu.inc(self._used - seconds)


_Waiting = tuple[Request, "asyncio.Future[Answer]"]


class _Batcher:
    """Answers requests of concurrent callers in one thread, as many at once as have come.

    A request that comes while nothing is computed starts at once; those that come meanwhile wait
    for the end of the forward pass and share the next.
    """

    def __init__(
        self,
        responder: Responder | Served,
        limits: ServerLimits,
        exposures: ExposureLog | None,
        metrics: _Metrics,
    ) -> None:
        self._responder, self._limits = responder, limits
        self._exposures, self._metrics = exposures, metrics
        self._queue: deque[_Waiting] = deque()
        self._thread = ThreadPoolExecutor(1, "forward")
        self._running: asyncio.Task[None] | None = None

    async def respond(self, http: HTTPRequest) -> Response:
        """The next items for one user."""
        began = time.perf_counter()
        status, body = await self._answer_http(http)
        self._metrics.count_request(status, time.perf_counter() - began)
        return _respond(status, body, {"Retry-After": "1"} if status == 503 else None)

    async def _answer_http(self, http: HTTPRequest) -> tuple[int, dict[str, Any]]:
        """HTTP status and JSON of the answer."""
        seconds = self._limits.timeout
        limits = self._responder.limits
        arrived = False
        try:
            async with asyncio.timeout(seconds):
                body = await _read_body(http, limits.bytes)
                arrived = True
                request: Request = parse(Request, body, limits)
                answer = await self._answer(request)
        except HTTPException as error:
            return error.status_code, {"error": error.detail}
        except InputError as error:
            return 400, {"error": str(error)}
        except TimeoutError:
            status = 504 if arrived else 408
            return status, {"error": f"not done within {seconds:g} s; try again later"}
        except ClientDisconnect:
            return _HUNG_UP, {"error": "the client closed the connection"}
        except Exception:
            traceback.print_exc(file=sys.stderr)
            return 500, {"error": "internal error (a bug, or out of memory); see the server's log"}
        if self._exposures is not None:
            self._exposures.add(request.user_id, answer)
        return 200, answer.as_dict(request.user_id)

    async def _answer(self, request: Request) -> Answer:
        """The answer to a request; InputError for a wrong one, HTTPException if too many wait."""
        if len(self._queue) >= self._limits.queue:
            raise HTTPException(503, "too many requests wait; try again later")
        outcome: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._queue.append((request, outcome))
        self._metrics.waiting.set(len(self._queue))
        if self._running is None or self._running.done():
            self._running = asyncio.create_task(self._run())
        return await outcome

    async def close(self) -> None:
        """Answer what waits, and end the thread."""
        if self._running is not None:
            await self._running
        self._thread.shutdown()

    async def _run(self) -> None:
        while batch := self._take_batch():
            began, requests = time.perf_counter(), [request for request, _ in batch]
            outcomes: Sequence[Answer | Exception]
            try:
                outcomes = await asyncio.get_running_loop().run_in_executor(
                    self._thread, self._responder.answers, requests
                )
            except Exception as error:  # a bug, or out of memory; every caller receives it
                outcomes = [error] * len(batch)
            self._metrics.count_batch(len(batch), time.perf_counter() - began)
            for (_, waiting), outcome in zip(batch, outcomes, strict=True):
                if waiting.done():
                    continue
                if isinstance(outcome, Answer):
                    waiting.set_result(outcome)
                else:
                    waiting.set_exception(outcome)

    def _take_batch(self) -> list[_Waiting]:
        batch: list[_Waiting] = []
        while self._queue and len(batch) < self._limits.batch:
            request, outcome = self._queue.popleft()
            if not outcome.done():
                batch.append((request, outcome))
        self._metrics.waiting.set(len(self._queue))
        return batch


class _Entrance:
    """ASGI middleware that answers 431 to requests with too many or too long headers, and answers
    requests for recommendations: the framework's routing would take as long as computing one of
    many that share a forward pass."""

    def __init__(self, app: ASGIApp, answer: Callable[[HTTPRequest], Awaitable[Response]]) -> None:
        self._app, self._answer = app, answer

    async def __call__(
        self,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        headers, respond = scope.get("headers", ()), self._app
        size = len(scope.get("raw_path", b"")) + len(scope.get("query_string", b""))
        size += sum(len(name) + len(value) for name, value in headers)
        if len(headers) > _MOST_HEADERS or size > _MOST_HEADER_BYTES:
            most = f"{_MOST_HEADERS} headers and {_MOST_HEADER_BYTES:,} bytes of them are allowed"
            respond = _respond(431, {"error": most}, {"connection": "close"})
        elif scope.get("path") == _PATH and scope.get("method") == "POST":
            respond = await self._answer(HTTPRequest(scope, receive))
        await respond(scope, receive, send)


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
            addresses, *.example.org for all names below, or * for any; InputError otherwise.
        exposures: gets every answer; None for none.
        shared_metrics: `/metrics` has the totals of several processes.
    """
    hosts = [_read_host(host) for host in allowed_hosts]
    metrics = _Metrics(responder.drift, shared_metrics)
    batcher = _Batcher(responder, limits, exposures, metrics)

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
        return _respond(error.status_code, {"error": str(error.detail)}, error.headers)

    faults: dict[int | str, dict[str, Any]] = {
        status: {"description": text, "model": _Error} for status, text in _FAULTS.items()
    }

    # For OpenAPI, a JSON schema without references, which lie elsewhere.
    schema = Request.model_json_schema()
    schema["properties"]["history"]["items"] = schema.pop("$defs")["Row"]
    body = {"required": True, "content": {_JSON: {"schema": schema}}}
    app.post(
        _PATH,
        name="recommendations",
        openapi_extra={"requestBody": body},
        responses=faults,
        response_model=_Recommendations,
    )(batcher.respond)
    app.add_middleware(_Entrance, answer=batcher.respond)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=hosts, www_redirect=False)

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """That the server answers, and with what model."""
        return {"status": "ok", **responder.described(), "version": __version__}

    @app.get("/metrics", response_class=Response)
    async def prometheus() -> Response:
        """Metrics in Prometheus' text format."""
        return Response(metrics.write_text(), media_type=CONTENT_TYPE_LATEST)

    return app


def _read_host(host: str) -> str:
    """A host as the header `Host` has it: addresses of IP version 6 are in brackets."""
    with suppress(ValueError):
        return f"[{IPv6Address(host.strip('[]'))}]"
    if not _HOST.fullmatch(host):
        raise InputError(
            f"--allowed-hosts: {host!r} is not a host; write names or addresses without a port, "
            "*.example.org, or *"
        )
    return host


async def _read_body(http: HTTPRequest, most: int) -> bytes:
    """The body of a request, of which no more than `most` bytes are read."""
    body = bytearray()
    async for chunk in http.stream():
        body += chunk
        if len(body) > most:
            raise HTTPException(413, f"the body has more than {most:,} bytes; send fewer rows")
    return bytes(body)


def _respond(status: int, body: Any, headers: Any = None) -> Response:
    # One-line errors may quote text that is not Unicode; \u escapes can carry it.
    return Response(json_text(body), status, headers, media_type=_JSON)
