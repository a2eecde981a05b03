"""Closed connections, and columns of files as expressions compute with them."""

import gzip
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.logs import START, list_users, random_log, store_of, write
from ucfrec import Recommender
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import SCRATCH
from ucfrec.logs.engine import engine
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare, validate
from ucfrec.logs.tables import open_tables, quote

SECRET = "the content of a file that was not named"
READERS = "read_text read_blob read_csv read_json read_ndjson sniff_csv"
SWITCHES = (
    "enable_external_access allow_community_extensions autoload_known_extensions "
    "python_enable_replacements"
)
REFUSED = (
    "COPY (SELECT 1) TO '{out}'",
    "COPY (SELECT 1) TO '{out}' (FORMAT parquet, USE_TMP_FILE false)",
    "COPY (SELECT 1) TO '{work}/../escaped.csv'",
    "COPY (SELECT 1) TO '/dev/stdout'",
    "COPY (SELECT 1 AS a, 2 AS b) TO '{out}' (FORMAT csv, PARTITION_BY (a))",
    "CREATE TABLE t (x VARCHAR); COPY t FROM '{secret}'",
    "EXPORT DATABASE '{out}'",
    "IMPORT DATABASE '{folder}'",
    "ATTACH '{out}' AS x",
    "ATTACH '{secret}' AS x (READ_ONLY)",
    "ATTACH 'http://127.0.0.1:1/x.db' AS x",
    "FROM '{secret}'",
    *(f"FROM {r}('{{secret}}')" for r in READERS.split()),
    "FROM read_text('{input}/../secret.csv')",
    "FROM read_text('{work}/../secret.csv')",
    "FROM read_csv(['{input}', '{secret}'])",
    "FROM read_parquet('{folder}/*.parquet')",
    "FROM glob('{folder}/*')",
    "FROM glob('/*')",
    "FROM parquet_metadata('{folder}/other.parquet')",
    "FROM parquet_schema('{folder}/other.parquet')",
    "FROM '{folder}/link.parquet'",
    "FROM 'http://127.0.0.1:1/x.parquet'",
    "FROM read_csv('https://127.0.0.1:1/x.csv')",
    "FROM 's3://bucket/x.parquet'",
    "FROM frame",
    "SELECT getenv('HOME')",
    "INSTALL httpfs",
    "FORCE INSTALL spatial FROM community",
    "INSTALL '{out}'",
    "LOAD httpfs",
    "LOAD '{out}'",
    "FROM sqlite_scan('{secret}', 't')",
    "FROM postgres_scan('', '', '')",
    "CALL start_ui()",
    "CREATE PERSISTENT SECRET s (TYPE http, BEARER_TOKEN 'x')",
    *(f"SET {name} = true" for name in SWITCHES.split()),
    "RESET enable_external_access",
    "PRAGMA enable_external_access = true",
    "SET GLOBAL allowed_directories = ['/']",
    "SET allowed_paths = ['{secret}']",
    "SET lock_configuration = false",
    *(f"SET {d}_directory = '{{folder}}'" for d in ("extension", "home", "secret", "temp")),
    "SET memory_limit = '100GB'",
    "SET log_query_path = '{out}'",
    "SET profile_output = '{out}'",
    "PRAGMA profile_output = '{out}'",
    "PRAGMA enable_profiling = 'json'",
    "CALL enable_logging(storage = 'file', storage_path = '{out}')",
)
"""Statements that end in an error."""


@pytest.fixture
def closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[duckdb.DuckDBPyConnection]:
    """An engine with two inputs; beside them, files that are none."""
    pd.DataFrame({"x": [1, 2]}).to_parquet(tmp_path / "input.parquet")
    (tmp_path / "input.csv").write_text("x\n1\n2\n")
    pd.DataFrame({"x": [SECRET]}).to_parquet(tmp_path / "other.parquet")
    (tmp_path / "secret.csv").write_text(f"x\n{SECRET}\n")
    (tmp_path / "link.parquet").symlink_to(tmp_path / "other.parquet")
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    with engine([tmp_path / "input.parquet", tmp_path / "input.csv"], tmp_path) as connection:
        yield connection


def contents(folder: Path) -> dict[Path, bytes]:
    """All but the content of the scratch folder."""
    paths = (path for path in folder.rglob("*") if not path.parent.name.endswith(SCRATCH))
    return {path: path.read_bytes() if path.is_file() else b"" for path in paths}


@pytest.mark.parametrize("statement", REFUSED)
def test_the_environment_is_shut(
    closed: duckdb.DuckDBPyConnection, tmp_path: Path, statement: str
) -> None:
    frame = pd.DataFrame({"x": [SECRET]})
    assert len(frame) == 1
    (work,) = tmp_path.glob(f"*{SCRATCH}")
    before = contents(tmp_path)
    names = {"out": "out", "secret": "secret.csv", "input": "input.csv", "folder": "", "work": work}
    paths = {name: tmp_path / path for name, path in names.items()}
    with pytest.raises(duckdb.Error) as caught:
        closed.execute(statement.format(**paths)).fetchall()
    assert SECRET not in str(caught.value)
    assert contents(tmp_path) == before


NAMES = "[1] b* it's é {1,2} x\\y"


@pytest.mark.parametrize(
    "name", [*(f"{name}.parquet" for name in NAMES.split()), "a.csv", "[a-z]*.csv", "a.csv.gz"]
)
def test_files_of_any_name_are_read_alone(tmp_path: Path, name: str) -> None:
    frame = pd.DataFrame({"x": [1, 2]})
    for file, values in ((name, frame), ("1.parquet", frame + 5), ("bc.parquet", frame + 5)):
        path = tmp_path / file
        if file.endswith(".gz"):
            path.write_bytes(gzip.compress(values.to_csv(index=False).encode()))
        else:
            write(values, path)
    with engine([tmp_path / name], tmp_path) as connection:
        (table,) = open_tables(connection, [tmp_path / name])
        assert connection.execute(f"FROM {table.sql}").fetchall() == [(1,), (2,)]


def test_rows_spill_into_the_scratch_folder_and_vanish(tmp_path: Path) -> None:
    folder = tmp_path / "it's a folder"
    folder.mkdir()
    with engine([], folder, "60MB") as connection:
        connection.execute(
            "CREATE TABLE t AS SELECT range AS i, md5(range::TEXT) AS s FROM range(400000)"
        )
        rows = connection.execute(
            "SELECT i, row_number() OVER (PARTITION BY i % 7 ORDER BY s) FROM t "
            "ORDER BY s LIMIT 5 OFFSET 300000"
        ).fetchall()
        assert len(rows) == 5
        assert [path.is_dir() for path in sorted(folder.iterdir())] == [False, True]
    assert not list(folder.iterdir())


def test_hostile_column_names_stay_names(tmp_path: Path) -> None:
    """Names and types of columns come from files, and into SQL."""
    hostile = """x" INTEGER); COPY (SELECT 1) TO 'out'; --"""
    log = random_log(40)
    log.assign(**{hostile: [{hostile: 1.0}] * 40}).to_parquet(tmp_path / "log.parquet")
    quoted = '"' + hostile.replace('"', '""') + '"'
    for reward in (f"{quoted}.{quoted} * reward", f"{quoted}[{quote(hostile)}] + reward"):
        options = PrepareOptions(reward=reward)
        assert validate([tmp_path / "log.parquet"], LogMapping(), options)["steps"] == 40
    assert [path.name for path in tmp_path.iterdir()] == ["log.parquet"]


def test_every_connection_is_closed_to_the_environment() -> None:
    """`duckdb.connect`, and its default connection, are used in one file."""
    root = Path(sys.modules["ucfrec"].__path__[0]).parent
    opens = re.compile(r"duckdb\.(connect|sql|query|execute|read_|from_|default_connection|cursor)")
    packages = ("ucfrec", "datasets", "simulators", "control")
    files = (path for package in packages for path in (root / package).rglob("*.py"))
    found = {path.name for path in files if opens.search(path.read_text(encoding="utf-8"))}
    assert found == {"engine.py"}
    assert quote("it's") == "'it''s'"


OVERFLOWING = {
    "a * b": [10_000.0, 30.0],
    "a * a * a * a * a": [1e10, 243.0],
    "a - 2 * b": [-100.0, -17.0],
    "least(a + b, 250)": [200.0, 13.0],
}


@pytest.mark.parametrize(
    ("kind", "reward"),
    [
        *(("int8", reward) for reward in OVERFLOWING),
        *((kind, "a * a * a * a * a") for kind in ("int32", "uint64")),
        *((kind, "a - 2 * b") for kind in ("uint8", "uint32")),
    ],
)
def test_integers_of_any_width_do_not_overflow(kind: str, reward: str, tmp_path: Path) -> None:
    log = random_log(2, users=1).assign(a=np.array([100, 3], kind), b=np.array([100, 10], kind))
    log.to_parquet(tmp_path / "log.parquet")
    (batch,) = read_histories([tmp_path / "log.parquet"], LogMapping(), reward, last=2)
    (of_frame,) = frame_histories(log, LogMapping(), reward, last=2)
    assert batch.rewards.tolist() == of_frame.rewards.tolist() == OVERFLOWING[reward]


@pytest.mark.parametrize(
    ("reward", "wanted"),
    [
        ("x", [0.25, 1.0]),
        ("x > 0.5", [0.0, 1.0]),
        ("coalesce(x, 7)", [0.25, 1.0, 7.0, 7.0]),
        ("clicks + x", [0.25, 2.0]),
        # Extremes and number of missing values in the file show nothing of NaN.
        ("y > 0.5", [1.0, 1.0, 1.0]),
        ("if(y < 5, 1, 2)", [1.0, 1.0, 2.0, 1.0]),
        ("if(isnan(y), 7, y)", [0.75, 1.0, 7.0, 2.0]),
        ("clicks / views > 0.1", [1.0, 0.0, 1.0]),
        ("coalesce(clicks / views, 7)", [7.0, 0.5, 0.0, 1.5]),
        ("ln(views) > 0.5", [1.0, 0.0, 1.0]),
        ("least(ln(views), 5)", [0.6931472, 0.0, 0.6931472]),
        ("greatest(clicks // views, 1, 2)", [2.0, 2.0, 2.0]),
        ("least(coalesce(nullif(views, 0), 3), 2)", [2.0, 2.0, 1.0, 2.0]),
    ],
)
def test_the_undefined_exceeds_nothing(reward: str, wanted: list[float], tmp_path: Path) -> None:
    columns = {
        "x": pa.array([0.25, 1.0, float("nan"), None]),
        "y": pa.array([0.75, 1.0, float("nan"), 2.0], pa.float32()),
        "clicks": [0, 1, 0, 3],
        "views": [0, 2, 1, 2],
        **{name: random_log(4, users=1)[name] for name in ("user_id", "item_id", "timestamp")},
    }
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    (batch,) = read_histories([tmp_path / "log.parquet"], LogMapping(), reward, last=4)
    assert batch.rewards.tolist() == pytest.approx(wanted)


def test_only_true_and_one_are_random_choices(tmp_path: Path) -> None:
    given = [1.0, 0.0, float("nan"), None, float("inf"), -1.0, 2.0, 1.0]
    log = pa.Table.from_pandas(random_log(8, users=1).assign(reward=range(8), propensity=0.5))
    pq.write_table(log.append_column("is_random", pa.array(given)), tmp_path / "log.parquet")
    for place, text in enumerate(("is_random", "ln(is_random) = 0", "1 / is_random > 0.5")):
        out, mapping = tmp_path / f"store{place}", LogMapping({"is_random": text})
        prepare([tmp_path / "log.parquet"], mapping, out, PrepareOptions(embedding_size=2))
        store = EpisodeStore.open(out)
        found = store.step_values("is_random", *store.all_steps())
        assert found.tolist() == [1, 0, 0, 0, 0, 0, 0, 1]


def test_undefined_numbers_of_features_are_missing(tmp_path: Path) -> None:
    items = tmp_path / "items.parquet"
    pd.DataFrame({"item_id": range(4), "price": [-1, 0, 1, 9]}).to_parquet(items)
    mapping = LogMapping(item_features=(FeatureTable((items,), "item_id", ("ln(price)",)),))
    states = store_of(random_log(items=4), tmp_path, mapping, embedding_size=2).item_states
    assert bool(states.embeddings.isfinite().all())


def csv_of(folder: Path, column: str, first: str, later: str) -> Path:
    """A CSV log with `later` after more rows than types are inferred from."""
    rows = 25_000
    lines = [f"{column},user_id,item_id,timestamp"]
    values = [first] * (rows - 1) + [later]
    lines += [f"{value},{n % 7},{n % 5},{START + n}" for n, value in enumerate(values)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return folder / "log.csv"


@pytest.mark.parametrize(
    ("first", "later", "reward", "wanted"),
    [
        ("1", "0.25", "x", 0.25),
        ("7", "007", "len(x)", 3.0),
        ("2024-01-01", "2024-01-01 12:30:00", "hour(x::TIMESTAMP)", 12.0),
        ("2024-01-01 00:00:00", "2024-01-01 12:30:00+02:00", "hour(x::TIMESTAMP)", 10.0),
    ],
)
def test_later_rows_of_csv_are_not_cut(
    tmp_path: Path, first: str, later: str, reward: str, wanted: float
) -> None:
    path = csv_of(tmp_path, "x", first, later)
    users = list_users(read_histories([path], LogMapping(), reward, last=1))
    latest = max(users, key=lambda user: int(user["timestamps"][0]))
    assert latest["rewards"] == [wanted]


@pytest.mark.parametrize("later", ["u7", "9" * 100_000])
def test_later_rows_of_csv_of_another_kind_are_named(tmp_path: Path, later: str) -> None:
    path = csv_of(tmp_path, "visit", "1", later)
    with pytest.raises(InputError, match=r"log.csv, line 25001: column visit: .*Parquet") as caught:
        list(read_histories([path], LogMapping(), "visit", last=1))
    assert len(str(caught.value)) < 700
    # What names a session is text, whatever the first rows look like.
    mapping = LogMapping({"session_id": "visit"})
    assert list(read_histories([path], mapping, "1", last=1, session_by="session_id"))


MAPPING = """
reward = "least(stars, 5) >= 4"
time_format = "%d/%m/%Y %H:%M:%S"
where = "agent <> 'bot'"
[columns]
user_id = "uid"
item_id = "concat('i', sku)"
timestamp = "at"
propensity = "shown_with"
"""
TRAIN = ["--set", "train.steps=60", "--set", "train.validate_every=30", "--set", "policy.dim=8"]
TRAIN += ["--set", "policy.context=4", "--set", "rule.choose=false", "--set", "augment.copies=0"]


def shop(rows: int = 1500, start: str = "2024-02-03", seed: int = 0) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    frame = pd.DataFrame({"uid": rng.integers(50, size=rows), "sku": rng.integers(12, size=rows)})
    times = pd.Timestamp(start) + pd.to_timedelta(np.arange(rows) * 60, unit="s")
    frame["at"] = times.strftime("%d/%m/%Y %H:%M:%S")
    frame["stars"] = rng.integers(1, 7, size=rows)
    frame["shown_with"] = 1 / 12
    return frame.assign(agent=np.where(frame.uid == 7, "bot", "person"))


def plain(frame: pd.DataFrame) -> pd.DataFrame:
    """The same log with the names of the schema."""
    kept = frame[frame.agent != "bot"]
    times = pd.to_datetime(kept["at"], format="%d/%m/%Y %H:%M:%S")
    columns = {"user_id": kept.uid, "item_id": "i" + kept.sku.astype(str), "timestamp": times}
    rewards = (kept.stars.clip(upper=5) >= 4).astype(float)
    frame = pd.DataFrame({**columns, "propensity": 1 / 12, "reward": rewards})
    return frame.reset_index(drop=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("remembered")
    (folder / "shop.toml").write_text(MAPPING)
    shop().to_parquet(folder / "log.parquet")
    late = shop(400, "2024-02-10", 1)
    late.to_parquet(folder / "late.parquet")
    late.to_csv(folder / "late.csv", index=False)
    plain(late).to_parquet(folder / "plain.parquet")
    times = {"timestamp": plain(late).timestamp.astype("datetime64[ms]").astype("int64")}
    shown = {"position": 1, "run": "r", "rule": "d", "uid": 0, "agent": "person"}
    plain(late).assign(**times, **shown).to_parquet(folder / "joined.parquet")
    paths = [str(folder / name) for name in ("log.parquet", "store", "run", "shop.toml")]
    assert main(["prepare", paths[0], "--mapping", paths[3], "--out", paths[1]]) == 0
    assert main(["train", paths[1], "--policy", "dt", "--out", paths[2], *TRAIN]) == 0
    return folder


def scored(folder: Path, log: str, *more: str) -> pd.DataFrame:
    out = folder / f"{log}-{len(more)}.parquet"
    assert main(["score", str(folder / "run"), str(folder / log), "--out", str(out), *more]) == 0
    return pd.read_parquet(out)


@pytest.mark.parametrize("log", ["late.csv", "plain.parquet"])
def test_a_later_log_is_read_as_the_first_whatever_its_names(folder: Path, log: str) -> None:
    """ISO times, plain names and a plain reward stand for what the run remembers."""
    expected = scored(folder, "late.parquet", "--mapping", str(folder / "shop.toml"))
    assert 0 < len(expected) < 400
    pd.testing.assert_frame_equal(scored(folder, log), expected)


def test_a_log_of_join_has_its_own_names_unless_a_column_is_named(folder: Path) -> None:
    expected, mapping = scored(folder, "plain.parquet"), ["--mapping", str(folder / "shop.toml")]
    for more in ([], mapping, [*mapping, "--column", "timestamp=timestamp + position - 1"]):
        pd.testing.assert_frame_equal(scored(folder, "joined.parquet", *more), expected)
    late = pd.read_parquet(folder / "late.parquet").assign(other=lambda frame: frame.uid + 1000)
    late.to_parquet(folder / "other.parquet")
    assert scored(folder, "other.parquet").user_id.max() < 1000
    found = scored(folder, "other.parquet", "--column", "user_id=other", "--where", "1 = 1")
    assert found.user_id.min() >= 1000 > found.user_id.max() - 1000 > 6


def test_a_log_with_neither_column_is_refused_with_both_names(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = pd.read_parquet(folder / "late.parquet").rename(columns={"uid": "who"})
    late.to_parquet(folder / "who.parquet")
    arguments = [str(folder / name) for name in ("run", "who.parquet", "no.parquet")]
    assert main(["score", *arguments[:2], "--out", arguments[2]]) == 2
    assert re.search("has neither 'uid'.* nor a column 'user_id'", capsys.readouterr().err)
    with pytest.raises(InputError, match=r"neither 'uid'.*nor a column 'user_id'") as error:
        Recommender.load(folder / "run").recommend(late)
    assert str(error.value).startswith("histories ")
    assert "--" not in str(error.value)


def test_frames_are_read_as_the_training_log(folder: Path) -> None:
    policy, late = Recommender.load(folder / "run"), pd.read_parquet(folder / "late.parquet")
    found = policy.recommend(late, k=3)
    pd.testing.assert_frame_equal(found, policy.recommend(plain(late), k=3))
    columns = {"user_id": "cast(uid as varchar)"}
    as_text = policy.recommend(late, k=3, mapping=LogMapping(columns))
    assert set(as_text.user_id) == set(found.user_id.astype(str))


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        (random_log().rename(columns={"user_id": "who"}), "mapping=LogMapping({'user_id': ...})"),
        (random_log().assign(user_id=0.5), "'(user_id)::BIGINT'"),
        (random_log().assign(timestamp=True), "use milliseconds"),
        (random_log().assign(reward=np.nan), "reward is missing"),
    ],
)
def test_errors_of_frames_name_the_frame(frame: pd.DataFrame, said: str) -> None:
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        with pytest.raises(InputError) as error:
            Recommender("popular").fit(frame)
    for text in (str(error.value), *(str(each.message) for each in noted)):
        assert text.startswith("data"), text
        assert ".parquet" not in text
        assert "--" not in text
    assert said in str(error.value)


def test_scratch_folders_may_have_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("~y", "a?b", "d\\e", "c%2F[1]"):
        with engine([], Path(name)) as connection:
            connection.execute("CREATE TABLE t AS SELECT 1")
