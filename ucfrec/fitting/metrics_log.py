"""`metrics.jsonl`: the scalars of a training, one JSON object a line."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ucfrec.errors import InputError
from ucfrec.fitting.tensorboard import Events

METRICS = "metrics.jsonl"
_STEP = "step"
_LARGEST_STEP = 2**53
"""Steps up to here are exact as floats."""


class MetricsLog:
    """Writes scalars to `metrics.jsonl` and to TensorBoard's event files.

    Both are on disk when `add` returns, so a killed training loses nothing that it logged. A line
    is `{"step": 500, "loss": 1.25, …}`; a value that is not finite is written as null.

    Args:
        folder: of both files; it exists.
        start: the step that training resumes from; 0 at the beginning.
    """

    def __init__(self, folder: Path, start: int) -> None:
        self._path = folder / METRICS
        if self._path.exists():
            _drop_torn_line(self._path)
        self._events = Events(folder, start)

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log `scalars` by their names; none is called `step`."""
        finite = {name: x if math.isfinite(x) else None for name, x in scalars.items()}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({_STEP: step} | finite, allow_nan=False) + "\n")
        self._events.add(step, scalars)

    def close(self) -> None:
        """End the event file."""
        self._events.close()


def read_metrics(folder: Path) -> dict[str, dict[int, float]]:
    """Read `metrics.jsonl` in `folder`; no scalars where there is no such file.

    A resumed training may log a step again: the later line counts. A last line that was cut off is
    left out, so a training can be read while it runs.

    Returns:
        {name: {step: value}}, steps in order; NaN for a value that was not finite.

    Raises:
        InputError: a line is something else.
    """
    path = folder / METRICS
    if not path.exists():
        return {}
    *lines, _torn = path.read_bytes().split(b"\n")
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
        raise _wrong(where, "is not JSON") from None
    if not isinstance(values, dict):
        raise _wrong(where, "is no JSON object")
    step = values.pop(_STEP, None)
    if type(step) is not int or not 0 <= step <= _LARGEST_STEP:
        raise _wrong(where, f"has no whole number from 0 as {_STEP!r}")
    return step, {name: _number(name, value, where) for name, value in values.items()}


def _number(name: str, value: Any, where: str) -> float:
    if value is None:
        return math.nan
    if type(value) not in (int, float):
        raise _wrong(where, f"has no number as {name!r}")
    try:
        return float(value)
    except OverflowError:
        raise _wrong(where, f"has too large a number as {name!r}") from None


def _wrong(where: str, what: str) -> InputError:
    return InputError(f"{where} {what}; delete the line, or restore the file")


def _drop_torn_line(path: Path) -> None:
    """Cut off what a killed process left of its last line."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("r+b") as file:
            file.truncate(whole)
