"""`ucfrec serve`: answer requests over HTTP; `explore`: try policies out in the browser."""

import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ucfrec.commands.options import ARGUMENT, POSITIVE, Group, Table, settings_given
from ucfrec.commands.shared_options import AnswerOptions
from ucfrec.errors import InputNote
from ucfrec.processes import Interrupted

if TYPE_CHECKING:
    import socket

    from ucfrec.recommending.responder import Responder
    from ucfrec.recommending.server import Parent
_STOPPED = "ucfrec serve: stopped"
_SERVER = Group("the server")
_OWN_NAMES = ("localhost", "127.0.0.1", "::1")


class Serve(AnswerOptions):
    """`ucfrec serve`."""

    described_by = "ucfrec.recommending.web:ServerLimits"

    run: Annotated[Path, ARGUMENT, "RUN"]
    """Run folder of `ucfrec train`; or a folder of runs, of which the one that `ucfrec promote`
    made current answers, and is followed"""
    split: Annotated[str | None, "A=SHARE,B=SHARE"] = None
    """Answer with several runs of the folder RUN, each for its share of the users; e.g.
    run1=0.9,run2=0.1; the exposures have the arm (default: one run answers all)"""
    host: str = "127.0.0.1"
    """Address to listen on; one that is not this machine's own exposes the server to the network"""
    port: int = 8080
    """0 for a free one."""
    allowed_hosts: Annotated[str | None, _SERVER, "HOST[,HOST…]"] = None
    """Answer only requests whose header Host names one of these: names, addresses, *.example.org,
    or * for any (default: this machine's own names where --host is 127.0.0.1, localhost or ::1,
    otherwise any)"""
    engine: Annotated[Literal["torch", "onnxruntime"], _SERVER] = "torch"
    """What computes the network of requests that are not batched; onnxruntime is faster, but needs
    ucfrec[export] and some 10 seconds at the start"""
    workers: Annotated[int, _SERVER, range(1, 257), "N"] = 1
    """Processes that answer on the address, each with the run in its memory."""
    threads: Annotated[int | None, _SERVER, POSITIVE, "N"] = None
    """Threads per forward pass (default: one per core, divided by --workers)"""
    max_batch: Annotated[int | None, _SERVER, "N"] = None
    max_queue: Annotated[int | None, _SERVER, "N"] = None
    timeout: Annotated[float | None, _SERVER, "TIMEOUT"] = None
    max_connections: Annotated[int | None, _SERVER, "N"] = None
    max_connections_of_address: Annotated[int | None, _SERVER, "N"] = None

    def execute(self) -> None:
        """Answer until Ctrl-C or TERM, after which requests in flight are answered."""
        from ucfrec.recommending.server import Workers, listening_socket, print_ready

        address = listening_socket(self.host, self.port)
        if self.workers == 1:
            self._serve(address)
            return
        with address as listening, Workers(self._work, listening) as workers:
            what = workers.start(self.workers)
            print_ready(what, listening)
            try:
                workers.keep()
            except Interrupted:
                workers.end()
                print(_STOPPED, file=sys.stderr)

    def _serve(
        self, address: "AbstractContextManager[socket.socket]", parent: "Parent | None" = None
    ) -> None:
        """Answer requests in this process, which may have a parent of several."""
        import torch

        from ucfrec.recommending.responder import Served, parse_split
        from ucfrec.recommending.server import Server, print_ready, server_config
        from ucfrec.recommending.web import ServerLimits, application
        from ucfrec.runs.record import RUN, verify_run

        several, threads = self.workers > 1, self.threads
        if threads is None and several:
            threads = max(1, torch.get_num_threads() // self.workers)
        if threads is not None:
            torch.set_num_threads(threads)
        settings = settings_given(self, ServerLimits, "max_")
        limits = ServerLimits(**settings, **settings_given(self, ServerLimits))

        def make(run: Path) -> "Responder":
            verify_run(run)
            return self.make_responder(self.load(run))

        shares = None if self.split is None else parse_split(self.split)
        folder = self.run.resolve()
        if shares is None and (folder / RUN).is_file():
            folder, shares = folder.parent, {folder.name: 1.0}
        with (
            closing(Served(make, folder, shares)) as served,
            self.open_exposures(served.trained) as exposures,
        ):
            if shares is None:
                served.follow()
            hosts = list_hosts(self.allowed_hosts, self.host)
            config = server_config(
                application(served, limits, hosts, exposures, several),
                limits.timeout,
                limits.connections,
                limits.connections_of_address,
                timeout_graceful_shutdown=int(limits.timeout) + 1,
                workers=self.workers,
            )
            what = f"ucfrec serve: {served.trained!r}"
            if parent is None:
                server = Server(config, partial(print_ready, what))
            else:
                server = Server(config, lambda _: parent.report("ready", what))
                parent.ends(server)
            with address as listening:
                try:
                    server.run([listening])
                except Interrupted:
                    # What was asked of a server that is stopped is done.
                    if not several:
                        print(_STOPPED, file=sys.stderr)

    def _work(self, listening: "socket.socket", parent: "Parent") -> None:
        """Answer requests in one of several processes."""
        from ucfrec.commands.cli import explanation, notes_on_one_line

        try:
            with notes_on_one_line("ucfrec serve"):
                if not parent.first:
                    warnings.simplefilter("ignore", InputNote)
                self._serve(listening, parent)
        except Exception as error:
            why = explanation(error)
            if why is None:
                traceback.print_exc()
            parent.report("failed", why or "a worker failed; see the traceback")


def list_hosts(hosts: str | None, address: str) -> tuple[str, ...]:
    """What the header `Host` may be: a page of the web cannot reach a server of this machine by a
    name of its own (DNS rebinding).

    Args:
        hosts: names or addresses with commas between them; None for those that suit the address.
    """
    if hosts is not None:
        return tuple(host.strip() for host in hosts.split(","))
    return _OWN_NAMES if address in _OWN_NAMES else ("*",)


class Explore(Table):
    """`ucfrec explore`."""

    epilog = "Answers this machine only. Needs ucfrec[serve]."

    runs: Annotated[Sequence[Path], ARGUMENT, "RUN"]
    """Run folder of `ucfrec train`; two are shown side by side."""
    items: Annotated[Path | None, "FILE"] = None
    """Item features to show: Parquet or CSV with a column item_id, or with the name that the log
    of the run has for it; title (or name) and image_url (or image, picture, thumbnail) are shown
    as such (default: none)"""
    results: Annotated[Sequence[Path], "FILE…"] = ()
    """Results to show, as in `ucfrec report` (default: none)"""
    port: int = 8081
    """0 for a free one."""

    def execute(self) -> None:
        """Show policies until Ctrl-C or TERM."""
        from ucfrec.exploring.page import Explorer, application
        from ucfrec.recommending.server import (
            Server,
            listening_socket,
            print_ready,
            server_config,
        )
        from ucfrec.reporting.items import read_features
        from ucfrec.runs.trained_policy import TrainedPolicy

        runs = [TrainedPolicy.load(run) for run in self.runs]
        logs = [run.record.data for run in runs]
        features = None if self.items is None else read_features(self.items, logs)
        explorer = Explorer(runs, features, self.results)
        config = server_config(application(explorer, ("localhost", "127.0.0.1", "[::1]")))
        with listening_socket("127.0.0.1", self.port) as listening:
            try:
                Server(config, partial(print_ready, "ucfrec explore", page="/")).run([listening])
            except Interrupted:
                print("ucfrec explore: stopped", file=sys.stderr)
