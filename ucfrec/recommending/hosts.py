"""Which values of the header `Host` a web server answers."""

import re
from collections.abc import Sequence
from typing import Final

from fastapi import Response
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from ucfrec.files.atomic import json_text

_HOST: Final = re.compile(r"(\[[0-9a-f:.]+\]|[^:\[\]]*)(:\d*)?")
"""A host, in brackets if it is an address of IP version 6, and perhaps a port."""
_SHOWN: Final = 100
"""Most characters of a refused host in a message."""


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
            given = Headers(scope=scope).get("host", "")
            if not self._allows(given):
                message = f"requests for the host {given[:_SHOWN]!r} are not answered; "
                error = json_text({"error": message + self._remedy})
                answer = Response(error, 400, media_type="application/json")
        await answer(scope, receive, send)

    def _allows(self, given: str) -> bool:
        match = _HOST.fullmatch(given.lower())
        host = match.group(1) if match else ""
        return host in self._names or host.endswith(self._endings)
