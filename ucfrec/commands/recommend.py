"""`ucfrec recommend` and `serve`: the next items of users, in batches, as a stream or over HTTP;
`export`: the graph that chooses them; `explore`: try policies out in the browser."""

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ucfrec import schema
from ucfrec.commands.options import (
    ARGUMENT,
    INPUT,
    OUTPUT,
    POSITIVE,
    Group,
    Table,
    read_number,
    settings_given,
)
from ucfrec.commands.shared_options import LogOptions, RuleOptions, RunArgument, SparkOption
from ucfrec.errors import InputError, InputNote
from ucfrec.files.remote import origin
from ucfrec.processes import Interrupted, progress

if TYPE_CHECKING:
    import socket

    import pandas as pd

    from ucfrec.arrays import Array
    from ucfrec.logs.histories import Histories
    from ucfrec.recommending.exposures import ExposureLog
    from ucfrec.recommending.responder import Responder
    from ucfrec.recommending.server import Parent
    from ucfrec.runs.trained_policy import TrainedPolicy
_STOPPED = "ucfrec serve: stopped"
_OWN_NAMES = ("localhost", "127.0.0.1", "::1")


class AnswerOptions(RuleOptions):
    """How requests are answered, and the largest that are."""

    title = "answering"
    described_by = "ucfrec.recommending.requests:Limits"
    prefix = "max_"
    engine: str

    k: Annotated[int, Group("")] = 10
    """Items for each user; if a request does not say how many."""
    exposures: Annotated[Path | None, Group("")] = None
    """Write what was shown, with its probability; a folder for requests; see docs/exposures.md"""
    keep_seen: Annotated[bool, Group("")] = False
    """Also recommend items that the user has seen; (default: leave them out)"""
    skip_unknown: bool = False
    """Ignore rows and candidates with items outside the run's catalogue (default: an error)"""
    seed: int = 0
    """Of the draws of a rule with --temperature or --explore."""
    max_bytes: int | None = None
    max_k: int | None = None
    max_history: int | None = None
    max_candidates: int | None = None

    def make_responder(self, trained: "TrainedPolicy") -> "Responder":
        """What answers requests."""
        from ucfrec.recommending.requests import Limits
        from ucfrec.recommending.responder import Responder

        return Responder(
            trained,
            Limits(**settings_given(self, Limits, "max_")),
            rule=self.make_rule(trained),
            k=self.k,
            filter_seen=not self.keep_seen,
            skip_unknown=self.skip_unknown,
            seed=self.seed,
            engine=self.engine,
        )

    def open_exposures(
        self, trained: "TrainedPolicy"
    ) -> "AbstractContextManager[ExposureLog | None]":
        """Where a server's answers are written; None for nowhere."""
        from ucfrec.recommending.exposures import ExposureLog

        if not self.exposures:
            return nullcontext()
        return closing(ExposureLog(self.exposures, trained))


class Recommend(AnswerOptions, SparkOption, LogOptions, RunArgument):
    """`ucfrec recommend`."""

    logs: Annotated[Sequence[str], ARGUMENT, INPUT] = ()
    """Log files, folders or globs; also at s3://, …"""
    out: Annotated[Path | None, OUTPUT] = None
    """Parquet or CSV file (on Spark: folder) to write."""
    stream: bool = False
    """Instead of LOGS and --out: read requests from stdin, JSON on each line, and write answers to
    stdout; see docs/serving.md"""
    candidates: Path | None = None
    """The only items to recommend; Parquet or CSV with a column item_id, or with the name
    that the log of the run has for it (default: all)"""
    new_session: Annotated[bool, Group("answering")] = False
    """Recommend for the first step of a new session (default: the user's latest one goes on)"""
    at: Annotated[str | None, Group("answering"), "TIME"] = None
    """Time of the requests, ISO 8601 or ms: items must be available, rows earlier (default: now)"""
    approximate: Annotated[bool, Group("answering")] = False
    """Find the items approximately, for large catalogues: needs ucfrec[faiss] and a rule without a
    temperature; says the recall (default: exactly)"""
    engine: Annotated[Literal["torch", "onnxruntime", "spark"], Group("engine")] = "torch"
    """What computes: onnxruntime, with --stream, is faster but needs ucfrec[export] and some 10
    seconds at the start; with spark, each worker writes a part of the folder --out"""

    def execute(self) -> None:
        """Write the recommendations, or answer a stream."""
        if self.stream and not (self.logs or self.out):
            self._answer_stream()
        elif self.stream or not self.out or not self.logs:
            raise InputError(
                "name LOGS after the run and the file to write with --out, or give only --stream"
            )
        else:
            self._recommend(self.out)

    def _recommend(self, out: Path) -> None:
        from ucfrec.files.parquet import require_table_names, write_frames
        from ucfrec.recommending.exposures import exposures_written
        from ucfrec.recommending.histories import histories_of_files
        from ucfrec.recommending.recommend import ItemIndex, decide, read_time

        if (master := self.find_spark()) is None:
            require_table_names([out, self.exposures])
        trained, index = self.load(self.run), None
        rule = self.make_rule(trained)
        files, mapping = self.find_logs(self.logs, trained, [out, self.exposures])
        mapping = replace(mapping, before_ms=read_time(self.at))
        how: Any = {
            "rule": rule,
            "filter_seen": not self.keep_seen,
            "skip_unknown": self.skip_unknown,
            "new_session": self.new_session,
            "at": self.at,
            "seed": self.seed,
        }
        if master is not None:
            from ucfrec.recommending.spark import recommend_with_spark

            self._refuse("--engine spark", "approximate", "candidates")
            how |= {"exposures": self.exposures, "checkpoint": self.checkpoint}
            how |= {"memory_limit": self.memory_limit}
            rows = recommend_with_spark(trained, files, mapping, out, master, self.k, **how)
        else:
            if self.approximate:
                index = ItemIndex(trained.item_scorer(rule), trained.name)
            with progress(None, "recommend", "users") as bar, ExitStack() as stack:

                def count_users() -> "Iterator[Histories]":
                    for batch in histories_of_files(trained, files, mapping, self.memory_limit):
                        yield batch
                        bar.update(len(batch.users))

                candidates = self._read_candidates(trained)
                how |= {"candidates": candidates, "index": index}
                decisions = decide(trained, count_users(), self.k, **how)
                frames: Iterator[pd.DataFrame] = (frame for frame, _ in decisions)
                if self.exposures:
                    exposures = exposures_written(
                        self.exposures,
                        trained,
                        rule.hash,
                        decisions,
                        candidates,
                        excludes_seen=not self.keep_seen,
                        at=self.at,
                    )
                    frames = stack.enter_context(exposures)
                rows = write_frames(out, frames)
        print(f"{origin(out)}: {rows:,} rows")
        if index is not None and index.wanted:
            print(
                f"recall@{self.k} against the exact search: {index.found / index.wanted:.3f} "
                f"({index.sampled:,} users)"
            )

    def _refuse(self, case: str, *names: str) -> None:
        """Refuse the options that have no effect in a case."""
        if options := [f"--{name.replace('_', '-')}" for name in names if getattr(self, name)]:
            raise InputError(f"with {case}, leave {', '.join(options)} out")

    def _read_candidates(self, trained: "TrainedPolicy") -> "Array | None":
        """The different ids in the file of candidates."""
        if not self.candidates:
            return None
        from ucfrec.reporting.items import read_features

        table = read_features(self.candidates, [trained.record.data], text_ids=True)
        column = table.column(schema.ITEM_ID).drop_null()
        ids: Array = column.unique().to_numpy(zero_copy_only=False)
        return ids

    def _answer_stream(self) -> None:
        from ucfrec.recommending.stream import answer_stream

        self._refuse("--stream", "approximate", "new_session", "candidates", "at", "spark_master")
        if self.engine == "spark":
            raise InputError("--stream answers in this process; leave --engine spark out")
        trained = self.load(self.run)
        # Unbuffered, so that a request is answered without waiting for the next ones.
        with (
            closing(self.make_responder(trained)) as responder,
            self.open_exposures(trained) as exposures,
            open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as source,
        ):
            counts = answer_stream(responder, source, sys.stdout.buffer, exposures=exposures)
        print(
            f"ucfrec recommend: {counts['answers']:,} answers, {counts['errors']:,} errors",
            file=sys.stderr,
        )


class Export(RuleOptions, RunArgument):
    """`ucfrec export`."""

    described_by = "ucfrec.python_api.recommender:Recommender.export"

    onnx: Path
    """Folder to make, with the graph."""
    k: int | None = None

    def execute(self) -> None:
        """Write the policy with its rule as an ONNX graph, and compare it with torch."""
        from ucfrec.recommending.export import export

        trained = self.load(self.run)
        rule = self.make_rule(trained)
        written = export(trained, self.onnx, rule=rule, k=self.k)
        print(
            f"{self.onnx}: {written.size / 1e6:,.1f} MB, scores equal torch's to "
            f"{written.difference:.1g}"
        )


class Serve(AnswerOptions):
    """`ucfrec serve`."""

    title = "the server"
    described_by = "ucfrec.recommending.web:ServerLimits"

    run: Annotated[Path, ARGUMENT]
    """Run folder of `ucfrec train`; or a folder of runs, of which the one that `ucfrec promote`
    made current answers, and is followed"""
    split: Annotated[str | None, Group(""), "A=SHARE,B=SHARE"] = None
    """Answer with several runs of the folder RUN, each for its share of the users; e.g.
    run1=0.9,run2=0.1; the exposures have the arm (default: one run answers all)"""
    host: Annotated[str, Group("")] = "127.0.0.1"
    """Address to listen on; one that is not this machine's own exposes the server to the network"""
    port: Annotated[int, Group("")] = 8080
    """0 for a free one."""
    allowed_hosts: Annotated[str | None, "HOST[,HOST…]"] = None
    """Answer only requests whose header Host names one of these: names, addresses, *.example.org,
    or * for any (default: this machine's own names where --host is 127.0.0.1, localhost or ::1,
    otherwise any)"""
    engine: Literal["torch", "onnxruntime"] = "torch"
    """What computes the network of requests that are not batched; onnxruntime is faster, but needs
    ucfrec[export] and some 10 seconds at the start"""
    workers: Annotated[int, partial(read_number, range(1, 257))] = 1
    """Processes that answer on the address, each with the run in its memory."""
    threads: Annotated[int | None, POSITIVE] = None
    """Threads per forward pass (default: one per core, divided by --workers)"""
    max_batch: int | None = None
    max_queue: int | None = None
    timeout: float | None = None
    max_connections: int | None = None
    max_connections_of_address: int | None = None

    def execute(self) -> None:
        """Answer until Ctrl-C or TERM, after which requests in flight are answered."""
        from ucfrec.recommending.server import Workers, listening_socket, print_ready

        with listening_socket(self.host, self.port) as listening:
            if self.workers == 1:
                self._serve(listening)
                return
            with Workers(self._work, listening) as workers:
                print_ready(workers.start(self.workers), listening)
                try:
                    workers.keep()
                except Interrupted:
                    workers.end()
                    print(_STOPPED, file=sys.stderr)

    def _serve(self, listening: "socket.socket", parent: "Parent | None" = None) -> None:
        """Answer requests in this process, which may have a parent of several."""
        import torch

        from ucfrec.recommending.responder import Served, parse_split
        from ucfrec.recommending.server import Server, print_ready, server_config
        from ucfrec.recommending.web import ServerLimits, application
        from ucfrec.runs.record import RUN, verify_run

        threads = self.threads or max(1, torch.get_num_threads() // self.workers)
        torch.set_num_threads(threads)
        settings = settings_given(self, ServerLimits, "max_")
        limits = ServerLimits(**settings, **settings_given(self, ServerLimits))

        def make(run: Path) -> "Responder":
            verify_run(run)
            return self.make_responder(self.load(run))

        shares = parse_split(self.split) if self.split else None
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
                application(served, limits, hosts, exposures, self.workers > 1),
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
            # What was asked of a server that is stopped is done.
            with suppress(Interrupted):
                server.run([listening])
            if parent is None:
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
            if (why := explanation(error)) is None:
                raise
            parent.report("failed", why)


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
    items: Path | None = None
    """Item features to show: Parquet or CSV with a column item_id, or with the name that the log
    of the run has for it; title (or name) and image_url (or image, picture, thumbnail) are shown
    as such (default: none)"""
    results: Annotated[Sequence[Path], "FILE"] = ()
    """Results to show, as in `ucfrec report`; repeatable."""
    port: int = 8081
    """0 for a free one."""

    def execute(self) -> None:
        """Show policies until Ctrl-C or TERM."""
        from ucfrec.exploring.page import Explorer, application
        from ucfrec.recommending.server import Server, listening_socket, print_ready, server_config
        from ucfrec.reporting.items import read_features
        from ucfrec.runs.trained_policy import TrainedPolicy

        runs = [TrainedPolicy.load(run) for run in self.runs]
        logs = [run.record.data for run in runs]
        features = read_features(self.items, logs) if self.items else None
        explorer = Explorer(runs, features, self.results)
        config = server_config(application(explorer, ("localhost", "127.0.0.1", "[::1]")))
        with listening_socket("127.0.0.1", self.port) as listening:
            with suppress(Interrupted):
                Server(config, partial(print_ready, "ucfrec explore", page="/")).run([listening])
            print("ucfrec explore: stopped", file=sys.stderr)
