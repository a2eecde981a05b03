"""Web servers: how and where they listen, which hosts they answer for, and when they are ready."""

import re
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import uvicorn
from fastapi import Response
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from ucfrec.errors import InputError, explain_os_error
from ucfrec.files.atomic import json_text

_HOST_HEADER: Final = re.compile(r"(\[[0-9a-f:.]+\]|[^:\[\]]*)(:\d*)?")
"""A host, in brackets if it is an address of IP version 6, and perhaps a port."""
_SHOWN: Final = 100
"""Most characters of a refused host in a message."""


def server_config(application: ASGIApp, **more: Any) -> uvicorn.Config:
    """How `application` is served; `more` goes to uvicorn."""
    # h11 takes one request of a connection after the other and bounds what it keeps of a head;
    # httptools does neither, and saves 5% of the processor time at most.
    return uvicorn.Config(
        application,
        http="h11",
        h11_max_incomplete_event_size=2**16,
        ws="none",
        access_log=False,
        log_level="warning",
        server_header=False,
        **more,
    )


@contextmanager
def listening_socket(host: str, port: int) -> Iterator[socket.socket]:
    """A socket bound to an address.

    Raises:
        InputError: nothing can be bound there.
    """
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


def ready_line(what: str, listening: socket.socket, page: str = "/docs") -> str:
    """What is printed on stdout when a server is ready."""
    host, port = listening.getsockname()[:2]
    where = f"[{host}]" if ":" in host else host
    return f"{what}, ready at http://{where}:{port} (page: {page})"


class Server(uvicorn.Server):
    """A server that reports when it is ready."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[socket.socket], None]) -> None:
        """
        Args:
            ready: is called with the socket on which requests are answered from now on.
        """
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen."""
        await super().startup(sockets)
        for bound in sockets or []:
            self._ready(bound)


class PrintingServer(Server):
    """A server that says on stdout when it is ready, and where."""

    def __init__(self, config: uvicorn.Config, what: str, page: str = "/docs") -> None:
        super().__init__(config, lambda at: print(ready_line(what, at, page), flush=True))


class AllowedHosts:
    """ASGI middleware that answers 400, with an error as JSON, to requests for other hosts."""

    def __init__(self, app: ASGIApp, allowed: Sequence[str], remedy: str) -> None:
        """
        Args:
            allowed: hosts without a port, *.example.org for all names below, or * for any.
            remedy: what to do about a refusal.
        """
        hosts = [host.lower() for host in allowed]
        self._app, self._remedy, self._any = app, remedy, "*" in hosts
        self._names = frozenset(hosts)
        self._endings = tuple(host[1:] for host in hosts if host.startswith("*."))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        answer = self._app
        if scope["type"] == "http" and not self._any:
            host_header = Headers(scope=scope).get("host", "")
            if not self._is_allowed(host_header):
                message = f"requests for the host {host_header[:_SHOWN]!r} are not answered; "
                error = json_text({"error": message + self._remedy})
                answer = Response(error, 400, media_type="application/json")
        await answer(scope, receive, send)

    def _is_allowed(self, host_header: str) -> bool:
        match = _HOST_HEADER.fullmatch(host_header.lower())
        host = match.group(1) if match else ""
        return host in self._names or host.endswith(self._endings)
