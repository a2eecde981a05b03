"""Scalars in TensorBoard's event files: what a training logs, and reading it back."""

import struct
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary

_HEAD, _TAIL = 12, 4
"""Bytes around a record: its size with a checksum before it, a checksum behind it."""


class Events:
    """TensorBoard scalars, on disk when `add` returns: what a killed run logged is not lost.

    Args:
        folder: of the event file.
        start: the step that is gone on from; 0 at the beginning.
    """

    def __init__(self, folder: Path, start: int) -> None:
        # The names that tensorboardX gives differ by the second only; two runs must not share one.
        self._writer = EventsWriter(str(folder / "events"), f".{start:09d}")
        if start:  # what was logged after the checkpoint will be logged again
            log = SessionLog(status=SessionLog.START)
            self._writer.write_event(Event(wall_time=time.time(), step=start + 1, session_log=log))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log `scalars` by their names."""
        values = [Summary.Value(tag=name, simple_value=x) for name, x in scalars.items()]
        summary = Summary(value=values)
        self._writer.write_event(Event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Nothing can be added any more."""
        self._writer.close()


def read_scalars(folder: Path) -> dict[str, dict[int, float]]:
    """{tag: {step: value}} of all event files in `folder`, each read to where it was cut.

    Files are read oldest first: what a resumed run logged again is what counts.
    """
    scalars: dict[str, dict[int, float]] = defaultdict(dict)
    for path in sorted(folder.glob("events.out.tfevents.*")):
        content, at = path.read_bytes(), 0
        while at + _HEAD <= len(content):
            (size,) = struct.unpack_from("<Q", content, at)
            end = at + _HEAD + size
            if end + _TAIL > len(content):
                break
            event = Event.FromString(content[at + _HEAD : end])
            at = end + _TAIL
            for value in event.summary.value:
                scalars[value.tag][event.step] = value.simple_value
    return dict(scalars)
