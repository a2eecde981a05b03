"""`ucfrec recommend`: the next items of the users of a log or stream; `export`: the graph that
chooses them."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ucfrec import schema
from ucfrec.commands.options import ARGUMENT, INPUT, OUTPUT, Group
from ucfrec.commands.shared_options import (
    AnswerOptions,
    LogOptions,
    RuleOptions,
    RunArgument,
    SparkOption,
)
from ucfrec.errors import InputError, warn_user
from ucfrec.files.remote import origin
from ucfrec.processes import progress

if TYPE_CHECKING:
    from ucfrec.arrays import Array
    from ucfrec.logs.histories import Histories
    from ucfrec.runs.trained_policy import TrainedPolicy


class Recommend(AnswerOptions, SparkOption, LogOptions, RunArgument):
    """`ucfrec recommend`."""

    logs: Annotated[Sequence[str], ARGUMENT, INPUT, "LOGS"] = ()
    """Log files, folders or globs; also at s3://, …"""
    out: Annotated[Path | None, OUTPUT] = None
    """Parquet or CSV file (on Spark: folder) to write."""
    stream: bool = False
    """Instead of LOGS and --out: read requests from stdin, JSON on each line, and write answers to
    stdout; see docs/serving.md"""
    candidates: Annotated[Path | None, "FILE"] = None
    """The only items to recommend; Parquet or CSV with a column item_id, or with the name
    that the log of the run has for it (default: all)"""
    new_session: Annotated[bool, Group("answering")] = False
    """Recommend for the first step of a new session (default: the user's latest one goes on)"""
    at: Annotated[str | None, Group("answering"), "TIME"] = None
    """Time of the requests, ISO 8601 or ms, at which items must be available (default: now)"""
    approximate: Annotated[bool, Group("answering")] = False
    """Find the items approximately, for large catalogues: needs ucfrec[faiss] and a rule without a
    temperature; says the recall (default: exactly)"""
    engine: Annotated[Literal["torch", "onnxruntime", "spark"], Group("engine")] = "torch"
    """What computes: onnxruntime, with --stream, is faster but needs ucfrec[export] and some 10
    seconds at the start; with spark, each worker writes a part of the folder --out"""

    def execute(self) -> None:
        """Write the recommendations, or answer a stream."""
        if self.stream:
            self._answer_stream()
            return
        if not self.logs or self.out is None:
            raise InputError(
                "name LOGS after the run and the file to write with --out; or give --stream"
            )
        from ucfrec.files.parquet import require_table_names, write_frames
        from ucfrec.recommending.histories import histories_of_files
        from ucfrec.recommending.recommend import ItemIndex, recommend

        if (master := self.find_spark()) is None:
            require_table_names([self.out, self.exposures])
        trained, index = self.load(self.run), None
        files, mapping = self.find_logs(self.logs, trained, [self.out, self.exposures])
        how: Any = {
            "rule": (rule := self.make_rule(trained)),
            "filter_seen": not self.keep_seen,
            "skip_unknown": self.skip_unknown,
            "new_session": self.new_session,
            "at": self.at,
            "seed": self.seed,
        }
        if master is not None:
            from ucfrec.recommending.spark import recommend_with_spark

            if self.approximate:
                raise InputError("--engine spark finds items exactly; leave --approximate out")
            if self.candidates is not None:
                raise InputError("--engine spark recommends all items; leave --candidates out")
            rows = recommend_with_spark(
                trained,
                files,
                mapping,
                self.out,
                master,
                self.k,
                exposures=self.exposures,
                checkpoint=self.checkpoint,
                memory_limit=self.memory_limit,
                **how,
            )
            print(f"{origin(self.out)}: {rows:,} rows")
            return
        if self.approximate:
            index = ItemIndex(trained.item_scorer(rule), trained.name)
        with progress(None, "recommend", "users") as bar:

            def count_users() -> "Iterator[Histories]":
                for batch in histories_of_files(trained, files, mapping, self.memory_limit):
                    yield batch
                    bar.update(len(batch.users))

            candidates = self._read_candidates(trained)
            frames = recommend(
                trained, count_users(), self.k, candidates=candidates, index=index, **how
            )
            if self.exposures is None:
                rows = write_frames(self.out, frames)
            else:
                from ucfrec.recommending.exposures import exposures_written

                with exposures_written(
                    self.exposures, trained, rule.hash, frames, candidates
                ) as written:
                    rows = write_frames(self.out, written)
        print(f"{origin(self.out)}: {rows:,} rows")
        if index is not None and index.wanted:
            print(
                f"recall@{self.k} against the exact search: {index.found / index.wanted:.3f} "
                f"({index.sampled:,} users)"
            )

    def _read_candidates(self, trained: "TrainedPolicy") -> "Array | None":
        """The ids in the file of candidates that the run knows; all ids if it knows none."""
        if self.candidates is None:
            return None
        from ucfrec.reporting.training import read_features

        table = read_features(self.candidates, [trained.record.data], text_ids=True)
        column = table.column(schema.ITEM_ID).drop_null()
        ids: Array = column.unique().to_numpy(zero_copy_only=False)
        in_run = trained.items.numbers(ids) >= 0
        if in_run.all() or not in_run.any():
            return ids
        warn_user(
            f"{self.candidates}: the run does not know {int((~in_run).sum()):,} of {len(ids):,} "
            "items, which are not recommended; prepare and train on logs with them"
        )
        return ids[in_run]

    def _answer_stream(self) -> None:
        from ucfrec.recommending.stream import answer_stream

        refusals = {
            "--stream reads stdin and writes stdout; leave LOGS and --out out": self.logs
            or self.out,
            "--stream answers in this process; leave --engine spark out": self.engine == "spark"
            or self.spark_master,
            "--stream finds items exactly; leave --approximate out": self.approximate,
            "with --stream, each line says new_session; leave --new-session out": self.new_session,
            "with --stream, requests are of now; leave --at out": self.at,
            "with --stream, each line has its candidates; leave --candidates out": self.candidates,
        }
        for message, refused in refusals.items():
            if refused:
                raise InputError(message)
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

    onnx: Annotated[Path, "OUT"]
    """Folder to make, with the graph."""
    k: int | None = None

    def execute(self) -> None:
        """Write the policy with its rule as an ONNX graph, and compare it with torch."""
        from ucfrec.recommending.export import export

        trained = self.load(self.run)
        written = export(trained, self.onnx, rule=self.make_rule(trained), k=self.k)
        print(
            f"{self.onnx}: {written.size / 1e6:,.1f} MB, scores equal torch's to "
            f"{written.difference:.1g}"
        )
