"""Exposures joined with feedback: every row of feedback counts once, for what it is about."""

import warnings
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.support.killed import kills
from ucfrec.commands.cli import main
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.join import Joined, join_feedback
from ucfrec.logs.mapping import LogMapping

START = 1_700_000_000_000
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


def feedback(rows: list[tuple[object, ...]], *more: str) -> pd.DataFrame:
    frame = pd.DataFrame(rows, columns=["user_id", "item_id", "timestamp", "click", *more])
    return frame.assign(timestamp=START + MINUTE * frame.timestamp)


def joined(folder: Path, given: pd.DataFrame, within: int = 30) -> tuple[object, pd.DataFrame]:
    given.to_parquet(folder / "feedback.parquet")
    report = join_feedback(
        [exposures(folder / "shown")],
        [folder / "feedback.parquet"],
        folder / "log.parquet",
        within * MINUTE,
    )
    return report, pd.read_parquet(folder / "log.parquet")


def test_feedback_belongs_to_the_latest_exposure_within_the_window(tmp_path: Path) -> None:
    given = feedback(
        [
            (1, 10, 7, 1),  # of the second request, not of the first
            (1, 10, 8, 0),  # of the same: one row of the log all the same
            (1, 11, 31, 1),  # too late
            (2, 10, 4, 1),  # before it was shown
            (3, 10, 7, 1),  # to whom nothing was shown
        ]
    )
    report, log = joined(tmp_path, given)
    assert (report.exposures, report.repeated, report.with_feedback) == (4, 1, 1)
    assert (report.matched, report.unmatched) == (2, 3)
    assert "2 rows of feedback matched, 3 without an exposure" in str(report)
    assert log.user_id.tolist() == [1, 1, 1, 2]
    assert log.request_id.tolist() == ["a", "a", "b", "c"]
    assert log.position.tolist() == [1, 2, 1, 1]
    assert log.propensity.tolist() == [0.5, 0.25, 0.4, 0.1]
    assert log.click.tolist() == [0, 0, 1, 0]
    assert log.feedback.tolist() == [0, 0, 2, 0]


def test_a_request_id_in_the_feedback_decides(tmp_path: Path) -> None:
    given = feedback([(1, 10, 7, 1, "a"), (1, 10, 7, 1, None), (2, 10, 7, 1, "z")], "request_id")
    report, log = joined(tmp_path, given)
    assert log.feedback.tolist() == [1, 0, 1, 0]
    assert report.unmatched == 1


def test_the_command_writes_a_log_that_prepare_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = feedback([(1, 10, 7, True)]).rename(columns={"user_id": "visitor"})
    given.to_csv(tmp_path / "clicks.csv", index=False)
    out = str(tmp_path / "log.parquet")
    arguments = [str(exposures(tmp_path / "shown")), str(tmp_path / "clicks.csv"), "--out", out]
    join = ["join", *arguments, "--column", "user_id=visitor"]
    assert main([*join, "--within", "soon"]) == 2
    assert "--within soon is not a duration" in capsys.readouterr().err
    assert main([*join, "--within", "30m"]) == 0
    assert "1 of them with feedback (25.0%)" in capsys.readouterr().out
    assert main(["prepare", out, "--reward", "click", "--validate"]) == 0
    assert "mean 0.25" in capsys.readouterr().out


def test_a_log_is_not_taken_for_exposures(tmp_path: Path) -> None:
    feedback([(1, 10, 7, 1)]).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match=r"has no column request_id, position, .* exposures"):
        join_feedback(
            [tmp_path / "log.parquet"],
            [tmp_path / "log.parquet"],
            tmp_path / "out.parquet",
            MINUTE,
            LogMapping(),
        )
    assert not (tmp_path / "out.parquet").exists()


def joined_files(folder: Path, *feedback: str | pd.DataFrame) -> tuple[Joined, pd.DataFrame]:
    """Exposures joined with files of feedback: text as CSV, frames as Parquet."""
    files = []
    for n, given in enumerate(feedback):
        files.append(folder / f"{n}.{'csv' if isinstance(given, str) else 'parquet'}")
        if isinstance(given, str):
            files[-1].write_text(given)
        else:
            given.to_parquet(files[-1])
    log = folder / "log.parquet"
    report = join_feedback([exposures(folder / "shown")], files, log, 30 * MINUTE)
    return report, pd.read_parquet(log)


def csv(column: str, *values: str) -> str:
    """Feedback of user 1 on item 10, at a time that matches."""
    rows = [f"1,10,{START + 7 * MINUTE},{value}" for value in values]
    return "\n".join([f"user_id,item_id,timestamp,{column}", *rows, ""])


def test_exposures_are_not_taken_for_feedback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = exposures(tmp_path / "shown")
    (tmp_path / "clicks.csv").write_text(csv("click", "1"))
    expanded = [str(path) for path in sorted(shown.glob("*.parquet"))]
    out = ["--within", "30m", "--out", str(tmp_path / "log.parquet")]
    assert main(["join", *expanded, str(tmp_path / "clicks.csv"), *out]) == 2
    message = capsys.readouterr().err
    assert f"{shown / 'two.parquet'} is not feedback" in message
    assert "by their folder or as a pattern in quotes" in message
    assert not (tmp_path / "log.parquet").exists()
    quoted = str(shown / "*.parquet")
    assert main(["join", quoted, str(tmp_path / "clicks.csv"), *out]) == 0
    again = ["--within", "30m", "--out", str(tmp_path / "again.parquet")]
    assert main(["join", str(shown), str(tmp_path / "log.parquet"), *again]) == 2
    assert "log.parquet is not feedback" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["request_id", "timestamp"])
def test_exposures_are_known_by_their_columns_in_any_case(tmp_path: Path, part: str) -> None:
    frame = pd.read_parquet(exposures(tmp_path / "of"))
    frame = frame.rename(columns=str.upper)
    if part == "request_id":
        frame = frame.drop(columns=part.upper())
    with pytest.raises(InputError, match=r"0\.parquet is not feedback"):
        joined_files(tmp_path, frame)


def test_feedback_may_have_some_columns_of_exposures(tmp_path: Path) -> None:
    given = feedback([(1, 10, 7, 1, 9, 0.9)], "position", "propensity")
    report, log = joined_files(tmp_path, given)
    assert report.matched == 1
    assert log.position.tolist() == [1, 2, 1, 1]
    assert log.propensity.tolist() == [0.5, 0.25, 0.4, 0.1]


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (["5", "n/a", "2.5"], "1 of 3 are not numbers (such as 'n/a')"),
        (['"12,50"', '"3,00"'], "2 of 2 are not numbers (such as '12,50')"),
        (["DE", "DE"], "2 of 2 are not numbers (such as 'DE')"),
    ],
)
def test_columns_that_are_no_numbers_are_left_out_with_one_note(
    tmp_path: Path, values: list[str], told: str
) -> None:
    rows = csv("Amount,position,click", *(f"{value},9,1" for value in values))
    with pytest.warns(InputNote) as notes:
        report, log = joined_files(tmp_path, rows)
    (note,) = (str(warning.message) for warning in notes)
    left_out = f"Amount (text, {told}), position (of the exposures, too)"
    assert all(part in note for part in left_out.split("), "))
    assert report.columns == ("click",)
    assert log.feedback.tolist() == [0, 0, len(values), 0]
    assert log.position.tolist() == [1, 2, 1, 1]


def test_numbers_in_a_parquet_column_of_text_are_not_left_out_without_a_word(
    tmp_path: Path,
) -> None:
    rows = feedback([(1, 10, 7, "1"), (1, 10, 7, None)])
    with pytest.warns(InputNote, match="click .text, though all are numbers.*write numbers as"):
        joined_files(tmp_path, rows)


def test_a_column_of_text_without_a_value_is_left_out_without_a_note(tmp_path: Path) -> None:
    parquet = feedback([(1, 10, 7, 1)]).assign(word=pd.array([None], dtype="string"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        report, _ = joined_files(tmp_path, csv("word,click", ",1", ",1"), parquet)
    assert report.columns == ("click",)


def test_a_log_of_a_join_is_joined_with_more_feedback(tmp_path: Path) -> None:
    clicks = feedback([(1, 10, 7, 1, 3), (1, 10, 8, 1, 1), (2, 10, 6, 1, 4)], "seconds")
    _, first = joined(tmp_path, clicks.rename(columns={"click": "row"}))
    first = first.assign(page="home", Free=[True, False, True, False])
    first.to_parquet(tmp_path / "first.parquet")
    bought = feedback([(1, 10, 7, 1, 2), (1, 11, 7, 1, 9)], "Seconds")
    bought.rename(columns={"click": "bought"}).to_parquet(tmp_path / "bought.parquet")
    files = [tmp_path / "first.parquet"], [tmp_path / "bought.parquet"]
    report = join_feedback(*files, tmp_path / "both.parquet", 30 * MINUTE)
    both = pd.read_parquet(tmp_path / "both.parquet")
    assert (report.matched, report.with_feedback) == (2, 2)
    assert both.feedback.tolist() == [0, 1, 3, 1]
    assert both.Seconds.tolist() == [0, 9, 3, 4]
    assert both.bought.tolist() == [0, 1, 1, 0]
    assert both.row.tolist() == [0, 0, 1, 1]
    assert both.page.tolist() == ["home"] * 4
    assert both.Free.tolist() == [True, False, True, False]
    assert [*both] == [
        *[*first][:-5], "row", "page", "Free", "feedback", "bought", "Seconds"
    ]  # fmt: skip


def test_a_column_with_numbers_in_one_file_and_words_in_another_is_refused(tmp_path: Path) -> None:
    wanted = r"1\.csv: column CLICK has numbers in .*0\.csv, but here 1 of 2 are not numbers"
    with pytest.raises(InputError, match=wanted):
        joined_files(tmp_path, csv("click", "1"), csv("CLICK", "1", "n/a"))


def test_a_column_may_be_text_of_numbers_or_empty_in_some_files(tmp_path: Path) -> None:
    text = feedback([(1, 11, 7, "5"), (1, 11, 7, None)])
    dates = feedback([(2, 10, 7, pd.NaT)])
    _, log = joined_files(tmp_path, csv("click", "true"), text, dates, csv("click", ""))
    assert log.click.tolist() == [0, 5, 1, 0]
    assert log.feedback.tolist() == [0, 2, 2, 1]


def test_names_of_feedback_columns_match_whatever_their_case(tmp_path: Path) -> None:
    second = feedback([(1, 11, 7, 2)]).rename(columns=str.upper)
    third = feedback([(2, 10, 7, True, 4)], "like").rename(columns={"click": "cliCK"})
    report, log = joined_files(tmp_path, csv("Click", "1"), second, third)
    assert report.columns == ("Click", "like")
    assert log.Click.tolist() == [0, 2, 1, 1]
    assert log.like.tolist() == [0, 0, 0, 4]


@pytest.mark.parametrize("name", ["Reward", "row", "value_0", 'a "b"'])
def test_a_feedback_column_may_have_any_name(tmp_path: Path, name: str) -> None:
    given = feedback([(1, 10, 7, 3, 4)], "more").rename(columns={"click": name})
    report, log = joined_files(tmp_path, given)
    assert report.columns == (name, "more")
    assert log[name].tolist() == [0, 0, 3, 0]
    assert log.more.tolist() == [0, 0, 4, 0]


def test_the_index_of_a_frame_is_no_feedback(tmp_path: Path) -> None:
    given = feedback([(1, 10, 9, 0), (1, 10, 7, 3), (1, 10, 8, 1)])
    given = given.set_index(pd.Index([7, 5, 9]))
    given.to_parquet(tmp_path / "indexed.parquet")
    assert "__index_level_0__" in pq.read_schema(tmp_path / "indexed.parquet").names
    report, log = joined_files(tmp_path, given)
    assert report.columns == ("click",)
    assert "__index_level_0__" not in log


def test_a_feedback_column_that_the_log_has_itself_is_left_out_with_a_note(tmp_path: Path) -> None:
    given = feedback([(1, 10, 7, 3)]).rename(columns={"click": "Feedback"})
    with pytest.warns(InputNote, match=r"0\.parquet: .*Feedback \(the log has its own.*rename it"):
        _, log = joined_files(tmp_path, given)
    assert log.feedback.tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize("name", ["request_id", "Request_ID"])
def test_a_request_id_is_the_text_of_the_file(tmp_path: Path, name: str) -> None:
    shown = pd.read_parquet(exposures(tmp_path / "of"))
    shown["request_id"] = shown.request_id.replace({"a": "007", "b": "7"})
    shown.to_parquet(tmp_path / "shown.parquet")
    (tmp_path / "clicks.csv").write_text(csv(f"{name},click", "007,1"))
    files = [tmp_path / "shown.parquet"], [tmp_path / "clicks.csv"]
    join_feedback(*files, tmp_path / "log.parquet", 30 * MINUTE)
    log = pd.read_parquet(tmp_path / "log.parquet")
    assert log[log.click == 1].request_id.tolist() == ["007"]


@pytest.mark.parametrize(
    ("time", "told"),
    [
        (f"{START // 1000}", "feedback from 1970-01-20 16:13:20 to 1970-01-20 16:13:20"),
        (f"{START}000", "feedback from 55840-"),
        (f"{START}000000", f"feedback from {START}000000 to"),
        ("2023-11-14", "dates have no time of day and count as midnight"),
        ("", "feedback from (none) to (none)"),
    ],
)
def test_feedback_at_other_times_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], time: str, told: str
) -> None:
    clicks = f"user_id,item_id,timestamp,click\n1,10,{time},1\n1,11,{time},1\n"
    (tmp_path / "clicks.csv").write_text(clicks)
    given = [str(exposures(tmp_path / "shown")), str(tmp_path / "clicks.csv")]
    assert main(["join", *given, "--within", "30m", "--out", str(tmp_path / "log.parquet")]) == 0
    (note,) = capsys.readouterr().err.splitlines()
    assert "note: none of the 2 rows of feedback matches an exposure" in note
    assert "exposures are from 2023-11-14 22:13:20 to 2023-11-14 22:18:20" in note
    assert "read as milliseconds: seconds need --column timestamp='COLUMN * 1000'" in note
    assert told in note
    assert "request_id" not in note
    assert "none of its users" not in note


@pytest.mark.parametrize("scale", ["* 1000", "/ 1000"])
def test_the_remedy_for_times_in_other_units_works(tmp_path: Path, scale: str) -> None:
    time = START // 1000 if "*" in scale else START * 1000
    (tmp_path / "clicks.csv").write_text(f"user_id,item_id,time,click\n1,10,{time},1\n")
    given = [str(exposures(tmp_path / "shown")), str(tmp_path / "clicks.csv")]
    out = ["--within", "30m", "--out", str(tmp_path / "log.parquet")]
    assert main(["join", *given, *out, "--column", f"timestamp=time {scale}"]) == 0
    assert pd.read_parquet(tmp_path / "log.parquet").click.tolist() == [1, 0, 0, 0]


def test_feedback_of_other_requests_or_users_is_told(tmp_path: Path) -> None:
    given = feedback([(1, 10, 7, 1, "y"), (1, 10, 7, 1, "z")], "request_id")
    with pytest.warns(InputNote, match=r"none of its 2 values of request_id \(such as 'y'\)"):
        joined_files(tmp_path, given)
    (tmp_path / "users").mkdir()
    with pytest.warns(InputNote, match="none of its users was shown any of their items"):
        joined_files(tmp_path / "users", feedback([(3, 10, 7, 1)]))


@pytest.mark.slow
def test_a_join_killed_at_any_moment_ends_as_if_left_alone(tmp_path: Path) -> None:
    rows = 200_000
    frame = pd.DataFrame({"user_id": [str(n % 977) for n in range(rows)]})
    frame["item_id"] = frame.index % 83
    frame = frame.assign(timestamp=START + frame.index, request_id=frame.index.astype(str))
    frame = frame.assign(position=1, propensity=0.5, run="r", rule="d")
    (tmp_path / "shown").mkdir()
    frame.to_parquet(tmp_path / "shown" / "a.parquet")
    clicked = frame[::7][["user_id", "item_id", "timestamp", "request_id"]].assign(click=1)
    clicked.to_parquet(tmp_path / "feedback.parquet")
    assert kills("join", tmp_path) >= 2
    log = pd.read_parquet(tmp_path / "joined.parquet")
    assert len(log) == rows
    assert log.click.sum() == log.feedback.sum() == len(clicked)
    assert sorted(path.name for path in tmp_path.glob("*.parquet")) == [
        "feedback.parquet", "joined.parquet"
    ]  # fmt: skip


def test_the_options_of_a_log_hold_for_the_feedback(tmp_path: Path) -> None:
    given = feedback([(1, 10, 7, 1, "app"), (1, 11, 2, 1, "bot"), (2, 10, 6, 1, "bot")], "source")
    for day, rows in {"01": given[:2], "02": given[2:]}.items():
        (tmp_path / f"day={day}").mkdir()
        rows.to_parquet(tmp_path / f"day={day}" / "rows.parquet")
    shown, files = exposures(tmp_path / "shown"), [str(tmp_path / "day=*")]

    def clicks(mapping: LogMapping) -> list[float]:
        join_feedback([shown], files, tmp_path / "log.parquet", 30 * MINUTE, mapping)
        log = pd.read_parquet(tmp_path / "log.parquet")
        return log.sort_values(["timestamp", "user_id", "position"]).click.tolist()

    assert clicks(LogMapping()) == [0, 1, 1, 1]
    assert clicks(LogMapping(where="source = 'app' AND click = 1")) == [0, 0, 1, 0]
    assert clicks(LogMapping(where="day = '02'", partitions=True)) == [0, 0, 0, 1]
    assert clicks(LogMapping(earliest="2023-11-14T22:20:20")) == [0, 0, 1, 0]


def test_exposures_in_csv_files_are_the_text_of_the_file(tmp_path: Path) -> None:
    """Of an empty arm in Parquet and no arm in CSV, there is one; 1e1 and 10 are two items."""
    rows = [
        ("7", item, START, request, 1, 0.5, run, "d", "")
        for item, request, run in (("1e1", "5e1", "1e3"), ("10", "50", "1000"))
    ]
    names = ["user_id", "item_id", "timestamp", "request_id", "position", "propensity", "run"]
    shown = pd.DataFrame(rows, columns=[*names, "rule", "arm"])
    (tmp_path / "shown").mkdir()
    shown.to_csv(tmp_path / "shown" / "one.csv", index=False)
    shown[:1].to_parquet(tmp_path / "shown" / "two.parquet")
    clicks = feedback([("7", "1e1", 0, 1)]).assign(request_id="5e1")
    clicks.to_csv(tmp_path / "clicks.csv", index=False)
    report = join_feedback(
        [tmp_path / "shown"], [tmp_path / "clicks.csv"], tmp_path / "log.parquet", MINUTE
    )
    assert (report.exposures, report.repeated, report.matched) == (2, 1, 1)
    log = pd.read_parquet(tmp_path / "log.parquet").set_index("item_id")
    assert log.click.to_dict() == {"1e1": 1, "10": 0}
    assert log.loc["1e1", ["request_id", "run"]].tolist() == ["5e1", "1e3"]


@pytest.mark.parametrize("name", ["run", "rule", "arm"])
def test_a_list_of_another_run_or_rule_is_no_repetition(tmp_path: Path, name: str) -> None:
    """`recommend LOGS` gives a user without new rows the same request id again."""
    folder = exposures(tmp_path / "shown")
    again = pd.read_parquet(folder / "one.parquet").assign(**{name: "other"})
    again.assign(timestamp=again.timestamp + 60 * MINUTE).to_parquet(folder / "three.parquet")
    feedback([(1, 10, 67, 1)]).to_parquet(tmp_path / "feedback.parquet")
    report = join_feedback([folder], [tmp_path / "feedback.parquet"], tmp_path / "log", 30 * MINUTE)
    assert (report.exposures, report.repeated, report.matched) == (7, 1, 1)


@pytest.mark.parametrize("written", ["feedback.parquet", "shown/one.parquet"])
def test_what_is_read_is_not_written_over(tmp_path: Path, written: str) -> None:
    feedback([(1, 10, 7, 1)]).to_parquet(tmp_path / "feedback.parquet")
    shown, out = exposures(tmp_path / "shown"), tmp_path / written
    before = out.read_bytes()
    with pytest.raises(InputError, match="would be written over what is read; name another file"):
        join_feedback([shown], [tmp_path / "feedback.parquet"], out, 30 * MINUTE)
    assert out.read_bytes() == before
