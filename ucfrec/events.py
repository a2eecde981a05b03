"""Scalars that a training loop logged, read back from its TensorBoard events."""

import struct
from collections import defaultdict
from pathlib import Path

from tensorboardX.proto.event_pb2 import Event

_HEAD, _TAIL = 12, 4
"""Bytes around a record: its size with a checksum before it, a checksum behind it."""


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
