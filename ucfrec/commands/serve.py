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
    draw_options,
    engine_option,
    exposures_given,
    item_options,
    limit_options,
    responder_given,
    rule_options,
)
from ucfrec.errors import InputError, InputNote
from ucfrec.processes import Interrupted

if TYPE_CHECKING:
    import socket

    import uvicorn

    from ucfrec.recommending.responder import Responder
    from ucfrec.recommending.workers import Parent


_STOPPED: Final = "ucfrec serve: stopped"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec serve`."""
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="run folder of `ucfrec train`; or a folder of runs, of which the one that `ucfrec "
        "promote` made current answers, and is followed",
    )
    parser.add_argument(
        "--split",
        metavar="A=SHARE,B=SHARE",
        help="answer with several runs of the folder RUN, each for its share of the users, e.g. "
        "run1=0.9,run2=0.1; the exposures have the arm (default: one run answers all)",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; one that is not this machine's own exposes the server to the "
        "network (default: 127.0.0.1)",
    )
    parser.add_argument(
        "--allowed-hosts",
        metavar="HOST[,HOST…]",
        help="answer only requests whose header Host names one of these: names, addresses, "
        "*.example.org, or * for any (default: this machine's own names where --host is 127.0.0.1, "
        "localhost or ::1, otherwise any)",
    )
    parser.add_argument("--port", type=int, default=8080, help="0 for a free one (default: 8080)")
    parser.add_argument(
        "--k", type=int, default=10, help="items, if a request does not say how many (default: 10)"
    )
    item_options(parser)
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="processes that answer on the address, each with the run in its memory (default: 1)",
    )
    parser.add_argument(
        "--threads",
        type=int,
        metavar="N",
        help="threads per forward pass (default: one per core, divided by --workers)",
    )
    rule_options(parser)
    draw_options(parser, "DIR")
    engine_option(parser)
    limit_options(parser)
    server = parser.add_argument_group("limits of the server")
    server.add_argument(
        "--max-batch", type=int, default=64, metavar="N", help="requests per forward pass (64)"
    )
    server.add_argument(
        "--max-queue", type=int, default=1024, metavar="N", help="requests in the queue (1,024)"
    )
    server.add_argument(
        "--timeout",
        type=float,
        default=5.0,
        metavar="S",
        help="timeout per request, in seconds (5)",
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec serve` until Ctrl-C or TERM, after which requests in flight are answered.

    Raises:
        InputError: the run cannot be used or has no checksums, a file of it was changed, the extra
            `serve` is not installed, or the address cannot be listened on.
    """
    from ucfrec.recommending.workers import MOST, Workers

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

    from ucfrec.recommending.served import Served, parse_split
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
    of_server = ServerLimits(
        batch=options.max_batch, queue=options.max_queue, timeout=options.timeout
    )

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
            application(served, of_server, _allowed_hosts(options), exposures, several),
            timeout_graceful_shutdown=int(of_server.timeout) + 1,
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
