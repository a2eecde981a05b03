"""The web server's process: how and where it listens, and saying that it is ready."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from ucfrec.errors import InputError, explain_os_error


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


class Server(uvicorn.Server):
    """A server that says on stdout when it is ready, and where."""

    def __init__(self, config: uvicorn.Config, what: str, page: str = "/docs") -> None:
        super().__init__(config)
        self._what, self._page = what, page

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen."""
        await super().startup(sockets)
        for each in sockets or []:
            host, port = each.getsockname()[:2]
            where = f"[{host}]" if ":" in host else host
            print(f"{self._what}, ready at http://{where}:{port} (page: {self._page})", flush=True)
