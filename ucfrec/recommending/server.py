"""Web servers: how and where they listen, when they are ready, and several processes on one
address.

uvicorn's own supervisor starts a worker that cannot start again and again, or gives up without the
reason; and its workers outlive a parent that is killed.
"""

import asyncio
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from tempfile import TemporaryDirectory
from typing import Any, Literal

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from ucfrec.errors import InputError, explain_os_error
from ucfrec.processes import Interrupted, block_ctrl_c, interruptions_raised

METRICS = "PROMETHEUS_MULTIPROC_DIR"
"""Environment variable of the folder in which workers share their metrics."""
_PAUSE = 10.0
"""Seconds after which a worker that could not start is tried again."""
_SPAWN = get_context("spawn")
_SPARE = 192
"""Files that connections leave to the process."""
_AT_ONCE = 128
"""Connections that are accepted before any is looked at, for which the spare files suffice."""
_BACKLOG = 2048
"""Connections that wait to be accepted."""
_TOO_MANY = (
    b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nRetry-After: 1\r\n"
    b"Content-Length: 0\r\n\r\n"
)


class _Connection(H11Protocol):
    """A connection, which ends if its client takes too long, or has too many others.

    h11 takes one request of a connection after the other and bounds what it keeps of a head;
    httptools does neither, and saves 5% of the processor time at most.
    """

    def __init__(
        self,
        seconds: float,
        most: int,
        of_address: int,
        *server: Any,
        **options: Any,
    ):
        super().__init__(*server, **options)
        self._seconds = seconds
        self._most = most
        self._of_address = of_address
        self._previous: tuple[object, int] | None = None
        self._timer = self.loop.call_later(seconds, self._check)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        peers: Any = self.connections
        same = sum(peer.client[0] == self.client[0] for peer in peers) if self.client else 0
        if len(peers) > self._most or same > self._of_address:
            transport.write(_TOO_MANY)
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._timer.cancel()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._timer.cancel()
        self._timer = self.loop.call_later(self._seconds, self._check)

    def _check(self) -> None:
        """End the connection if no head has come since it began or was answered; or if, since the
        last check, nothing of an answer was taken, or the body of a request has not become
        whole."""
        cycle, unsent = self.cycle, self.transport.get_write_buffer_size()
        previous, self._previous = self._previous, (cycle, unsent)
        idle = not unsent and (cycle is None or cycle.response_complete)
        if idle or (previous == self._previous and (unsent or cycle.more_body)):
            self.transport.abort()
        else:
            self._timer = self.loop.call_later(self._seconds, self._check)


def server_config(
    application: Any,
    seconds: float = 5.0,
    connections: int = 1024,
    of_address: int = 512,
    **more: Any,
) -> uvicorn.Config:
    """How `application` is served; `more` goes to uvicorn.

    Args:
        seconds: a connection is closed after so long without a head, and after at most twice as
            long without the whole body, or while nothing of the answer is taken.
        connections: most that are open; where the process may not open so many files, as many as
            it may, less some, and half of them for each address.
        of_address: most of them that one address has.
    """
    if sys.platform != "win32":
        import resource

        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        if files != resource.RLIM_INFINITY and files - _SPARE < connections:
            connections = max(2, files - _SPARE)
            of_address = min(of_address, connections // 2)
    return uvicorn.Config(
        application,
        http=partial(_Connection, seconds, connections, of_address),  # type: ignore[arg-type]
        backlog=_AT_ONCE,
        h11_max_incomplete_event_size=2**16,
        ws="none",
        access_log=False,
        log_level="warning",
        server_header=False,
        **more,
    )


@contextmanager
def listening_socket(host: str, port: int) -> Iterator[socket.socket]:
    """A socket bound to an address; InputError if nothing can be bound there."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port is {port}; give a number from 0 to 65,535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind((host, port))
        except OSError as error:
            raise InputError(
                f"cannot listen on {host}, port {port}: {explain_os_error(error)}; name another "
                "--host or --port"
            ) from None
        yield bound


def print_ready(what: str, listening: socket.socket, page: str = "/docs") -> None:
    """Say on stdout that a server is ready, and where."""
    host, port = listening.getsockname()[:2]
    where = f"[{host}]" if ":" in host else host
    print(f"{what}, ready at http://{where}:{port} (page: {page})", flush=True)


class Server(uvicorn.Server):
    """A server that reports when it is ready, with the socket on which it answers from then on."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[socket.socket], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen."""
        await super().startup(sockets)
        if self.started and self.should_exit:  # a signal came; uvicorn would cancel the application
            await self.shutdown(sockets)
            return
        for bound in sockets or []:
            bound.listen(_BACKLOG)
            self._ready(bound)


class Parent:
    """The parent process, in a worker: receives what the worker reports, and ends it.

    The first message of the parent, or its death, ends the server after the requests in flight; a
    second message ends it at once.
    """

    def __init__(self, connection: "Connection[Any, Any]", first: bool) -> None:
        self.first = first
        """Whether this is the one of the workers that says what all would say."""
        self._connection, self._lock = connection, threading.Lock()
        self._server: uvicorn.Server | None = None
        self._closed, self._close = get_context().Pipe(duplex=False)
        self._thread = threading.Thread(target=self._watch, name="parent", daemon=True)
        self._thread.start()

    def ends(self, server: uvicorn.Server) -> None:
        """From now on the parent ends a server; before, a process that serves no one yet."""
        with self._lock:
            self._server = server

    def report(self, news: Literal["ready", "failed"], text: str) -> None:
        """Report that the worker answers, and with what; or what failed."""
        with suppress(OSError):  # the parent has ended
            self._connection.send((news, text))

    def close(self) -> None:
        """End the thread that listens to the parent: Python ends in order only without it."""
        self._close.close()
        self._thread.join()

    def _watch(self) -> None:
        for force in (False, True):
            if self._closed in wait([self._connection, self._closed]):
                return
            try:
                self._connection.recv()
            except (EOFError, OSError):
                if force:
                    return
            with self._lock:
                if self._server is None:
                    os._exit(0)
                self._server.should_exit = True
                self._server.force_exit = force


Work = Callable[[socket.socket, Parent], None]
"""Answers requests on a socket until the parent ends it. A function of a module, or a `partial` of
one: a new process imports it."""


@dataclass
class _Worker:
    process: SpawnProcess
    connection: "Connection[Any, Any]"
    ready: bool = False
    what: str = ""
    failure: str = ""

    def receive(self) -> str:
        """Receive a report, or the end of the process; returns its kind."""
        try:
            news, text = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            ended = f"worker {self.process.pid} ended with status {self.process.exitcode}"
            self.failure = self.failure or ended
            return "ended"
        if news == "ready":
            self.ready, self.what = True, text
        else:
            self.failure = text
        return str(news)


class Workers:
    """Processes that answer on one bound socket, closed at the end; whichever ends is replaced."""

    def __init__(self, work: Work, listening: socket.socket) -> None:
        self._work, self._listening = work, listening
        self._workers: list[_Worker] = []
        self._first = True
        self._missing: list[float] = []
        """For each worker that could not start: when to try again."""
        self._folder = TemporaryDirectory(prefix="ucfrec-serve-", ignore_cleanup_errors=True)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        self._folder.cleanup()

    def start(self, count: int) -> str:
        """Start so many workers, and wait until all answer; returns what they answer with, or
        raises an InputError with the reason of the first that cannot start."""
        for _ in range(count):
            self._start()
        while not all(worker.ready for worker in self._workers):
            for worker in self._wait_for_news(None):
                if worker.receive() != "ready":
                    raise InputError(worker.failure)
        return self._workers[0].what

    def keep(self) -> None:
        """Replace workers that end, for ever; InputError once none is left and none can start."""
        while True:
            again = min(self._missing, default=None)
            for worker in self._wait_for_news(again):
                if worker.receive() == "ended":
                    self._lose(worker)
            for at in [at for at in self._missing if at <= time.monotonic()]:
                self._missing.remove(at)
                self._start()

    def end(self) -> None:
        """End the workers after the requests in flight, or at once when interrupted meanwhile;
        InputError with what failed in them at the end."""
        self._listening.close()
        # An interruption may have come before one started.
        self._workers = [worker for worker in self._workers if worker.process.pid is not None]
        try:
            self._ask_and_wait()
        except Interrupted:
            self._ask_and_wait()
        failures = dict.fromkeys(w.failure for w in self._workers if w.receive() == "failed")
        self._workers.clear()
        if failures:
            raise InputError("; ".join(failures))

    def _ask_and_wait(self) -> None:
        for worker in self._workers:
            with suppress(OSError):
                worker.connection.send("end")
        for worker in self._workers:
            worker.process.join()

    def _start(self) -> None:
        ours, theirs = _SPAWN.Pipe()
        first, self._first = self._first, False
        arguments = self._work, self._listening, theirs, first, self._folder.name
        process = _SPAWN.Process(target=_begin, args=arguments, daemon=True)
        self._workers.append(_Worker(process, ours))
        with block_ctrl_c():  # it reaches every process of a terminal; this one ends the others
            process.start()
        theirs.close()

    def _wait_for_news(self, until: float | None) -> list[_Worker]:
        """Workers that reported something or ended, once there are any, or at a time."""
        seconds = None if until is None else max(0.0, until - time.monotonic())
        having = wait([worker.connection for worker in self._workers], seconds)
        return [worker for worker in self._workers if worker.connection in having]

    def _lose(self, worker: _Worker) -> None:
        # Not before: it would ask for the folder of the metrics when it is imported.
        from prometheus_client.multiprocess import mark_process_dead

        self._workers.remove(worker)
        mark_process_dead(worker.process.pid, self._folder.name)  # type: ignore[no-untyped-call]
        if not worker.ready and not any(remaining.ready for remaining in self._workers):
            raise InputError(worker.failure)
        pause = 0.0 if worker.ready else _PAUSE
        self._missing.append(time.monotonic() + pause)
        when = f"in {pause:.0f} s" if pause else "now"
        message = f"ucfrec serve: {worker.failure}; another worker starts {when}"
        print(message, file=sys.stderr, flush=True)


def _begin(
    work: Work,
    listening: socket.socket,
    connection: "Connection[Any, Any]",
    first: bool,
    folder: str,
) -> None:
    """A worker's process."""
    os.environ[METRICS] = folder  # prometheus_client reads it when it is imported
    parent = Parent(connection, first)
    with closing(parent), suppress(Interrupted), interruptions_raised():
        work(listening, parent)
