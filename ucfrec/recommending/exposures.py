"""What was shown to whom, with its probability: the Parquet files that `ucfrec join` reads."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING
from uuid import uuid4

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError, explain_os_error
from ucfrec.files.atomic import atomic_file
from ucfrec.files.parquet import table_writer
from ucfrec.logs.candidates import ITEMS, name_set, write_sets
from ucfrec.recommending.recommend import RANK, read_time
from ucfrec.runs.trained_policy import TrainedPolicy

if TYPE_CHECKING:
    from ucfrec.recommending.responder import Answer

_ROWS = 50_000
_SECONDS = 60.0
_IDS = 1_000_000
"""Ids of candidates, each set once, from which on a file is written."""
_MOST_WAITING = 20
"""Files' worth of what waits while the disk cannot be written; later rows are lost."""


def exposure_schema(trained: TrainedPolicy) -> pa.Schema:
    """Columns of exposures: users are text, as any client names them; items as in the run."""
    item = pa.int64() if trained.items.ids.dtype.kind in "iu" else pa.string()
    return pa.schema(
        {
            schema.USER_ID: pa.string(),
            schema.ITEM_ID: item,
            schema.TIMESTAMP: pa.int64(),
            schema.REQUEST_ID: pa.string(),
            schema.POSITION: pa.int32(),
            schema.PROPENSITY: pa.float64(),
            schema.SESSION_BEGAN: pa.int64(),
            schema.EXCLUDES_SEEN: pa.bool_(),
            schema.RUN: pa.string(),
            schema.RULE: pa.string(),
            schema.ARM: pa.string(),
            schema.CANDIDATES: pa.string(),
        }
    )


def _tabulate_sets(sets: Mapping[str, Array | None]) -> pa.Table:
    """Sets of candidates by their names, but for None, everything."""
    lists = {n: np.unique(ids).astype(str).tolist() for n, ids in sets.items() if ids is not None}
    return pa.table({schema.CANDIDATES: [*lists], ITEMS: [*lists.values()]})


@contextmanager
def exposures_written(
    path: Path,
    trained: TrainedPolicy,
    rule: str,
    decisions: Iterable[tuple[pd.DataFrame, IntArray]],
    candidates: Array | None = None,
    *,
    excludes_seen: bool,
    at: str | float | None = None,
) -> Iterator[Iterator[pd.DataFrame]]:
    """Yield the frames of `decide`, also written to a file, whole once the block ends; the ids that
    were `candidates` are in a file beside it.

    Requests are a millisecond apart, from the time `at` on, or from now, so that a split by time
    can part them.
    """
    columns = exposure_schema(trained)
    begin = read_time(at) or int(time.time() * 1000)
    constants: dict[str, str | bool] = {
        schema.RUN: trained.fingerprint,
        schema.RULE: rule,
        schema.ARM: "",
        schema.EXCLUDES_SEEN: excludes_seen,
        schema.CANDIDATES: name_set(candidates),
    }
    write_sets(path, _tabulate_sets({name_set(candidates): candidates}))

    def write_all() -> Iterator[pd.DataFrame]:
        first = begin
        for frame, began in decisions:
            exposures = frame.rename(columns={RANK: schema.POSITION}).assign(**constants)
            times = first + exposures[schema.USER_ID].factorize()[0]
            exposures[schema.TIMESTAMP] = times
            exposures[schema.SESSION_BEGAN] = np.where(began < 0, times, began)
            first = int(times.max(initial=first - 1)) + 1
            exposures[schema.USER_ID] = exposures[schema.USER_ID].astype(str)
            table = pa.Table.from_pandas(exposures[columns.names], columns, preserve_index=False)
            writer.write_table(table)
            yield frame

    with atomic_file(path) as scratch, table_writer(scratch, path, columns) as writer:
        yield write_all()


class ExposureLog:
    """Writes the exposures of a server to files of a folder, in a thread of its own.

    A file appears whole, once there are enough rows or the oldest has waited long enough, and when
    the log is closed. What waits is in memory: a killed process loses it.
    """

    def __init__(
        self,
        folder: Path,
        trained: TrainedPolicy,
        rows: int = _ROWS,
        seconds: float = _SECONDS,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """
        Args:
            rows: from so many on a file is written.
            seconds: after so long, a file is written if there are any rows.
            clock: seconds since 1970, when an answer is given.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=folder).close()
        except OSError as error:
            what = explain_os_error(error)
            raise InputError(f"{folder} cannot be written ({what}); name another folder") from None
        self._folder, self._schema = folder, exposure_schema(trained)
        self._rows = rows
        self._seconds = seconds
        self._clock = clock
        self._waiting: list[tuple[str, int, str, Answer]] = []
        self._sets: dict[str, Array | None] = {}
        self._count, self._ids, self._lost = 0, 0, 0
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="exposures", daemon=True)
        self._thread.start()

    def add(self, user_id: int | str, answer: "Answer") -> None:
        """Remember an answer that is given now; takes microseconds, or a tenth of a millisecond for
        a thousand candidates."""
        now, size = int(self._clock() * 1000), len(answer.items)
        candidates = name_set(answer.candidates)
        with self._lock:
            if max(self._count / self._rows, self._ids / _IDS) > _MOST_WAITING:
                self._lost += size
                return
            self._waiting.append((str(user_id), now, candidates, answer._replace(candidates=None)))
            if answer.candidates is not None and candidates not in self._sets:
                self._sets[candidates] = answer.candidates
                self._ids += len(answer.candidates)
            self._count += size
            full = self._count >= self._rows or self._ids >= _IDS
        if full:
            self._wake.set()

    def close(self) -> None:
        """Write what waits, and end the thread; InputError if rows were lost."""
        self._closed = True
        self._wake.set()
        self._thread.join()
        if self._lost:
            raise InputError(
                f"{self._folder}: {self._lost:,} rows of exposures are lost, as they could not be "
                "written; make room, or make the folder writable"
            )

    def _run(self) -> None:
        closed = False
        while not closed:
            self._wake.wait(self._seconds)
            # First: a close after this wakes the next wait.
            self._wake.clear()
            closed = self._closed
            self._flush(last=closed)

    def _flush(self, last: bool) -> None:
        with self._lock:
            waiting, self._waiting, count, self._count = self._waiting, [], self._count, 0
            sets, self._sets, ids, self._ids = self._sets, {}, self._ids, 0
        if not count:
            return
        # Feedback of what is shown before midnight may be of the next day, not of the day before.
        oldest = datetime.fromtimestamp(waiting[0][1] / 1000, UTC)
        name = f"exposures-{oldest:%Y%m%dT%H%M%S}-{uuid4().hex[:12]}.parquet"
        try:
            write_sets(self._folder / name, _tabulate_sets(sets))
            with atomic_file(self._folder / name) as scratch:
                pq.write_table(self._table(waiting), scratch)
        except (OSError, InputError, pa.ArrowException) as error:
            with self._lock:
                if last:
                    self._lost += count
                else:
                    self._waiting, self._count = waiting + self._waiting, self._count + count
                    self._sets, self._ids = sets | self._sets, ids + self._ids
                what = f"{error}; {self._count:,} rows wait, {self._lost:,} are lost"
            message = f"ucfrec: exposures: {self._folder / name} cannot be written: {what}"
            print(message, file=sys.stderr, flush=True)
            # A full log would otherwise try again at every answer.
            time.sleep(min(1.0, self._seconds))

    def _table(self, waiting: "list[tuple[str, int, str, Answer]]") -> pa.Table:
        rows = [
            (
                *(user, item, now, a.request_id, position, chance),
                now if a.session_began < 0 else a.session_began,
                *(a.excludes_seen, a.run, a.rule, a.arm, candidates),
            )
            for user, now, candidates, a in waiting
            for position, (item, chance) in enumerate(zip(a.items, a.propensities, strict=True), 1)
        ]
        frame = pd.DataFrame(rows, columns=self._schema.names)
        return pa.Table.from_pandas(frame, self._schema, preserve_index=False)
