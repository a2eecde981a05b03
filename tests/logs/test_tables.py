"""What is in a file is what counts: folders, parts, text that looks like a number, empty parts."""

import itertools
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import START, random_log, write
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.histories import read_histories
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.prepare import PrepareOptions, prepare, validate
from ucfrec_datasets import generic

SMALL = PrepareOptions(embedding_size=4)


def prepared(folder: Path, out: Path, **columns: str) -> dict[str, Any]:
    """The report of a folder and its meta.json's fingerprint, with features as files say."""
    logs, mapping = generic.DATASET.resolve([folder], LogMapping(columns))
    report = prepare(logs, mapping, out, SMALL)
    return {**report, "fingerprint": fingerprint(out)}


def fingerprint(store: Path) -> str:
    return EpisodeStore.open(store).record.fingerprint


# Folders and parts


@pytest.mark.parametrize(("name", "suffix"), [("user_id", ".csv"), ("timestamp", ".parquet")])
def test_the_name_of_a_folder_replaces_no_column(tmp_path: Path, name: str, suffix: str) -> None:
    log = random_log()
    report = validate([write(log, tmp_path / f"{name}=7" / f"log{suffix}")], LogMapping())
    counts = report["users"], report["items"], report["steps"]
    assert counts == (log["user_id"].nunique(), 20, 400)


def test_a_folder_is_read_with_its_sub_folders(tmp_path: Path) -> None:
    log = random_log()
    days = pd.to_datetime(log["timestamp"], unit="ms").dt.strftime("%Y-%m-%d")
    lake = tmp_path / "lake"
    for day, part in log.groupby(days):
        write(part, lake / f"timestamp={day}" / "hour=0" / "part.parquet")
    # Writers leave what is not part of the table.
    for hidden in (".tmp", "_temporary", "_delta_log"):
        write(log, lake / hidden / "part.parquet")
    write(log, lake / ".part.parquet")
    (lake / "back").symlink_to(lake)
    for paths in ([lake, lake], [f"{lake}/time*"]):
        assert len(log_files(paths)) == len(set(days))
    assert validate([f"{lake}/**/p*.parquet"], LogMapping())["steps"] == 400


def test_columns_come_from_folders_on_purpose(tmp_path: Path) -> None:
    log = random_log()
    log["user_id"] %= 9
    for user, part in log.groupby("user_id"):
        write(part.drop(columns="user_id"), tmp_path / f"user_id={user}" / "a%20b=x" / "p.parquet")
    with pytest.raises(InputError, match=r"no column 'user_id'.*folders name its values"):
        validate(log_files([tmp_path]), LogMapping())
    given = LogMapping(partitions=True)
    assert validate(log_files([tmp_path]), given)["users"] == log["user_id"].nunique()
    (batch,) = read_histories([tmp_path], given, "reward", 1000)
    assert batch.users.tolist() == sorted(log["user_id"].unique())
    # One word makes words of them all; a folder without a value does not.
    others = log.drop(columns="user_id")
    for name in ("7", "007", "a%20b"):
        write(others, tmp_path / "words" / f"user_id={name}" / "part.parquet")
    (batch,) = read_histories([tmp_path / "words"], given, "reward", 1000)
    assert batch.users.tolist() == ["007", "7", "a b"]
    for name in ("3", "__HIVE_DEFAULT_PARTITION__"):
        write(log, tmp_path / "numbers" / f"weight={name}" / "part.parquet")
    (batch,) = read_histories([tmp_path / "numbers"], given, "coalesce(weight, 7)", 1000)
    assert {*batch.rewards.tolist()} == {7}


def test_parts_of_a_log_are_joined_by_the_names_of_their_columns(tmp_path: Path) -> None:
    log = random_log()
    whole = write(log, tmp_path / "log.parquet")
    parts = tmp_path / "parts"
    write(log[:200][["reward", "timestamp", "item_id", "user_id"]], parts / "a.parquet")
    write(log[200:300].assign(more="x")[["more", *log.columns]], parts / "b.parquet")
    write(log[300:].rename(columns=str.upper), parts / "c.csv")
    for n, path in enumerate((whole, parts)):
        assert prepare([path], LogMapping(), tmp_path / f"store-{n}", SMALL)["steps"] == 400
    assert fingerprint(tmp_path / "store-0") == fingerprint(tmp_path / "store-1")


USERS = pd.DataFrame(
    {"user_id": range(100), "age": 20.0 + np.arange(100) % 7, "spend": 1000 - np.arange(100) ** 1.5}
)


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_parts_of_features_are_joined_by_column_names(tmp_path: Path, suffix: str) -> None:
    write(random_log(), tmp_path / "log.parquet")
    reports = []
    for n, columns in enumerate((list(USERS.columns), ["AGE", "User_ID", "spend"])):
        write(USERS[:50], tmp_path / "users.parquet" / f"0{suffix}")
        part = USERS[50:][[name.lower() for name in columns]]
        write(part.set_axis(columns, axis=1), tmp_path / "users.parquet" / f"1{suffix}")
        reports.append(prepared(tmp_path, tmp_path / f"store-{n}"))
    assert reports[0]["fingerprint"] == reports[1]["fingerprint"]
    # A column of some parts is missing in the others.
    for n, part in enumerate((USERS[50:].assign(spend=None), USERS[50:][["user_id", "age"]])):
        write(part, tmp_path / "users.parquet" / f"1{suffix}")
        reports.append(prepared(tmp_path, tmp_path / f"missing-{n}"))
    assert reports[2]["fingerprint"] == reports[3]["fingerprint"]


@pytest.mark.parametrize(("name", "value"), [("spend", np.nan), ("city", "Rome")])
def test_the_fingerprint_covers_every_feature_value(tmp_path: Path, name: str, value: Any) -> None:
    users = USERS.assign(city=np.where(USERS["user_id"] % 2, "Oslo", "Lima"))
    write(random_log(), tmp_path / "log.parquet")
    write(users, tmp_path / "users.parquet")
    first = prepared(tmp_path, tmp_path / "store-0")["fingerprint"]
    write(users.sample(frac=1, random_state=0), tmp_path / "users.parquet")
    assert prepared(tmp_path, tmp_path / "store-1")["fingerprint"] == first
    users.loc[70, name] = value
    write(users, tmp_path / "users.parquet")
    assert prepared(tmp_path, tmp_path / "store-2")["fingerprint"] != first


# Identifiers


def test_an_identifier_of_a_csv_file_is_its_text(tmp_path: Path) -> None:
    """Also where DuckDB, which looks at the first rows, takes the column for whole numbers."""
    ids = [*map(str, np.arange(21_000) % 49 + 1)]
    ids[-2:] = ["007", '"7"']
    lines = [f"{n % 10},{each},{START + 1000 * n},{n % 2}" for n, each in enumerate(ids)]
    for name in ("user_id,item_id", "item_id,user_id"):
        path = tmp_path / "log.csv"
        path.write_text("\n".join([f"{name},timestamp,reward", *lines]) + "\n")
        report = validate([path], LogMapping())
        counts = {report["users"], report["items"]}
        assert counts == {10, len({each.strip('"') for each in ids})}


@pytest.mark.parametrize("text", ["log", "later"])
def test_users_of_text_and_of_integers_are_the_same(tmp_path: Path, text: str) -> None:
    """With `like`, as in `score`, `rank` and `ope`: '01' is not 1."""
    ids = [*map(str, range(1, 60)), "01"]
    log, later = random_log(2000, 60), random_log(600, 59)
    later["user_id"] += 1
    if text == "log":
        log["user_id"] = [ids[n] for n in log["user_id"]]
    else:
        log["user_id"] += 1
        later["user_id"] = later["user_id"].astype(str)
        later.loc[:9, "user_id"] = "01"
    like, found = tmp_path / "store", tmp_path / "found"
    prepare([write(log, tmp_path / "log.parquet")], LogMapping(), like, SMALL)
    prepare([write(later, tmp_path / "later.parquet")], LogMapping(), found, SMALL, like=like)
    known = pd.read_parquet(like / "users.parquet")["user_id"].astype(str).tolist()
    users = pd.read_parquet(found / "episode_users.parquet")["user_id"].astype(str)
    expected = [known.index(each) if each in known else -1 for each in users]
    assert [*EpisodeStore.open(found).episode_values("user")] == expected
    assert max(expected) > 0
    assert pd.read_parquet(found / "users.parquet")["user_id"].astype(str).tolist() == known


@pytest.mark.parametrize("parts", [["7,8", "7.0"], ["7,7.0,8"]])
def test_ids_with_decimals_are_noted_and_can_be_made_one(tmp_path: Path, parts: list[str]) -> None:
    times = itertools.count(START)
    for n, users in enumerate(parts):
        lines = [f"{user},{user[0]},{next(times)},{user[0]}" for user in users.split(",")]
        (tmp_path / f"{n}.csv").write_text("\n".join(["user_id,item_id,timestamp,reward", *lines]))
    with pytest.warns(InputNote, match=r"user_id is written .* 7 and 7\.0 are two ids; .*::BIGINT"):
        apart = validate(log_files([tmp_path]), LogMapping())["users"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        one = LogMapping({"user_id": "user_id::BIGINT"})
        assert validate(log_files([tmp_path]), one)["users"] == apart - 1


def test_keys_of_features_in_a_csv_file_are_their_text(tmp_path: Path) -> None:
    write(random_log(), tmp_path / "log.parquet")
    keys = [f"{n:03d}" for n in range(100)]
    write(USERS.assign(user_id=keys), tmp_path / "users.csv")
    # 100 to 999 would be their own text; of these, none is.
    with pytest.raises(InputError, match=r"no row belongs to a user_id of the log"):
        prepared(tmp_path, tmp_path / "store", user_id="user_id + 100")
    log = random_log()
    log["user_id"] = log["user_id"].map("{:03d}".format)
    write(log, tmp_path / "log.parquet")
    assert prepared(tmp_path, tmp_path / "store-1")["users"] == log["user_id"].nunique()


# Empty parts, missing values, truth values


@pytest.mark.parametrize(("suffix", "kind"), [(".parquet", "string"), (".csv", "object")])
@pytest.mark.parametrize("name", ["propensity", "session_id", "is_random", "feedback"])
def test_a_column_without_a_value_has_the_type_of_the_other_parts(
    tmp_path: Path, suffix: str, name: str, kind: str
) -> None:
    log = random_log(200)
    filled: dict[str, Any] = {
        "propensity": 0.5,
        "session_id": "s" + log["user_id"].astype(str),
        "is_random": True,
        "feedback": 2,
    }
    log[name] = filled[name]
    write(log[:100].assign(**{name: pd.Series([None] * 100, dtype=kind)}), tmp_path / f"a{suffix}")
    write(log[100:], tmp_path / f"b{suffix}")
    reward = "coalesce(feedback, 0) + reward" if name == "feedback" else None
    report = validate(log_files([tmp_path]), LogMapping(), PrepareOptions(reward=reward))
    missing = 100 if name == "session_id" else 0
    assert (report["steps"], report["dropped"]["null_key"]) == (200 - missing, missing)


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("is_click + 2 * is_like", lambda f: f["is_click"] * 1.0 + 2 * f["is_like"]),
        ("2 * (is_click AND is_like)", lambda f: (f["is_click"] & f["is_like"]) * 2.0),
        ("is_click - (item_id > 9)", lambda f: f["is_click"] * 1.0 - (f["item_id"] > 9)),
        ("CASE WHEN is_click THEN 0.5 + is_like END", lambda f: f["is_like"] + 0.5),
        ("length('é') + length(is_click::VARCHAR)", lambda f: 6.0 - f["is_click"]),
    ],
)
@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_truth_values_are_numbers_in_arithmetic(
    tmp_path: Path,
    suffix: str,
    expression: str,
    value: Callable[[pd.DataFrame], "pd.Series[float]"],
) -> None:
    generator = np.random.default_rng(0)
    log = random_log()
    for name in ("is_click", "is_like"):
        log[name] = generator.random(len(log)) < 0.5
    path = write(log, tmp_path / f"log{suffix}")
    report = validate([path], LogMapping(), PrepareOptions(reward=expression))
    expected = value(log[log["is_click"]] if expression.startswith("CASE") else log)
    assert report["reward_statistics"]["mean"] == pytest.approx(expected.mean(), rel=1e-4)


def test_lines_that_begin_with_a_hash_are_rows(tmp_path: Path) -> None:
    """DuckDB would take these for comments, because all other lines have equal types."""
    lines = [
        "User_Id,Session_Id,Timestamp,Reward,Is_Random,Note,Item_Id",
        'NaN,6,2023-11-15T11:43:20.005+11:00,2.0,1,"x,y",1e3',
        '#1,8,2023-11-15T02:13:20.000Z,inf,0,"x,y",12:00',
        'NaN,0,2023-11-14 23:43:20.000,0.0,,"x,y",1e3',
        '#1,6,2023-11-15T10:43:20.000+11:00,3.0,,"x,y",12:00',
        '#1,8,2023-11-14 22:13:21.998,1.0,1,"x,y",1e3',
    ]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    report = validate([tmp_path / "log.csv"], LogMapping(), PrepareOptions("item_id = '1e3'"))
    assert (report["rows_read"], report["users"]) == (5, 2)


@pytest.mark.parametrize("title", ["# exported by the shop", ""])
def test_a_title_above_the_header_is_skipped(tmp_path: Path, title: str) -> None:
    log = random_log()
    (tmp_path / "log.csv").write_text(f"{title}\n{log.to_csv(index=False)}")
    assert validate([tmp_path / "log.csv"], LogMapping())["rows_read"] == len(log)


def test_endings_are_read_in_any_case_and_other_tables_are_named(tmp_path: Path) -> None:
    log = random_log()
    log.to_parquet(tmp_path / "a.PARQUET")
    log.to_csv(tmp_path / "b.Csv", index=False)
    log.to_csv(tmp_path / "c.tsv", index=False, sep="\t")
    (tmp_path / "notes.txt").write_text("not a table")
    with pytest.warns(InputNote, match=r"c\.tsv is not read; convert it") as notes:
        files = log_files([tmp_path])
    assert [file.name for file in files] == ["a.PARQUET", "b.Csv"]
    assert len(notes) == 1
    assert validate(files, LogMapping())["rows_read"] == 2 * len(log)


def test_a_field_of_50_megabytes_is_refused_in_a_second(tmp_path: Path) -> None:
    rows = [f"1,{n % 9},{START + n},{n % 2},b" for n in range(6000)]
    rows[5000] += "a" * 50_000_000
    (tmp_path / "log.csv").write_text("\n".join(["user_id,item_id,timestamp,reward,x", *rows]))
    began = time.process_time()
    with pytest.raises(InputError, match=r"log\.csv, line 5002: .*Maximum line size"):
        validate([tmp_path / "log.csv"], LogMapping())
    assert time.process_time() - began < 2
