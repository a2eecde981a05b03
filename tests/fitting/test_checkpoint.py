"""`metrics.jsonl`: written lines are read back, incomplete ones ignored, invalid ones reported."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tensorboardX.proto.event_pb2 import Event

from tests.support.records import JSON
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import METRICS, MetricsLog, read_metrics


def logged(folder: Path, start: int, rows: dict[int, dict[str, float]]) -> None:
    log = MetricsLog(folder, start)
    for step, scalars in rows.items():
        log.add(step, scalars)
    log.close()


def test_what_is_logged_is_read_and_each_line_is_json(tmp_path: Path) -> None:
    assert read_metrics(tmp_path) == {}
    logged(tmp_path, 0, {5: {"loss": 1.5, "entropy": math.inf}, 10: {"loss": 0.1 + 0.2}})
    found = read_metrics(tmp_path)
    assert found["loss"] == {5: 1.5, 10: 0.1 + 0.2}
    assert math.isnan(found["entropy"][5])
    lines = (tmp_path / METRICS).read_text().splitlines()
    rows = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    assert rows == [{"step": 5, "loss": 1.5, "entropy": None}, {"step": 10, "loss": 0.1 + 0.2}]


def test_steps_that_a_resumed_training_logs_again_override(tmp_path: Path) -> None:
    logged(tmp_path, 0, {5: {"loss": 3.0}, 10: {"loss": 2.0}, 15: {"loss": 9.0}})
    logged(tmp_path, 10, {15: {"loss": 1.0}, 20: {"loss": 0.5}})
    found = read_metrics(tmp_path)["loss"]
    assert [*found.items()] == [(5, 3.0), (10, 2.0), (15, 1.0), (20, 0.5)]


def test_a_torn_last_line_is_left_out_and_never_joined_to_the_next(tmp_path: Path) -> None:
    logged(tmp_path, 0, {5: {"loss": 3.0}, 10: {"loss": 2.0}})
    whole = (tmp_path / METRICS).read_bytes()
    for cut in range(1, len(whole.splitlines()[-1]) + 1):
        (tmp_path / METRICS).write_bytes(whole[:-cut])
        assert read_metrics(tmp_path) == {"loss": {5: 3.0}}, cut
    logged(tmp_path, 5, {10: {"loss": 2.5}})
    assert read_metrics(tmp_path) == {"loss": {5: 3.0, 10: 2.5}}


@pytest.mark.parametrize(
    "line",
    [
        *("", "[" * 100_000, '{"step": 1, "loss": ' + "1" * 5000 + "}", "[1]", '{"loss": 1}'),
        *('{"step": true}', '{"step": 1.5}', '{"step": null}', '{"step": 1' + "0" * 30 + "}"),
        '{"step": 1, "loss": "low"}',
    ],
)
def test_other_lines_are_named_in_one_line(tmp_path: Path, line: str) -> None:
    (tmp_path / METRICS).write_text(f'{{"step": 1, "loss": 2}}\n{line}\n{{"step": 2}}\n')
    with pytest.raises(InputError, match="is not a JSON object of numbers with a whole") as caught:
        read_metrics(tmp_path)
    assert f"{tmp_path / METRICS}, line 2," in str(caught.value)
    assert "\n" not in str(caught.value)


ROWS = st.dictionaries(st.sampled_from(["step", "loss", "kl"]), JSON)
LINES = st.binary(max_size=30) | (JSON | ROWS).map(lambda value: json.dumps(value).encode())


@given(st.lists(LINES, max_size=4))
def test_whatever_lies_there_is_read_as_numbers_or_refused(
    tmp_path_factory: pytest.TempPathFactory, lines: list[bytes]
) -> None:
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / METRICS).write_bytes(b"\n".join(lines))
    try:
        found: Any = read_metrics(folder)
    except InputError:
        return
    for name, curve in found.items():
        assert isinstance(name, str)
        assert all(type(step) is int and type(value) is float for step, value in curve.items())
        assert list(curve) == sorted(curve)


def events(path: Path) -> dict[int, dict[str, float]]:
    """What an event file holds, read from the documentation of TFRecord."""
    content, at, found = path.read_bytes(), 0, {}
    while at < len(content):
        (size,) = struct.unpack_from("<Q", content, at)
        event = Event.FromString(content[at + 12 : at + 12 + size])
        at += 12 + size + 4
        if event.summary.value:
            found[event.step] = {v.tag: v.simple_value for v in event.summary.value}
    return found


def test_tensorboard_gets_the_same(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, 0)
    log.add(5, {"loss": 1.5})
    (file,) = tmp_path.glob("events.out.tfevents.*")
    assert events(file) == {5: {"loss": 1.5}}  # on disk while the training runs
    assert read_metrics(tmp_path) == {"loss": {5: 1.5}}
    log.close()
    logged(tmp_path, 5, {10: {"loss": 0.25}})
    (resumed,) = set(tmp_path.glob("events.out.tfevents.*")) - {file}
    assert events(resumed) == {10: {"loss": 0.25}}
