"""A stream of requests: an answer on each line, whatever the line is."""

import io
import json
import os
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.support.served import as_frame, histories, requests_of, responder, with_rule
from ucfrec.commands.cli import main
from ucfrec.recommending.requests import Limits
from ucfrec.recommending.stream import answer_stream
from ucfrec.runs.trained_policy import TrainedPolicy


class Blocks:
    """Gives its blocks one after the other, as a pipe does."""

    def __init__(self, *blocks: bytes) -> None:
        self._blocks = iter(blocks)

    def read(self, size: int, /) -> bytes:
        return next(self._blocks, b"")


def streamed(trained: TrainedPolicy, *blocks: bytes, **named: Any) -> list[dict[str, Any]]:
    sink, remember = io.BytesIO(), named.pop("remember", 10**6)
    # Of the best items: requests have different ids, and so different draws.
    named = {"rule": with_rule(trained, temperature=0.0)} | named
    answer_stream(responder(trained, **named), Blocks(*blocks), sink, remember)
    return [json.loads(line) for line in sink.getvalue().splitlines()]


def shown(answers: list[dict[str, Any]]) -> pd.DataFrame:
    return as_frame(answers).drop(columns="request_id")


def lines(requests: list[dict[str, Any]]) -> bytes:
    return b"".join(json.dumps(request).encode() + b"\n" for request in requests)


def test_a_pipe_equals_the_command_on_files(trained: TrainedPolicy, tmp_path: Path) -> None:
    log = histories()
    log.to_parquet(tmp_path / "log.parquet")
    arguments = ["recommend", str(trained.folder), "--k", "7", "--reward-weight", "0.3"]
    assert main([*arguments, str(tmp_path / "log.parquet"), "--out", str(tmp_path / "out")]) == 0
    requests = requests_of(log)
    command = [sys.executable, "-m", "ucfrec.commands.cli", *arguments, "--stream"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        # The first answer comes while the pipe is open.
        process.stdin.write(lines(requests[:1]))
        process.stdin.flush()
        assert select.select([process.stdout], [], [], 120)[0]
        first = process.stdout.readline()
        rest, errors = process.communicate(b"{nonsense\n" + lines(requests[1:]), timeout=120)
    assert process.returncode == 0
    answers = [json.loads(line) for line in (first + rest).splitlines()]
    assert answers.pop(1)["line"] == 2
    expected = pd.read_parquet(tmp_path / "out")
    pd.testing.assert_frame_equal(
        as_frame(answers), expected, check_dtype=False, rtol=1e-5, atol=1e-6
    )
    assert b"12 answers, 1 errors" in errors


def test_a_bad_line_has_one_error_and_the_stream_goes_on(trained: TrainedPolicy) -> None:
    deep, good = b'{"user_id": ' + b"[" * 100_000 + b"}", b'{"user_id": 1}'
    bad = [b"", b"{", b'{"user_id": "\xff"}', deep, b"\t\r"]
    answers = streamed(trained, b"\n".join(each for line in bad for each in (line, good)) + b"\n")
    for number, (wrong, right) in enumerate(zip(answers[::2], answers[1::2], strict=True)):
        assert "the request is not JSON" in wrong["error"]
        assert "\n" not in wrong["error"]
        assert wrong["line"] == 2 * number + 1
        assert len(right["items"]) == 10


@pytest.mark.parametrize("size", [1, 7, 10**6])
def test_lines_are_bounded_however_they_arrive(trained: TrainedPolicy, size: int) -> None:
    good, long = lines([{"user_id": 1, "k": 1}]), b'{"user_id": "' + b"x" * 2000 + b'"}\n'
    text = good + long + good + long.rstrip()
    blocks = [text[start : start + size] for start in range(0, len(text), size)]
    found = streamed(trained, *blocks, limits=Limits(bytes=1000))
    assert [each.get("line") for each in found] == [None, 2, None, 4]
    assert "more than 1,000 bytes" in found[1]["error"]


def test_interactions_are_added_to_what_the_stream_has_had(trained: TrainedPolicy) -> None:
    whole = requests_of(histories(users=2))
    one, two = whole
    rows = one["history"]
    parts = [
        {"user_id": one["user_id"], "interactions": rows[:3]},
        {"user_id": one["user_id"], "interactions": [{"item_id": 777, "timestamp": 1.7e12}]},
        {"user_id": two["user_id"], "interactions": two["history"]},
        {"user_id": one["user_id"], "interactions": rows[3:]},
        {"user_id": two["user_id"]},
    ]
    parts = [part | {"new_session": False} for part in parts]
    found = streamed(trained, lines(parts))
    assert "error" in found[1]
    expected = streamed(trained, lines([two, one, two]))
    pd.testing.assert_frame_equal(shown(found[2:]), shown(expected), rtol=1e-5)
    # Users beyond the limit are forgotten, the longest unheard of first.
    forgot = streamed(trained, lines(parts), remember=len(two["history"]))
    alone = streamed(trained, lines([one | {"history": rows[3:]}]))
    pd.testing.assert_frame_equal(shown(forgot[3:4]), shown(alone), rtol=1e-5)


def test_a_history_replaces_what_the_stream_has_had(trained: TrainedPolicy) -> None:
    whole, _ = requests_of(histories(users=2))
    rows, user = whole["history"], whole["user_id"]
    parts = [
        {"user_id": user, "interactions": rows},
        {"user_id": user, "history": rows[:3]},
        {"user_id": user, "interactions": rows[3:5]},
        {"user_id": user, "history": []},
        {"user_id": user},
    ]
    found = streamed(trained, lines(parts))
    told = (rows, rows[:3], rows[:5], [], [])
    expected = streamed(trained, lines([{"user_id": user, "history": each} for each in told]))
    pd.testing.assert_frame_equal(shown(found), shown(expected), rtol=1e-5)


def test_a_reader_that_goes_away_ends_the_command_quietly(trained: TrainedPolicy) -> None:
    command = [sys.executable, "-m", "ucfrec.commands.cli", "recommend", str(trained.folder)]
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [*command, "--stream"],
        input=lines([{"user_id": 1}] * 9),
        stdout=write,
        stderr=subprocess.PIPE,
        timeout=120,
    )
    os.close(write)
    assert (ended.returncode, ended.stderr) == (0, b"")
