"""The owner of a log sees what is in it, what is lost, and of bots."""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import START, random_log, write
from ucfrec.errors import InputNote
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, validate
from ucfrec.logs.sessions import Moments


def make_log(rows: int = 4000) -> pd.DataFrame:
    log = random_log(rows, users=400, step=5_000)
    generator = np.random.default_rng(1)
    return log.assign(revenue=np.where(generator.random(rows) < 0.03, 9.9, np.nan))


def notes_of(path: Path, mapping: LogMapping | None = None, **options: object) -> list[str]:
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", InputNote)
        validate([path], mapping or LogMapping(), PrepareOptions(**options))  # type: ignore[arg-type]
    return [str(note.message) for note in notes if note.category is InputNote]


def test_a_reward_that_is_null_because_a_column_is_names_it(tmp_path: Path) -> None:
    path = write(make_log(), tmp_path / "log.csv")
    everything = LogMapping(where="(reward >= 0) + 1 > 0")
    (note,) = notes_of(path, everything, reward="reward + REVENUE")
    assert (
        "(97%) are dropped: the reward reward + REVENUE is null because revenue is, in 3," in note
    )
    assert note.endswith("give a default: coalesce(revenue, 0)")
    assert not notes_of(path, reward="reward + coalesce(revenue, 0)")
    assert not notes_of(path)


@pytest.mark.parametrize("name", ["user_id", "timestamp"])
def test_many_rows_without_a_key_are_told_of_by_column(tmp_path: Path, name: str) -> None:
    log = make_log()
    log[name] = log[name].astype("Int64")
    log.loc[:599, name] = None
    assert not notes_of(write(log, tmp_path / "log.parquet"))
    log.loc[:999, name] = None
    (note,) = notes_of(write(log, tmp_path / "log.parquet"))
    assert "1,000 of 4,000 rows (25%) are dropped: user, item" in note
    assert f"({name} in 1,000); fill it in, or map another column" in note


def test_many_times_out_of_range_and_repetitions_are_told_of(tmp_path: Path) -> None:
    log = make_log()
    log.loc[:1999, "timestamp"] = np.arange(2000) * 1000 + 800_000_000_000
    (note,) = notes_of(write(log, tmp_path / "log.parquet"))
    assert "2,000 of 4,000 rows (50%) are dropped: time before 2000" in note
    assert "say --earliest 1990-01-01" in note
    (note,) = notes_of(write(pd.concat([make_log()] * 2), tmp_path / "log.parquet"))
    assert "4,000 of 8,000 rows (50%) are dropped: repeats user, item" in note
    assert "log finer times, or remove the repetitions" in note


def with_bots(names: Iterable[int | str], rows: int) -> pd.DataFrame:
    times = START + 1000 * np.arange(rows)
    bots = [make_log(rows).assign(user_id=name, timestamp=times) for name in names]
    return pd.concat([make_log(), *bots], ignore_index=True)


def test_the_largest_five_bots_are_named(tmp_path: Path) -> None:
    log = pd.concat([with_bots(range(1000, 1007), 300), with_bots([2000], 500)[4000:]])
    path = write(log, tmp_path / "log.parquet")
    (note,) = notes_of(path)
    assert "2000 (500 rows), " in note
    assert note.count("(300 rows)") == 4
    assert "the median session has 2 rows, " in note
    assert '--where "user_id NOT IN (2000, ' in note
    assert not notes_of(path, max_session=100)
    report = validate([path], LogMapping(where="USER_ID < 1000"))
    assert report["dropped"]["left_out"] == len(log) - report["steps"] == 2600


@pytest.mark.parametrize("bot", ["bot-1", "it's", "$(id)", "`id`", 7000])
def test_the_condition_that_excludes_bots_can_be_pasted(tmp_path: Path, bot: str | int) -> None:
    log = with_bots([bot], 300)
    if isinstance(bot, str):
        log["user_id"] = log["user_id"].astype(str)
    path = write(log.rename(columns={"user_id": "visitor"}), tmp_path / "log.parquet")
    (note,) = notes_of(path, LogMapping({"user_id": "visitor"}))
    (where,) = re.findall(r'--where "(.*)" or', note)
    assert not set(where) & set("$`")
    if where != "visitor NOT IN (…)":
        report = validate([path], LogMapping({"user_id": "visitor"}, where=where))
        assert report["dropped"]["left_out"] == 300


def test_rows_in_which_the_condition_is_undefined_are_told_of(tmp_path: Path) -> None:
    log = make_log(200).assign(member=[None, "M1", "M9", "M2"] * 50)
    path, where = write(log, tmp_path / "log.csv"), "member <> 'M9'"
    note, _ = notes_of(path, LogMapping(where=where))
    assert f"the condition {where} is neither true nor false in 50 of 200 rows" in note
    for defined in ("member IS DISTINCT FROM 'M9'", f"coalesce({where}, true)"):
        assert all(defined not in note for note in notes_of(path, LogMapping(where=defined)))
        assert validate([path], LogMapping(where=defined))["dropped"]["left_out"] == 50


def test_a_log_of_a_single_item_and_parts_of_sessions_are_told_of(tmp_path: Path) -> None:
    (note,) = notes_of(write(make_log(200).assign(item_id=7), tmp_path / "log.parquet"))
    assert "all 200 rows show the same item, so there is nothing to choose between" in note
    log = make_log(200).assign(user_id=np.arange(200) // 5, place=np.arange(200) % 5, session_id=1)
    path = write(log, tmp_path / "log.parquet")
    for session_by in ("gap", "session_id", "user"):
        (note,) = notes_of(path, LogMapping(where="place IN (0, 3)"), session_by=session_by)
        assert "80 rows that are left out are inside of sessions" in note
        assert not notes_of(path, LogMapping(where="place < 3"), session_by=session_by)
    days = log.assign(timestamp=log.timestamp + log.place * 10**8)
    (note,) = notes_of(write(days, path), split=(1.0, 0.0, 0.0))
    assert "40 of 40 sessions last longer than a day" in note


def test_batches_give_the_moments_of_all() -> None:
    generator = np.random.default_rng(0)
    values = 1e9 + generator.normal(size=(2, 1000)) * [[1], [3]]
    moments = Moments(2)
    for part in np.split(values, [0, 1, 10, 700], axis=1):
        moments.add(*part)
    assert moments.count == 1000
    np.testing.assert_allclose(moments.mean, values.mean(axis=1), rtol=1e-15)
    np.testing.assert_allclose(moments.covariance, np.cov(values, ddof=0), rtol=1e-6)
