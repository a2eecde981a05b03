"""`metrics.jsonl`: the scalars logged by a training, one JSON object per line."""

import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ucfrec.errors import InputError
from ucfrec.files.atomic import json_text

METRICS = "metrics.jsonl"
_STEP = "step"
_LARGEST_STEP = 2**53
"""The largest range of integers that floats represent exactly."""


class MetricsLog:
    """Writes scalars to `metrics.jsonl` and to a TensorBoard event file.

    Both are written to disk before `add` returns, so a killed training loses nothing that it
    logged. A line is `{"step": 500, "loss": 1.25, …}`; a value that is not finite becomes null.

    Args:
        folder: of both files; must exist.
        start: the step that training resumes from; 0 for a new training.
    """

    def __init__(self, folder: Path, start: int) -> None:
        self._path = folder / METRICS
        if self._path.exists():
            _drop_incomplete_line(self._path)
        self._events = Events(folder, start)

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log named scalars; the name `step` is reserved."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json_text({_STEP: step, **scalars}) + "\n")
        self._events.add(step, scalars)

    def close(self) -> None:
        """Close the event file."""
        self._events.close()


def read_metrics(folder: Path) -> dict[str, dict[int, float]]:
    """Read `metrics.jsonl` in `folder`, also while the training is running.

    If a resumed training logged a step again, the later line is used. An incomplete last line is
    ignored.

    Returns:
        {name: {step: value}}, steps in ascending order, NaN for a value that was not finite; empty
        if the file does not exist.

    Raises:
        InputError: a line is not an object of a step and numbers.
    """
    path = folder / METRICS
    if not path.exists():
        return {}
    *lines, _incomplete = path.read_bytes().split(b"\n")
    scalars: dict[str, dict[int, float]] = {}
    for number, line in enumerate(lines, start=1):
        step, values = _parsed(line, f"{path}, line {number},")
        for name, value in values.items():
            scalars.setdefault(name, {})[step] = value
    return {name: dict(sorted(curve.items())) for name, curve in scalars.items()}


def _parsed(line: bytes, where: str) -> tuple[int, dict[str, float]]:
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        raise _bad_line(where, "is not JSON") from None
    if not isinstance(values, dict):
        raise _bad_line(where, "is not a JSON object")
    step = values.pop(_STEP, None)
    if type(step) is not int or not 0 <= step <= _LARGEST_STEP:
        raise _bad_line(where, f"has no whole number of 0 or more as {_STEP!r}")
    return step, {name: _number(name, value, where) for name, value in values.items()}


def _number(name: str, value: Any, where: str) -> float:
    if value is None:
        return math.nan
    if type(value) not in (int, float):
        raise _bad_line(where, f"has no number as {name!r}")
    try:
        return float(value)
    except OverflowError:
        raise _bad_line(where, f"has too large a number as {name!r}") from None


def _bad_line(where: str, problem: str) -> InputError:
    return InputError(f"{where} {problem}; delete the line, or restore the file")


def _drop_incomplete_line(path: Path) -> None:
    """Remove an incomplete last line, which a killed process left."""
    content = path.read_bytes()
    complete = content.rfind(b"\n") + 1
    if complete < len(content):
        with path.open("r+b") as file:
            file.truncate(complete)


class Events:
    """Writes an event file for TensorBoard; ucfrec itself never reads it.

    `tensorboardX.SummaryWriter` writes in a thread and does not report when an event is on disk;
    this class writes synchronously, before `add` returns.

    Args:
        folder: of the event file; must exist.
        start: the step that training resumes from; 0 for a new training.
    """

    def __init__(self, folder: Path, start: int) -> None:
        # Not above: it imports boto3 if that is installed, and most commands only read metrics.
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        # tensorboardX names files by the second; the suffix keeps a quick resumption from reusing
        # the name.
        self._writer = EventsWriter(str(folder / "events"), f".{start:09d}")
        if start:  # makes TensorBoard discard events that were logged after the checkpoint
            log = SessionLog(status=SessionLog.START)
            self._writer.write_event(Event(wall_time=time.time(), step=start + 1, session_log=log))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log named scalars."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        values = [Summary.Value(tag=name, simple_value=x) for name, x in scalars.items()]
        summary = Summary(value=values)
        self._writer.write_event(Event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
