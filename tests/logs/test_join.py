"""Exposures joined with feedback: every row of feedback counts once, for what it is about."""

import time
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest

from tests.support.killed_loop import kills
from tests.support.logs import START
from ucfrec.commands.cli import main
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.join import Joined, join_feedback
from ucfrec.logs.mapping import LogMapping

MINUTE = 60_000


def exposures(folder: Path) -> Path:
    """Three requests of two users, one of which is written twice."""
    rows = [
        ("1", 10, 0, "a", 1, 0.5),
        ("1", 11, 0, "a", 2, 0.25),
        ("1", 10, 5, "b", 1, 0.4),
        ("2", 10, 5, "c", 1, 0.1),
        ("2", 10, 6, "c", 1, 0.1),
    ]
    names = ["user_id", "item_id", "timestamp", "request_id", "position", "propensity"]
    frame = pd.DataFrame(rows, columns=names).assign(run="r", rule="d")
    frame["timestamp"] = START + MINUTE * frame.timestamp
    folder.mkdir()
    frame[:3].to_parquet(folder / "one.parquet")
    frame[3:].to_parquet(folder / "two.parquet")
    return folder


def feedback(rows: list[tuple[object, ...]], *more: str, **names: str) -> pd.DataFrame:
    """Rows of user, item, minute, click and more; `names` are other names of these."""
    frame = pd.DataFrame(rows, columns=["user_id", "item_id", "timestamp", "click", *more])
    return frame.assign(timestamp=START + MINUTE * frame.timestamp).rename(columns=names)


def csv(column: str, *values: str, time: str = str(START + 7 * MINUTE)) -> str:
    """Feedback of user 1 on item 10, at a time that matches."""
    rows = [f"1,10,{time},{value}" for value in values]
    return "\n".join([f"user_id,item_id,timestamp,{column}", *rows, ""])


def joined(
    folder: Path, *given: str | pd.DataFrame, shown: Path | None = None, minutes: int = 30
) -> tuple[Joined, pd.DataFrame]:
    """Exposures joined with files of feedback: text as CSV, frames as Parquet."""
    files = []
    for n, content in enumerate(given):
        files.append(folder / f"{n}.{'csv' if isinstance(content, str) else 'parquet'}")
        if isinstance(content, str):
            files[-1].write_text(content)
        else:
            content.to_parquet(files[-1])
    log, shown = folder / "log.parquet", shown or exposures(folder / "shown")
    return join_feedback([shown], files, log, minutes * MINUTE), pd.read_parquet(log)


def test_feedback_belongs_to_the_latest_exposure_within_the_window(tmp_path: Path) -> None:
    rows: list[tuple[object, ...]] = [
        (1, 10, 7, 1),  # of the second request, not of the first
        (1, 10, 8, 0),  # of the same: one row of the log all the same
        (1, 11, 31, 1),  # too late
        (2, 10, 4, 1),  # before it was shown
        (3, 10, 7, 1),  # to whom nothing was shown
    ]
    report, log = joined(tmp_path, feedback(rows))
    assert (report.exposures, report.repeated, report.with_feedback) == (4, 1, 1)
    assert (report.matched, report.unmatched) == (2, 3)
    assert log.user_id.tolist() == [1, 1, 1, 2]
    assert log.request_id.tolist() == ["a", "a", "b", "c"]
    assert log.position.tolist() == [1, 2, 1, 1]
    assert log.propensity.tolist() == [0.5, 0.25, 0.4, 0.1]
    assert log.click.tolist() == [0, 0, 1, 0]
    assert log.feedback.tolist() == [0, 0, 2, 0]


EARLY = str(START + 5 * MINUTE - 50_000)
SHOWN = {"position": [1, 2, 1, 1], "propensity": [0.5, 0.25, 0.4, 0.1]}
COLUMNS: dict[str, tuple[tuple[str | pd.DataFrame, ...], tuple[str, ...], dict[str, Any]]] = {
    "a request id decides": (
        (csv("request_id,click", "a,1", ",1", "z,1"), csv("request_id,click", "b,1", time=EARLY)),
        ("click",),
        {"feedback": [1, 0, 2, 0]},
    ),
    "some columns of exposures": (
        (feedback([(1, 10, 7, 1, 9, 0.9)], "position", "propensity"),),
        ("click",),
        {"feedback": [0, 0, 1, 0], **SHOWN},
    ),
    "text of numbers, or nothing": (
        (
            csv("click", "true"),
            feedback([(1, 11, 7, "5"), (1, 11, 7, None)]),
            feedback([(2, 10, 7, pd.NaT)]),
            csv("click", ""),
        ),
        ("click",),
        {"click": [0, 5, 1, 0], "feedback": [0, 2, 2, 1]},
    ),
    "names in any case": (
        (csv("Click", "1"), feedback([(2, 10, 7, True, 4)], "like", click="cliCK")),
        ("Click", "like"),
        {"Click": [0, 0, 1, 1], "like": [0, 0, 0, 4]},
    ),
    **{
        f"a column called {name}": (
            (feedback([(1, 10, 7, 3, 4)], "more", click=name),),
            (name, "more"),
            {name: [0, 0, 3, 0], "more": [0, 0, 4, 0]},
        )
        for name in ("Reward", "row", 'a "b"')
    },
    "an index": (
        (feedback([(1, 10, 9, 0), (1, 10, 7, 3), (1, 10, 8, 1)]).set_index(pd.Index([7, 5, 9])),),
        ("click",),
        {"click": [0, 0, 3, 0]},
    ),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_what_counts_as_feedback(tmp_path: Path, name: str) -> None:
    given, columns, values = COLUMNS[name]
    report, log = joined(tmp_path, *given)
    assert report.columns == columns
    for column, expected in values.items():
        assert log[column].tolist() == expected
    assert "__index_level_0__" not in log


NOTES: dict[str, tuple[str | pd.DataFrame, str]] = {
    "a word": (csv("Amount,click", "5,1", "n/a,1"), "Amount .text, 1 of 2 are not numbers .*'n/a'"),
    "of exposures": (csv("position,click", "9,1"), r"position \(of the exposures, too\)"),
    "its own": (
        feedback([(1, 10, 7, 3)], click="Feedback"),
        r"0\.parquet: .*Feedback \(the log has its own.*rename it",
    ),
    "other requests": (
        feedback([(1, 10, 7, 1, "y"), (1, 10, 7, 1, "z")], "request_id"),
        r"none of its 2 values of request_id \(such as 'y'\)",
    ),
    "other users": (feedback([(3, 10, 7, 1)]), "none of its users was shown any of their items"),
}


@pytest.mark.parametrize("name", NOTES)
def test_what_is_left_out_is_told_in_one_note(tmp_path: Path, name: str) -> None:
    with pytest.warns(InputNote, match=NOTES[name][1]) as notes:
        _, log = joined(tmp_path, NOTES[name][0])
    assert len(notes) == 1
    assert log.position.tolist() == SHOWN["position"]
    rows = {"other requests": 0, "other users": 0, "a word": 2}
    assert log.feedback.sum() == rows.get(name, 1)


def test_the_command_writes_a_log_that_prepare_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clicks, out = tmp_path / "clicks.csv", str(tmp_path / "log.parquet")
    feedback([(1, 10, 7, True)], user_id="visitor").to_csv(clicks, index=False)
    shown = str(exposures(tmp_path / "shown"))
    join = ["join", shown, str(clicks), "--out", out, "--column", "user_id=visitor"]
    assert main([*join, "--within", "soon"]) == 2
    assert "--within soon is not a duration" in capsys.readouterr().err
    assert main([*join, "--within", "30m"]) == 0
    assert "1 of them with feedback (25.0%)" in capsys.readouterr().out
    assert main(["prepare", out, "--reward", "click", "--validate"]) == 0
    assert "mean 0.25" in capsys.readouterr().out


def test_exposures_are_not_feedback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = exposures(tmp_path / "shown")
    (tmp_path / "clicks.csv").write_text(csv("click", "1"))
    expanded = [str(path) for path in sorted(shown.glob("*.parquet"))]
    out = ["--within", "30m", "--out", str(tmp_path / "log.parquet")]
    assert main(["join", *expanded, str(tmp_path / "clicks.csv"), *out]) == 2
    assert f"{shown / 'two.parquet'} is not feedback" in capsys.readouterr().err
    assert main(["join", str(shown / "*.parquet"), str(tmp_path / "clicks.csv"), *out]) == 0
    log = str(tmp_path / "log.parquet")
    assert main(["join", str(shown), log, *out[:-1], str(tmp_path / "again.parquet")]) == 2
    assert "log.parquet is not feedback" in capsys.readouterr().err


def test_columns_are_known_in_any_case_and_those_of_feedback_are_numbers(tmp_path: Path) -> None:
    frame = pd.read_parquet(exposures(tmp_path / "of")).rename(columns=str.upper)
    with pytest.raises(InputError, match=r"0\.parquet is not feedback"):
        joined(tmp_path, frame.drop(columns="REQUEST_ID"))
    clicks = tmp_path / "clicks.parquet"
    feedback([(1, 10, 7, 1)]).to_parquet(clicks)
    with pytest.raises(InputError, match=r"has no column request_id, position, .* exposures"):
        join_feedback([clicks], [clicks], tmp_path / "out.parquet", MINUTE)
    wanted = r"1\.csv: column CLICK has numbers in .*0\.csv, but here 1 of 2 are not numbers"
    with pytest.raises(InputError, match=wanted):
        joined(tmp_path, csv("click", "1"), csv("CLICK", "1", "n/a"), shown=tmp_path / "of")


def test_a_log_of_a_join_is_joined_with_more_feedback(tmp_path: Path) -> None:
    clicks = feedback([(1, 10, 7, 1, 3), (1, 10, 8, 1, 1), (2, 10, 6, 1, 4)], "seconds")
    _, first = joined(tmp_path, clicks.rename(columns={"click": "row"}))
    first = first.assign(page="home", Free=[True, False, True, False])
    first.to_parquet(tmp_path / "first.parquet")
    bought = feedback([(1, 10, 7, 1, 2), (1, 11, 7, 1, 9)], "Seconds", click="bought")
    report, both = joined(tmp_path, bought, shown=tmp_path / "first.parquet")
    assert (report.matched, report.with_feedback) == (2, 2)
    expected = {"feedback": [0, 1, 3, 1], "Seconds": [0, 9, 3, 4], "bought": [0, 1, 1, 0]}
    expected |= {name: first[name].tolist() for name in ("row", "page", "Free")}
    assert {name: both[name].tolist() for name in expected} == expected
    disliked = feedback([(2, 10, 7, -1), (1, 10, 7, -1)], click="bought")
    _, third = joined(
        tmp_path, disliked, shown=(tmp_path / "log.parquet").rename(tmp_path / "second.parquet")
    )
    assert third.bought.tolist() == [0, 1, 1, -1]  # 0 is no feedback, in any order of joins


@pytest.mark.parametrize(
    ("error", "disk"), [("No space left", "{}"), ("IO Error: No space left", gettempdir())]
)
def test_a_full_disk_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: str, disk: str
) -> None:
    monkeypatch.setattr("ucfrec.logs.join.table_writer", Mock(side_effect=OSError(error)))
    with pytest.raises(InputError, match=f"no space left on the disk of {disk.format(tmp_path)};"):
        joined(tmp_path, feedback([(1, 10, 7, 1)]))


def test_one_user_who_saw_one_item_very_often_takes_no_longer(tmp_path: Path) -> None:
    rows = 40_000
    shown = pd.DataFrame({"user_id": "guest", "item_id": 7, "timestamp": START + np.arange(rows)})
    shown = shown.assign(request_id=shown.index.astype(str), position=1, propensity=0.5)
    shown.assign(run="r", rule="d").to_parquet(tmp_path / "shown.parquet")
    clicks = shown[["user_id", "item_id", "timestamp"]].assign(click=1)
    begin = time.perf_counter()
    report, log = joined(tmp_path, clicks, shown=tmp_path / "shown.parquet")
    assert time.perf_counter() - begin < 20  # 800 million pairs would take minutes
    assert (report.matched, log.feedback.tolist()) == (rows, [1] * rows)


@pytest.mark.parametrize(
    ("time", "told"),
    [
        (f"{START // 1000}", "feedback from 1970-01-20 16:13:20 to 1970-01-20 16:13:20"),
        (f"{START}000000", f"feedback from {START}000000 to"),
        ("2023-11-14", "dates have no time of day and count as midnight"),
    ],
)
def test_feedback_at_other_times_is_told(tmp_path: Path, time: str, told: str) -> None:
    with pytest.warns(InputNote, match=r"2 of 2 rows of .* \(100%\) match no exposure") as notes:
        joined(tmp_path, csv("click", "1", "1", time=time))
    note = str(notes[0].message)
    assert "exposures are from 2023-11-14 22:13:20 to 2023-11-14 22:18:20" in note
    assert told in note


@pytest.mark.slow
def test_a_join_killed_at_any_moment_ends_as_if_left_alone(tmp_path: Path) -> None:
    rows = np.arange(200_000)
    frame = pd.DataFrame({"user_id": (rows % 977).astype(str), "item_id": rows % 83})
    frame = frame.assign(timestamp=START + rows, request_id=rows.astype(str))
    (tmp_path / "shown").mkdir()
    clicked = frame[::7].assign(click=1)
    clicked.to_parquet(tmp_path / "feedback.parquet")
    frame = frame.assign(position=1, propensity=0.5, run="r", rule="d")
    frame.to_parquet(tmp_path / "shown" / "a.parquet")
    assert kills("join", tmp_path) >= 2
    log = pd.read_parquet(tmp_path / "joined.parquet")
    assert (len(log), *log[["click", "feedback"]].sum()) == (len(rows), *2 * [len(clicked)])
    assert {file.stem for file in tmp_path.glob("*.parquet")} == {"feedback", "joined"}


def test_the_options_of_a_log_hold_for_the_feedback(tmp_path: Path) -> None:
    given = feedback([(1, 10, 7, 1, "app"), (1, 11, 2, 1, "bot"), (2, 10, 6, 1, "bot")], "source")
    for day, rows in {"01": given[:2], "02": given[2:]}.items():
        (tmp_path / f"day={day}").mkdir()
        rows.to_parquet(tmp_path / f"day={day}" / "rows.parquet")
    shown, files = exposures(tmp_path / "shown"), [str(tmp_path / "day=*")]
    for mapping, clicks in (
        (LogMapping(), [0, 1, 1, 1]),
        (LogMapping(where="source = 'app' AND click = 1"), [0, 0, 1, 0]),
        (LogMapping(where="day = '02'", partitions=True), [0, 0, 0, 1]),
        (LogMapping(earliest="2023-11-14T22:20:20"), [0, 0, 1, 0]),
    ):
        join_feedback([shown], files, tmp_path / "log.parquet", 30 * MINUTE, mapping)
        log = pd.read_parquet(tmp_path / "log.parquet")
        assert log.sort_values(["timestamp", "user_id", "position"]).click.tolist() == clicks


def test_exposures_in_csv_files_are_the_text_of_the_file(tmp_path: Path) -> None:
    """Of an empty arm in Parquet and no arm in CSV, there is one; 1e1 and 10 are two items."""
    ids = {"item_id": ["1e1", "10"], "request_id": ["5e1", "50"], "run": ["1e3", "1000"]}
    shown = pd.DataFrame(ids).assign(user_id="7", timestamp=START, position=1, propensity=0.5)
    shown = shown.assign(rule="d", arm="")
    (tmp_path / "shown").mkdir()
    shown.to_csv(tmp_path / "shown" / "one.csv", index=False)
    shown[:1].to_parquet(tmp_path / "shown" / "two.parquet")
    clicks = feedback([("7", "1e1", 0, 1)]).assign(Request_ID="5e1").to_csv(index=False)
    report, log = joined(tmp_path, clicks, shown=tmp_path / "shown", minutes=1)
    assert (report.exposures, report.repeated, report.matched) == (2, 1, 1)
    log = log.set_index("item_id")
    assert log.click.to_dict() == {"1e1": 1, "10": 0}
    assert log.loc["1e1", ["request_id", "run"]].tolist() == ["5e1", "1e3"]


@pytest.mark.parametrize("name", ["run", "arm", "day"])
def test_a_list_of_another_run_or_arm_or_day_is_no_repetition(tmp_path: Path, name: str) -> None:
    """`recommend LOGS` gives a user without new rows the same request id, and items, again."""
    folder = exposures(tmp_path / "shown")
    again = pd.read_parquet(folder / "one.parquet").assign(**{name: "other"})
    again.assign(timestamp=again.timestamp + 60 * MINUTE).to_parquet(folder / "three.parquet")
    report, log = joined(tmp_path, feedback([(1, 10, 67, 1)]), shown=folder)
    assert (report.exposures, report.repeated, report.matched) == (7, 1, 1)
    assert log.click.to_numpy().nonzero()[0].tolist() == [6]


@pytest.mark.parametrize("written", ["feedback.parquet", "shown/one.parquet"])
def test_what_is_read_is_not_written_over(tmp_path: Path, written: str) -> None:
    feedback([(1, 10, 7, 1)]).to_parquet(tmp_path / "feedback.parquet")
    shown, out = exposures(tmp_path / "shown"), tmp_path / written
    before = out.read_bytes()
    with pytest.raises(InputError, match="would be written over what is read; name another file"):
        join_feedback([shown], [tmp_path / "feedback.parquet"], out, 30 * MINUTE)
    assert out.read_bytes() == before
