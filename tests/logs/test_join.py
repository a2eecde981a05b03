"""Exposures joined with feedback: every row of feedback counts once, for what it is about."""

from pathlib import Path

import pandas as pd
import pytest

from tests.support.killed import kills
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.logs.join import join_feedback
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
