"""What `prepare`, mappings and tables of items and users refuse: one clear error each."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.logs import START, random_log, write
from ucfrec.errors import InputError
from ucfrec.logs.mapping import FeatureTable, LogMapping, log_files, read_columns, read_mapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate

Act = Callable[[Path], Any]


def refuse(act: Act, folder: Path, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        act(folder)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    assert not (folder / "store").exists()


def log_with(name: str = "log.parquet", mapping: LogMapping | None = None, **values: Any) -> Act:
    """`prepare` of a log in which some columns have other values, or are options."""
    names = values.keys() & {*PrepareOptions.__dataclass_fields__} - {"reward"}
    options = {name: values.pop(name) for name in names}

    def act(folder: Path) -> None:
        log = random_log().assign(propensity=0.5)
        path = write(log.assign(**values), folder / name)
        how = mapping or LogMapping()
        prepare([path], how, folder / "store", PrepareOptions(**options))

    return act


def lines_with(change: Callable[[list[str]], list[str]]) -> Act:
    """`validate` of a CSV file with changed lines."""

    def act(folder: Path) -> None:
        lines = random_log(40).to_csv(index=False).splitlines()
        (folder / "log.csv").write_text("\n".join(change(lines)) + "\n")
        validate([folder / "log.csv"], LogMapping())

    return act


def bytes_with(change: Callable[[bytes], bytes]) -> Act:
    """`prepare` of a damaged Parquet file."""

    def act(folder: Path) -> None:
        path = write(random_log(), folder / "log.parquet")
        path.write_bytes(change(path.read_bytes()))
        prepare([path], LogMapping(), folder / "store")

    return act


def parts_with(*parts: pd.DataFrame, names: str = "{}.csv", **mapping: Any) -> Act:
    """`validate` of several files."""

    def act(folder: Path) -> None:
        for n, part in enumerate(parts):
            write(part, folder / names.format(n))
        validate(log_files([folder]), LogMapping(**mapping))

    return act


def twice(name: str) -> Act:
    """`validate` of a file with two columns of one name."""

    def act(folder: Path) -> None:
        log, file = random_log(), folder / name
        if name.endswith("parquet"):
            columns = [*map(pa.array, log.to_numpy().T)]
            pq.write_table(pa.table([*columns, columns[0]], names=[*log.columns, "reward"]), file)
        else:
            log.assign(REWARD=1 - log.reward).to_csv(file, index=False)
        validate([file], LogMapping())

    return act


def latin(folder: Path) -> None:
    log = random_log().assign(item_id="é")
    log.to_csv(folder / "log.csv", index=False, encoding="latin-1")
    validate([folder / "log.csv"], LogMapping())


def nested(folder: Path) -> None:
    values = pa.array([1] * 400)
    for _ in range(40):
        values = pa.ListArray.from_arrays(pa.array(range(401), pa.int32()), values)
    log = pa.Table.from_pandas(random_log()).append_column("tree", values)
    pq.write_table(log, folder / "log.parquet")
    validate([folder / "log.parquet"], LogMapping({"observation": "tree"}))


def broken_link(folder: Path) -> None:
    write(random_log(), folder / "logs" / "1.parquet")
    (folder / "logs" / "2.parquet").symlink_to("not-fetched.parquet")
    log_files([folder / "logs"])


def dated(form: str, first: str = "2024-03-01", days: int = 11) -> pd.DataFrame:
    times = pd.Timestamp(first) + pd.to_timedelta(np.arange(400) * days // 400, unit="D")
    return random_log().assign(timestamp=times.strftime(form))


LOGS: dict[str, tuple[Act, str]] = {
    "missing column": (
        parts_with(random_log().rename(columns={"item_id": "itemid"})),
        r"0\.csv has no column 'item_id'.*did you mean 'itemid'",
    ),
    "text time": (log_with(timestamp="noon"), r"timestamp\) is 'noon', no ISO 8601 time"),
    "real ids": (
        log_with(user_id=0.5),
        r"user_id \(user_id\) is DOUBLE.*BIGINT.*at most 15 digits: others would be rounded",
    ),
    "rounded times": (
        log_with(timestamp=(START + 9_000 * np.arange(400)).astype("f4")),
        r"timestamp, which is FLOAT, and 400 of 400 values are 16,777,216 or more and rounded",
    ),
    "rounded ids": (
        log_with(mapping=LogMapping({"user_id": "uid::BIGINT"}), uid=[1.0] * 399 + [1e17]),
        r"uid, which is DOUBLE, and 1 of 400 values are .* write them as int64",
    ),
    "lists in lists": (nested, "a column has lists in lists, more than 16 levels deep"),
    "a broken link": (broken_link, r"2\.parquet is a link to a file that does not exist; fetch"),
    "text reward": (log_with(reward="much"), r"reward \(reward\) is VARCHAR"),
    "seconds": (
        log_with(timestamp=START // 1000 + np.arange(400)),
        r"no row is left \(400 rows: time before 2000.*milliseconds.*--earliest 1990-01-01, or ear",
    ),
    "percentages": (
        log_with(propensity=60.0),
        r"propensity is above 1, up to 60, in 400 of 400 rows.*propensity / 100",
    ),
    "unknown propensities as -1": (
        log_with(propensity=[0.5] * 390 + [-1] * 9 + [0]),
        r"is not above 0, down to -1, in 10 of 400 rows.*nullif\(propensity, -1\)",
    ),
    "no finite reward": (log_with(reward=np.nan), r"no row is left .*NaN"),
    "a reward beyond float32": (
        log_with(reward=[0.0, 1] * 199 + [2e38, -1e13]),
        r"2 of 400 rewards are beyond ±1e\+12 \(up to 2e\+38\), too large.*divide them",
    ),
    "no session": (log_with(min_steps=1000), r"no session is left: none of the 400 clean rows"),
    "no training": (log_with(split=(5.0, 6.0)), r"no row is in the training split, before 1970"),
    "unequal lists": (
        log_with(observation=[[1.0] * (1 + (i == 7)) for i in range(400)]),
        r"observation has lists of 1 to 2 numbers; make them equally long",
    ),
    "an observation that is NaN": (
        log_with(observation=[np.array([1.0, n or np.nan]) for n in range(400)]),
        r"observation is missing .* in 1 of 400 rows",
    ),
    "line breaks in a name": (
        parts_with(random_log().rename(columns={"reward": "a\n\x1b[31mb"}), names="{}.parquet"),
        "no column 'reward'",
    ),
    "truncated": (bytes_with(lambda b: b[: len(b) // 2]), r"cannot be read.*truncated"),
    "damaged": (
        bytes_with(lambda b: b[:40] + b"\xff" * 1000 + b[1040:]),
        r"log\.parquet cannot be read",
    ),
    "no bytes": (bytes_with(lambda b: b""), r"log\.parquet is empty \(0 bytes\)"),
    "no rows": (parts_with(random_log(0), names="{}.parquet"), r"is empty \(0 rows\)"),
    "a word in a late line": (
        lines_with(lambda lines: [lines[0], *lines[1:] * 600, "1,2,soon,1.0"]),
        r"log\.csv, line 24002: column timestamp: .*soon.*Parquet",
    ),
    "too many fields": (
        lines_with(lambda lines: [*lines[:20], lines[20] + ",1"]),
        r"log\.csv, line 21 has 5 fields, the",
    ),
    "too few fields": (
        lines_with(lambda lines: [*lines[:20], "1,2"]),
        r"log\.csv, line 21 has 2 fields, the header 4;",
    ),
    "no header": (
        lines_with(lambda lines: lines[1:]),
        r"log\.csv, line 1 has values \(\d+, .*instead of the names",
    ),
    **{f"two rewards in {name}": (twice(name), r"(?i)more than one column reward; rename or")
       for name in ("log.parquet", "log.csv")},
    "latin-1": (latin, "not in UTF-8; convert it"),
    "a folder and its file": (
        parts_with(random_log(), names="user_id=8/{}.csv", partitions=True),
        "in the file, but its folder says another value",
    ),
    "vectors of a part only": (
        parts_with(
            random_log(9).assign(observation=[[1.0]] * 9),
            random_log(9).assign(observation=pd.Series([None] * 9, dtype="string")),
            names="{}.parquet",
        ),
        r"observation is missing .* in 9 of 18 rows",
    ),
    "a part with another kind of time": (
        parts_with(dated("%Y-%m-%d"), dated("%m/%d/%Y")),
        r"1\.csv: timestamp \(timestamp\) is '03/01/2024', no ISO 8601 time nor milliseconds",
    ),
    "other times": (
        parts_with(dated("%d %b %Y %H:%M")),
        "no ISO 8601 time nor milliseconds; say how it is written",
    ),
    "dates in an expression": (
        log_with("log.csv", LogMapping(reward="month(made)"), made="03/01/2024"), "not a scalar SQL"
    ),
    "a condition that is none": (
        log_with(mapping=LogMapping(where="user_id")),
        r"--where \(user_id\) is BIGINT; write a condition",
    ),
    "a condition that reads": (
        log_with(mapping=LogMapping(where="read_text('/etc/passwd') = ''")), "it calls 'read_text'"
    ),
    "a limit that is none": (log_with(memory_limit="much"), "'much' is not a size; write e.g. 2GB"),
    "a missing file": (lambda f: log_files([f / "a.parquet"]), "a.parquet does not exist"),
    "a pattern of nothing": (lambda f: log_files([f / "*.parquet"]), r"\*\.parquet matches no"),
    "another kind of file": (lambda f: log_files([write(random_log(1), f / "log.txt")]),
                             r"log\.txt is not a .parquet or"),
    "no file at all": (lambda f: log_files([]), "no log was named"),
    "a store like no store": (
        lambda f: prepare([write(random_log(), f / "l.csv")], LogMapping(), f / "store", like=f),
        "neither an episode store nor a run",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LOGS)
def test_logs_that_cannot_be_prepared(tmp_path: Path, name: str) -> None:
    refuse(LOGS[name][0], tmp_path, LOGS[name][1])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        *(({"gap_minutes": value}, "gap_minutes is") for value in (np.inf, np.nan, -1.0)),
        *(({name: np.nan}, f"{name} is nan; it must") for name in ("min_steps", "embedding_size")),
        *(({"split": (0.0, value)}, "split is") for value in (np.inf, np.nan, -1.0)),
        ({"split": (0.5, 0.1, 0.1)}, "three shares that add up to 1"),
        ({"max_session": 1, "min_steps": 2}, "max_session is below min_steps"),
        ({"duplicates": "any"}, "must be 'highest', 'lowest', 'first' or 'last'"),
        ({"session_by": "visit"}, "must be 'session_id', 'gap' or 'user', or unset"),
        ({"engine": "pandas"}, "must be 'duckdb' or 'spark'"),
    ],
)
def test_options_that_are_none(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PrepareOptions(**values)


def test_splits_columns_and_tables_that_are_none() -> None:
    with pytest.raises(InputError, match="takes a list of FeatureTable"):
        LogMapping(item_features=(pd.DataFrame(),))  # type: ignore[arg-type]
    for text in ("0.5", "a,b,c", "2024-01-01", "soon,later"):
        with pytest.raises(InputError, match="write shares as"):
            parse_split(text)
    with pytest.raises(InputError, match="write NAME=COLUMN"):
        read_columns(["user_id"])


TABLE = "[[item_features]]\nkey = 'x'\nfiles = "
MAPPINGS = {
    "[[items_features]]\nkey = 'x'": "there is no key 'items_features'; did you mean 'item_",
    "zzz = 1": "there is no key 'zzz'; there are columns, reward, session_by, item_feat",
    "[[item_features]]\nfile = ['x']": r"\[\[item_features\]\]: there is no key 'file'; did you",
    "[[user_features]]\nfiles = ['x']": "it has no key 'key'; add it",
    "[item_features]\nfiles = ['x']": r"\[\[item_features\]\]: write it in double brackets",
    f"{TABLE}'price'": "files of features is price; write a list",
    "[columns]\nitem = 'x'": "'item' is not a log column",
    "earliest = 'soon'": "earliest is 'soon'; write a date",
    "[columns]\nuser_id = 3": "is not text",
    "session_by = 'Gap'": "session_by is .*; use session_id, gap, user",
    "reward = ": "m.toml",
}  # fmt: skip


@pytest.mark.parametrize("lines", MAPPINGS)
def test_mappings_that_cannot_be_used(tmp_path: Path, lines: str) -> None:
    (tmp_path / "m.toml").write_text(f"{lines}\n")
    refuse(lambda folder: read_mapping(folder / "m.toml"), tmp_path, MAPPINGS[lines])


def table_with(ids: list[Any], keys: list[Any], names: Sequence[str] = (), **columns: Any) -> Act:
    """`prepare` of a log of items `ids` with features of items `keys`."""

    def act(folder: Path) -> None:
        log = random_log(len(ids) * 10).assign(item_id=ids * 10)
        table = pd.DataFrame({"key": keys, "price": range(len(keys)), **columns})
        file = write(table, folder / "table.parquet")
        features = (FeatureTable((file,), "key", (*names, "price", *columns)),)
        mapping = LogMapping(item_features=features)
        prepare([write(log, folder / "log.parquet")], mapping, folder / "store")

    return act


def text_parts(folder: Path) -> None:
    for n, price in enumerate((1.0, "many")):
        table = pd.DataFrame({"item_id": range(n * 10, 10 + n * 10), "price": price})
        write(table, folder / "items" / f"{n}.parquet")
    mapping = LogMapping(item_features=(FeatureTable((folder / "items",), "item_id"),))
    validate([write(random_log(), folder / "log.parquet")], mapping)


NONE = r"table\.parquet: no row belongs to a item_id of the log"
NEVER = rf"{NONE}.*key is never such an id; let the key be"
TABLES: dict[str, tuple[Act, str]] = {
    "other ids": (table_with([1, 2, 12], [21]), rf"{NONE}, which are 1, 2, 12, …, and key is 21"),
    "text ids": (table_with([1, 2], ["i1", "i2"]), NEVER),
    "real ids": (table_with([1, 2, 12], [1.4, 2.4, 11.6]), NEVER),
    "rounded ids": (table_with([2**53, 2**53 + 2], [2.0**53, 2.0**53 + 2]), NEVER),
    "numbers of text": (
        table_with(["a1", "a2", "a12"], [1, 2, 12]),
        rf"{NONE}.*'a1', 'a12', 'a2', …, and key is '1', '12'",
    ),
    "repeated ids": (table_with([1, 2], [1, 2, 2, 2]), "2 of 4 rows repeat a key; keep one row"),
    "a record": (table_with([1], [1], group=[{"a": 1}]), "group. is STRUCT.* as in group.FIELD"),
    "a time": (table_with([1], [1], available_from=[True]), "parquet: available_from .*BOOLEAN"),
    "lists": (table_with([1], [1], tags=[[["a"]]]), r"\(tags\) is VARCHAR\[\]\[\]; cast it"),
    "vectors": (
        table_with([1, 2], [1, 2], v=[np.ones(1), np.ones(2)]), "feature has lists of unequal"
    ),
    "no such feature": (table_with([1], [1], names=["prize"]), r"no column 'prize' \(item_id feat"),
    "parts of other types": (text_parts, r"price is VARCHAR here and DOUBLE in .*0\.parquet"),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_tables_that_cannot_be_used(tmp_path: Path, name: str) -> None:
    refuse(TABLES[name][0], tmp_path, TABLES[name][1])
