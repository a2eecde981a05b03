"""The explorer's web application."""

from collections.abc import Sequence
from importlib.resources import files
from typing import Final

from fastapi import FastAPI, Request, Response
from starlette.middleware.trustedhost import TrustedHostMiddleware

from ucfrec.exploring.page import Explorer

_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; connect-src 'self'; style-src 'unsafe-inline'; "
        "img-src http: https:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


def application(explorer: Explorer, allowed_hosts: Sequence[str]) -> FastAPI:
    """The application, which keeps no state of its visitors.

    Args:
        allowed_hosts: values of the header `Host` that are answered.
    """
    app = FastAPI(title="ucfrec explorer", docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[*allowed_hosts], www_redirect=False)
    script = files("ucfrec.exploring").joinpath("explore.js").read_text(encoding="utf-8")

    def html(text: str) -> Response:
        # Texts of files may have bytes that are not valid Unicode.
        content = text.encode("utf-8", errors="backslashreplace")
        return Response(content, media_type="text/html; charset=utf-8", headers=_HEADERS)

    @app.get("/")
    def page(request: Request) -> Response:
        """The page, filled in as the address says."""
        return html(explorer.page(request.query_params))

    @app.get("/results")
    def results(request: Request) -> Response:
        """The list alone."""
        return html(explorer.results(request.query_params))

    @app.get("/explore.js")
    def javascript() -> Response:
        """The script of the page."""
        return Response(script, media_type="text/javascript; charset=utf-8", headers=_HEADERS)

    @app.get("/report/{number}")
    def report(number: int) -> Response:
        """The report of a run."""
        if not 0 <= number < len(explorer.runs):
            return Response("there is no such run", 404)
        return html(explorer.reports[number])

    return app
