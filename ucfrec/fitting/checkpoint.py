"""Files of a training: tensors with metadata (safetensors); scalars, for us and TensorBoard."""

import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from pydantic import Field, TypeAdapter
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import json_text, require_file, save_arrays

REMEDY = "restore it or train again"
"""What to do about a damaged file."""
METRICS = "metrics.jsonl"
_STEP = "step"
_LARGEST_STEP = 2**53
"""The largest range of integers that floats represent exactly."""
_LINE = TypeAdapter(dict[str, Annotated[float, Field(strict=True)] | None])
_Module = TypeVar("_Module", bound=nn.Module)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write named tensors and JSON metadata, atomically; InputError if there is no space."""
    plain = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    save_arrays(path, {name: tensor.numpy() for name, tensor in plain.items()}, metadata)


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors, on the CPU, and the metadata that `save_tensors` wrote; InputError if the
    file is missing or damaged."""
    # safetensors may call whatever it cannot read a missing file.
    require_file(path, REMEDY)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("about", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return tensors, dict(metadata)
    except (SafetensorError, OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); {REMEDY}") from None


def load_module(path: Path, build: Callable[[], _Module], tensors: dict[str, Tensor]) -> _Module:
    """Build a module and load `tensors` into it, which were read from `path`.

    The sizes of a module come from a record that may state any. They are compared with those of the
    tensors, which a file holds, before memory is allocated. Errors as of `load_weights`.
    """
    try:
        with torch.device("meta"):
            unfilled: nn.Module | None = build()
    except Exception:  # a constructor that needs memory, or one whose error shows below
        unfilled = None
    if unfilled is not None:
        load_weights(path, unfilled, tensors, assign=True)
    with damage_explained(path, REMEDY):
        module = build()
    load_weights(path, module, tensors)
    return module


def load_weights(
    path: Path,
    module: nn.Module,
    tensors: Mapping[str, Tensor],
    assign: bool = False,
) -> None:
    """Load `tensors`, which were read from `path`, into `module`; copied unless `assign`.
    InputError if they are the weights of another architecture."""
    try:
        module.load_state_dict(tensors, assign=assign)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise InputError(
            f"{path} holds weights of another architecture ({first}); use the settings that it was "
            "trained with, or another folder"
        ) from None


class MetricsLog:
    """Writes scalars to `metrics.jsonl`, which is read back, and to an event file of TensorBoard.

    Both are on disk before `add` returns, so a killed training loses nothing that it logged;
    `tensorboardX.SummaryWriter` would write in a thread. A line is `{"step": 500, "loss": 1.25}`; a
    value that is not finite becomes null. Training resumes from step `start`.
    """

    def __init__(self, folder: Path, start: int) -> None:
        # Not above: it imports boto3 if that is installed, and most commands only read metrics.
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._path, self._event = folder / METRICS, Event
        if self._path.exists():
            with self._path.open("r+b") as file:  # without the part of a line of a killed process
                file.truncate(file.read().rfind(b"\n") + 1)
        # tensorboardX names files by the second; the suffix keeps a quick resumption from reusing
        # the name.
        self._events = EventsWriter(str(folder / "events"), f".{start:09d}")
        if start:  # makes TensorBoard discard events that were logged after the checkpoint
            log = SessionLog(status=SessionLog.START)
            self._events.write_event(Event(wall_time=time.time(), step=start + 1, session_log=log))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log named scalars; the name `step` is reserved."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json_text({_STEP: step, **scalars}) + "\n")
        event = self._event(wall_time=time.time(), step=step)
        for name, value in scalars.items():
            event.summary.value.add(tag=name, simple_value=value)
        self._events.write_event(event)
        self._events.flush()

    def close(self) -> None:
        """Close the event file."""
        self._events.close()


def read_metrics(folder: Path) -> dict[str, dict[int, float]]:
    """Read `metrics.jsonl` in `folder`, also while the training is running.

    If a resumed training logged a step again, the later line is used. An incomplete last line is
    ignored. InputError if a line is not an object of a step and numbers.

    Returns:
        {name: {step: value}}, steps in ascending order, NaN for a value that was not finite; empty
        if the file does not exist.
    """
    path = folder / METRICS
    if not path.exists():
        return {}
    *lines, _incomplete = path.read_bytes().split(b"\n")
    scalars: dict[str, dict[int, float]] = {}
    for number, line in enumerate(lines, start=1):
        try:
            values = _LINE.validate_json(line)
            step = values.pop(_STEP)
            if step is None or not 0 <= step <= _LARGEST_STEP or step % 1:
                raise ValueError
        except (ValueError, KeyError):
            raise InputError(
                f"{path}, line {number}, is not a JSON object of numbers with a whole number of 0 "
                f"or more as {_STEP!r}; delete the line, or restore the file"
            ) from None
        for name, value in values.items():
            scalars.setdefault(name, {})[int(step)] = math.nan if value is None else value
    return {name: dict(sorted(curve.items())) for name, curve in scalars.items()}
