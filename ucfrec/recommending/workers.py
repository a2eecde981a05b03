"""Several processes that answer on one address: started, replaced and ended together.

uvicorn's own supervisor starts a worker that cannot start again and again, or gives up without the
reason; and its workers outlive a parent that is killed.
"""

import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from tempfile import TemporaryDirectory
from typing import Any, Final, Protocol

from ucfrec.errors import InputError
from ucfrec.processes import Interrupted, block_ctrl_c, interruptions_raised

METRICS: Final = "PROMETHEUS_MULTIPROC_DIR"
"""Environment variable of the folder in which workers share their metrics."""
MOST: Final = 256
"""Workers."""
_PAUSE: Final = 10.0
"""Seconds after which a worker that could not start is tried again."""


class _Ends(Protocol):
    """What `uvicorn.Server` is ended by."""

    should_exit: bool
    force_exit: bool


class Parent:
    """The parent process, in a worker: receives what the worker reports, and ends it.

    The first message of the parent, or its death, ends the server after the requests in flight; a
    second message ends it at once.
    """

    def __init__(self, connection: "Connection[Any, Any]", first: bool) -> None:
        self.first = first
        """Whether this is the one of the workers that says what all would say."""
        self._connection, self._lock = connection, threading.Lock()
        self._server: _Ends | None = None
        self._closed, self._close = get_context().Pipe(duplex=False)
        self._thread = threading.Thread(target=self._watch, name="parent", daemon=True)
        self._thread.start()

    def ends(self, server: _Ends) -> None:
        """From now on the parent ends a server; before, it ends the process, which serves no one
        yet."""
        with self._lock:
            self._server = server

    def ready(self, what: str) -> None:
        """Report that the worker answers, and with what."""
        self._report("ready", what)

    def failed(self, why: str) -> None:
        """Report why the worker cannot start."""
        self._report("failed", why)

    def close(self) -> None:
        """End the thread that listens to the parent: Python ends in order only without it."""
        self._close.close()
        self._thread.join()

    def _report(self, news: str, text: str) -> None:
        with suppress(OSError):  # the parent has ended
            self._connection.send((news, text))

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
                self._server.should_exit, self._server.force_exit = True, force


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

    def news(self) -> str:
        """Receive a report, or the end of the process: what it is, and its text."""
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
    """Processes that answer on one socket; whichever ends is replaced."""

    def __init__(self, work: Work, listening: socket.socket) -> None:
        """
        Args:
            listening: a socket that is bound; closed at the end.
        """
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
        """Start so many workers, and wait until all answer.

        Returns:
            What they answer with.

        Raises:
            InputError: one cannot start; the reason of the first.
        """
        for _ in range(count):
            self._start()
        while not all(worker.ready for worker in self._workers):
            for worker in self._wait_for_news(None):
                if worker.news() != "ready":
                    raise InputError(worker.failure)
        return self._workers[0].what

    def keep(self) -> None:
        """Replace workers that end, for ever.

        Raises:
            InputError: none is left, and none can start.
        """
        while True:
            again = min(self._missing, default=None)
            for worker in self._wait_for_news(again):
                if worker.news() == "ended":
                    self._lose(worker)
            now = time.monotonic()
            due = sum(at <= now for at in self._missing)
            self._missing = [at for at in self._missing if at > now]
            for _ in range(due):
                self._start()

    def end(self) -> None:
        """End the workers after the requests in flight, or at once when interrupted meanwhile."""
        self._listening.close()
        try:
            self._ask_and_wait()
        except Interrupted:
            self._ask_and_wait()
        self._workers.clear()

    def _ask_and_wait(self) -> None:
        for worker in self._workers:
            with suppress(OSError):
                worker.connection.send("end")
        for worker in self._workers:
            if worker.process.pid is not None:  # an interruption came before it started
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

    def _wait_for_news(self, until: float | None) -> "list[_Worker]":
        """Workers that reported something or ended, once there are any, or at a time."""
        seconds = None if until is None else max(0.0, until - time.monotonic())
        having = wait([worker.connection for worker in self._workers], seconds)
        return [worker for worker in self._workers if worker.connection in having]

    def _lose(self, worker: _Worker) -> None:
        # Not before: it would ask for the folder of the metrics when it is imported.
        from prometheus_client.multiprocess import mark_process_dead

        self._workers.remove(worker)
        mark_process_dead(worker.process.pid, self._folder.name)  # type: ignore[no-untyped-call]
        if not worker.ready and not any(other_worker.ready for other_worker in self._workers):
            raise InputError(worker.failure)
        pause = 0.0 if worker.ready else _PAUSE
        self._missing.append(time.monotonic() + pause)
        when = "now" if worker.ready else f"in {_PAUSE:.0f} s"
        print(
            f"ucfrec serve: {worker.failure}; another worker starts {when}",
            file=sys.stderr,
            flush=True,
        )


_SPAWN: Final = get_context("spawn")


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
