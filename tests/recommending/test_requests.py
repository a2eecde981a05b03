"""Requests: times in every usual form, identifiers without loss, faults refused soon."""

import json
import time

import pytest

from ucfrec.errors import InputError
from ucfrec.recommending.requests import Limits, Request, StreamRequest, parse
from ucfrec.recommending.responder import Answer

MANY = b",".join([b"{}"] * 690_000)
ROW = b'{"item_id": 1, "timestamp": 1.7e12, "observation": '


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (b'"history": [%s]' % MANY, "history.0.item_id: field required"),
        (b'"candidates": [%s]' % MANY, "candidates.0: input should be a valid integer"),
        (b'"history": [%s[%s]}]' % (ROW, MANY), "history.0.observation.0: input"),
        (b",".join(b'"%x": 0' % n for n in range(180_000)), "has 180,000 faults; most are entries"),
    ],
)
def test_two_megabytes_of_faults_are_refused_at_once(entry: bytes, message: str) -> None:
    text = b'{"user_id": 1, %s}' % entry
    assert len(text) > 1.9e6
    began = time.process_time()
    with pytest.raises(InputError, match=message):
        parse(StreamRequest, text, Limits())
    assert time.process_time() - began < 0.5


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (1_714_557_600_000, 1_714_557_600_000),
        ("2024-05-01T12:00:00+02:00", 1_714_557_600_000),
        ("2024-05-01 10:00:00", 1_714_557_600_000),
        ("2024-05-01T10:00:00.250", 1_714_557_600_250),
        ("2024-05-01", 1_714_521_600_000),
        ("1997-09-01", 873_072_000_000),
    ],
)
@pytest.mark.parametrize("kind", [Request, StreamRequest])
def test_times_are_numbers_or_iso_text(kind: type[Request], given: object, expected: int) -> None:
    rows = [{"item_id": 1, "timestamp": given, "reward": 1}]
    request = parse(kind, json.dumps({"user_id": 1, "history": rows}).encode(), Limits())
    assert request.history[0]["timestamp"] == expected


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ('"user_id": null', "user_id: .*integer or .*string, not null$"),
        ('"user_id": 1.5', "user_id: .*, not 1.5$"),
        ("", "user_id: field required"),
        ('"user_id": 1, "kk": 3', "kk: extra inputs are not permitted"),
        ('"user_id": 1, "k": 6', r"6 items \(k\): the limit is 5"),
        ('"user_id": 1, "candidates": [1, 2, 3]', "3 candidates: the limit is 2"),
        (
            '"user_id": 1, "history": [{"item_id": 1, "timestamp": 1.7e12, "reward": %s}]'
            % ("9" * 400),
            "history.0.reward",
        ),
        (
            '"user_id": 1, "history": [' + ", ".join(['{"item_id": 1, "timestamp": 7}'] * 4) + "]",
            "4 rows of history: the limit is 3",
        ),
        (f'"user_id": {2**63}', f"user_id: .*, not {2**63}$"),
        ('"user_id": null, "k": 0, "x": 0', "user_id: .*, not null; 2 more faults$"),
        (f'"user_id": "{"x" * 1001}"', "user_id: .*string should have at most 1000 characters"),
        (
            f'"user_id": 1, "history": [{{"item_id": 1, "timestamp": "{"9" * 65}"}}]',
            "history.0.timestamp: ",
        ),
        (
            '"user_id": 1, "history": [{"item_id": 1, "timestamp": "soon"}]',
            'history.0.timestamp: .*an ISO 8601 time such as .*, not "soon"$',
        ),
    ],
)
def test_a_value_that_its_place_does_not_take_is_one_fault(entries: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}") as caught:
        parse(Request, f"{{{entries}}}".encode(), Limits(k=5, history=3, candidates=2))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [b"", b"{", b'{"user_id": "\xff"}', b"[1]"])
def test_what_is_no_json_object_is_no_request(text: bytes) -> None:
    with pytest.raises(InputError, match=r"the request( is not JSON|: input should be an object)"):
        parse(Request, text, Limits())


def test_integers_that_javascript_would_round_are_text() -> None:
    largest = 2**53 - 1
    given = [largest, largest + 1, -largest - 1, "7"]
    answer = Answer(given, [0.0] * 4, [1.0] * 4, "r", "run", "rule").as_dict(2**60)
    ids = [each["item_id"] for each in answer["items"]]
    assert ids == [largest, str(largest + 1), str(-largest - 1), "7"]
    assert answer["user_id"] == str(2**60)
