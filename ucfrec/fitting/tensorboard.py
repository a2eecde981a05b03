"""Writing scalars to a TensorBoard event file."""

import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary


class Events:
    """Writes an event file for TensorBoard; ucfrec itself never reads it.

    `tensorboardX.SummaryWriter` writes in a thread and does not report when an event is on disk;
    this class writes synchronously, before `add` returns.

    Args:
        folder: of the event file; must exist.
        start: the step that training resumes from; 0 for a new training.
    """

    def __init__(self, folder: Path, start: int) -> None:
        # tensorboardX names files by the second; the suffix keeps a quick resumption from reusing
        # the name.
        self._writer = EventsWriter(str(folder / "events"), f".{start:09d}")
        if start:  # makes TensorBoard discard events that were logged after the checkpoint
            log = SessionLog(status=SessionLog.START)
            self._writer.write_event(Event(wall_time=time.time(), step=start + 1, session_log=log))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log named scalars."""
        values = [Summary.Value(tag=name, simple_value=x) for name, x in scalars.items()]
        summary = Summary(value=values)
        self._writer.write_event(Event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
