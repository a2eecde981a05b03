"""A wrong request is refused soon, however many faults it has."""

import time

import pytest

from ucfrec.errors import InputError
from ucfrec.recommending.requests import Limits, StreamRequest, parsed

MANY = b",".join([b"{}"] * 690_000)
ROW = b'{"item_id": 1, "timestamp": 1.7e12, "observation": '


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (b'"history": [%s]' % MANY, "history.0.item_id: field required"),
        (b'"interactions": [%s]' % MANY, "interactions.0.item_id: field required"),
        (b'"candidates": [%s]' % MANY, "candidates.0: input should be a valid integer"),
        (b'"history": [%s[%s]}]' % (ROW, MANY), "history.0.observation.0: input should be a valid"),
        (b",".join(b'"%x": 0' % n for n in range(180_000)), "has 180,000 faults; most are entries"),
    ],
)
def test_two_megabytes_of_faults_are_refused_at_once(entry: bytes, message: str) -> None:
    text = b'{"user_id": 1, %s}' % entry
    assert len(text) > 1.9e6
    began = time.process_time()
    with pytest.raises(InputError, match=message):
        parsed(StreamRequest, text, Limits())
    assert time.process_time() - began < 0.5
