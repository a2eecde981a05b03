"""Scalars as TensorBoard's event files."""

import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary


class Events:
    """Writes an event file for TensorBoard; nothing in ucfrec reads it.

    `tensorboardX.SummaryWriter` hands events to a thread and cannot say when they are written. This
    writes them itself: they are on disk when `add` returns.

    Args:
        folder: of the event file.
        start: the step that training resumes from; 0 at the beginning.
    """

    def __init__(self, folder: Path, start: int) -> None:
        # The names that tensorboardX gives differ by the second only; two runs must not share one.
        self._writer = EventsWriter(str(folder / "events"), f".{start:09d}")
        if start:  # tells TensorBoard to forget what was logged after the checkpoint
            log = SessionLog(status=SessionLog.START)
            self._writer.write_event(Event(wall_time=time.time(), step=start + 1, session_log=log))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log `scalars` by their names."""
        values = [Summary.Value(tag=name, simple_value=x) for name, x in scalars.items()]
        summary = Summary(value=values)
        self._writer.write_event(Event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """End the file."""
        self._writer.close()
