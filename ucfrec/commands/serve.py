"""`ucfrec serve`: answer requests for recommendations over HTTP."""

import argparse
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ucfrec.commands.options import (
    answer_options,
    exposures_given,
    option,
    responder_given,
    rule_options,
    table_options,
    table_values,
)
from ucfrec.errors import InputError, InputNote
from ucfrec.processes import Interrupted

if TYPE_CHECKING:
    import socket

    import uvicorn

    from ucfrec.recommending.responder import Responder
    from ucfrec.recommending.server import Parent
_STOPPED: Final = "ucfrec serve: stopped"
_LIMITS: Final = "ucfrec.recommending.web:ServerLimits"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec serve`."""
    option(
        parser,
        "run",
        Path,
        "run folder of `ucfrec train`; or a folder of runs, of which the one that `ucfrec "
        "promote` made current answers, and is followed",
        "RUN",
    )
    option(
        parser,
        "--split",
        str,
        "answer with several runs of the folder RUN, each for its share of the users; e.g. "
        "run1=0.9,run2=0.1; the exposures have the arm (default: one run answers all)",
        "A=SHARE,B=SHARE",
    )
    text = "address to listen on; one that is not this machine's own exposes the server to the "
    option(parser, "--host", "127.0.0.1", f"{text}network")
    option(parser, "--port", 8080, "0 for a free one")
    answer_options(parser, "DIR")
    rule_options(parser)
    server = parser.add_argument_group("the server")
    option(
        server,
        "--allowed-hosts",
        str,
        "answer only requests whose header Host names one of these: names, addresses, "
        "*.example.org, or * for any (default: this machine's own names where --host is 127.0.0.1, "
        "localhost or ::1, otherwise any)",
        "HOST[,HOST…]",
    )
    text = "processes that answer on the address, each with the run in its memory"
    option(server, "--workers", 1, text, "N")
    text = "threads per forward pass (default: one per core, divided by --workers)"
    option(server, "--threads", int, text, "N")
    table_options(server, _LIMITS, {"batch": int, "queue": int}, "max-")
    table_options(server, _LIMITS, {"timeout": float})


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec serve` until Ctrl-C or TERM, after which requests in flight are answered.

    Raises:
        InputError: the run cannot be used or has no checksums, a file of it was changed, the extra
            `serve` is not installed, or the address cannot be listened on.
    """
    from ucfrec.recommending.server import MOST, Workers

    if not 1 <= options.workers <= MOST:
        raise InputError(f"--workers is {options.workers}; give a number from 1 to {MOST}")
    from ucfrec.recommending.server import PrintingServer, listening_socket, ready_line

    address = listening_socket(options.host, options.port)
    if options.workers == 1:
        _serve(options, address, PrintingServer)
        return
    with address as listening, Workers(partial(_work, options), listening) as workers:
        what = workers.start(options.workers)
        print(ready_line(what, listening), flush=True)
        try:
            workers.keep()
        except Interrupted:
            workers.end()
            print(_STOPPED, file=sys.stderr)


def _serve(
    options: argparse.Namespace,
    address: "AbstractContextManager[socket.socket]",
    server: "Callable[[uvicorn.Config, str], uvicorn.Server]",
) -> None:
    """Answer requests in this process.

    Args:
        server: makes the server, given what it answers with.
    """
    import torch

    from ucfrec.recommending.responder import Served, parse_split
    from ucfrec.recommending.server import server_config
    from ucfrec.recommending.web import ServerLimits, application
    from ucfrec.runs.record import RUN, verified
    from ucfrec.runs.trained_policy import TrainedPolicy

    several = options.workers > 1
    threads = options.threads
    if threads is None and several:
        threads = max(1, torch.get_num_threads() // options.workers)
    if threads is not None:
        if threads < 1:
            raise InputError(f"--threads is {threads}; give 1 or more")
        torch.set_num_threads(threads)
    limits = ServerLimits(**table_values(options, "ServerLimits"))

    def make(run: Path) -> "Responder":
        verified(run)
        return responder_given(options, TrainedPolicy.load(run, options.checkpoint))

    shares = None if options.split is None else parse_split(options.split)
    folder = options.run.resolve()
    if shares is None and (folder / RUN).is_file():
        folder, shares = folder.parent, {folder.name: 1.0}
    with (
        closing(Served(make, folder, shares)) as served,
        exposures_given(options, served.trained) as exposures,
    ):
        if shares is None:
            served.follow()
        config = server_config(
            application(served, limits, _allowed_hosts(options), exposures, several),
            timeout_graceful_shutdown=int(limits.timeout) + 1,
            workers=options.workers,
        )
        with address as listening:
            try:
                server(config, f"ucfrec serve: {served.trained!r}").run([listening])
            except Interrupted:
                # What was asked of a server that is stopped is done.
                if not several:
                    print(_STOPPED, file=sys.stderr)


def _work(options: argparse.Namespace, listening: "socket.socket", parent: "Parent") -> None:
    """Answer requests in one of several processes."""
    from ucfrec.commands.cli import explanation, notes_on_one_line
    from ucfrec.recommending.server import Server

    def server(config: "uvicorn.Config", what: str) -> Server:
        made = Server(config, lambda _: parent.ready(what))
        parent.ends(made)
        return made

    try:
        with notes_on_one_line("ucfrec serve"):
            if not parent.first:
                warnings.simplefilter("ignore", InputNote)
            _serve(options, listening, server)
    except Exception as error:
        why = explanation(error)
        if why is None:
            traceback.print_exc()
        parent.failed(why or "a worker failed; see the traceback")


_OWN_NAMES = ("localhost", "127.0.0.1", "::1")


def _allowed_hosts(options: argparse.Namespace) -> tuple[str, ...]:
    """What the header `Host` may be: a page of the web cannot reach a server of this machine by a
    name of its own (DNS rebinding)."""
    if options.allowed_hosts is not None:
        return tuple(host.strip() for host in options.allowed_hosts.split(","))
    return _OWN_NAMES if options.host in _OWN_NAMES else ("*",)
