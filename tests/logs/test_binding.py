"""Columns of files as expressions compute with them: no overflow, nothing undefined taken for a
value."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare

START = 1_700_000_000_000


def rewards_of(columns: dict[str, object], reward: str, folder: Path) -> list[float]:
    """Rewards of rows in order, undefined ones excluded; checks that a frame gives the same."""
    frame = pd.DataFrame(columns)
    frame = frame.assign(user_id=1, item_id=2, timestamp=START + np.arange(len(frame)))
    frame.to_parquet(folder / "log.parquet")
    (batch,) = read_histories([folder / "log.parquet"], LogMapping(), reward, last=len(frame))
    found: list[float] = batch["rewards"][0].as_py()
    if len(found) == len(frame):
        (batch,) = frame_histories(frame, LogMapping(), reward, last=len(frame))
        assert batch["rewards"][0].as_py() == found
    return found


NARROW = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


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
        *((kind, "a * a * a * a * a") for kind in NARROW[1:]),
        *((kind, "a - 2 * b") for kind in NARROW if kind.startswith("u")),
    ],
)
def test_integers_of_any_width_do_not_overflow(kind: str, reward: str, tmp_path: Path) -> None:
    columns = {"a": np.array([100, 3], dtype=kind), "b": np.array([100, 10], dtype=kind)}
    assert rewards_of(columns, reward, tmp_path) == OVERFLOWING[reward]


def test_lists_of_narrow_integers_do_not_overflow(tmp_path: Path) -> None:
    counts = [np.array([100, 100], dtype="int8"), np.array([3, 2], dtype="int8")]
    assert rewards_of({"n": counts}, "n[1] * n[2]", tmp_path) == [10_000.0, 6.0]


def test_narrow_seconds_are_times(tmp_path: Path) -> None:
    frame = pd.DataFrame({"user_id": 1, "item_id": [2, 3], "reward": [0.0, 1.0]})
    frame["seconds"] = np.array([START // 1000] * 2, dtype="int32")
    frame.to_parquet(tmp_path / "log.parquet")
    mapping = LogMapping({"timestamp": "seconds * 1000"})
    (batch,) = read_histories([tmp_path / "log.parquet"], mapping, "reward", last=2)
    assert batch["timestamps"][0].as_py() == [START, START]


@pytest.mark.parametrize(
    ("reward", "wanted"),
    [
        ("x", [0.25, 1.0]),
        ("x > 0.5", [0.0, 1.0]),
        ("NOT x > 0.5", [1.0, 0.0]),
        ("x BETWEEN 0.5 AND 100", [0.0, 1.0]),
        ("if(x > 0.5, 2, 1)", [1.0, 2.0, 1.0, 1.0]),
        ("coalesce(x, 7)", [0.25, 1.0, 7.0, 7.0]),
        ("if(isnan(x), 7, x)", [0.25, 1.0, 7.0, 7.0]),
        ("clicks + x", [0.25, 2.0]),
        # Extremes and number of missing values in the file show nothing of NaN.
        ("y > 0.5", [1.0, 1.0, 1.0]),
        ("y < 5", [1.0, 1.0, 1.0]),
        ("if(y < 5, 1, 2)", [1.0, 1.0, 2.0, 1.0]),
        ("coalesce(y, 7)", [0.75, 1.0, 7.0, 2.0]),
        ("if(isnan(y), 7, y)", [0.75, 1.0, 7.0, 2.0]),
        ("clicks / views > 0.1", [1.0, 0.0, 1.0]),
        ("coalesce(clicks / views, 7)", [7.0, 0.5, 0.0, 1.5]),
        ("ln(views)", [0.6931472, 0.0, 0.6931472]),
        ("ln(views) > 0.5", [1.0, 0.0, 1.0]),
        ("ln(views) + ln(views)", [1.3862944, 0.0, 1.3862944]),
        ("least(ln(views), 5)", [0.6931472, 0.0, 0.6931472]),
        ("greatest(sqrt(clicks - 1), 0)", [0.0, 1.4142135]),
    ],
)
def test_what_is_undefined_is_above_no_threshold(
    reward: str, wanted: list[float], tmp_path: Path
) -> None:
    columns = {
        "x": pa.array([0.25, 1.0, float("nan"), None]),
        "y": pa.array([0.75, 1.0, float("nan"), 2.0], pa.float32()),
        "clicks": pa.array([0, 1, 0, 3]),
        "views": pa.array([0, 2, 1, 2]),
        "user_id": pa.array([1] * 4),
        "item_id": pa.array([2] * 4),
        "timestamp": pa.array(START + np.arange(4)),
    }
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    (batch,) = read_histories([tmp_path / "log.parquet"], LogMapping(), reward, last=4)
    assert batch["rewards"][0].as_py() == pytest.approx(wanted)


def test_only_true_and_one_are_random_choices(tmp_path: Path) -> None:
    given = [1.0, 0.0, float("nan"), None, float("inf"), -1.0, 2.0, 1.0]
    n = len(given)
    columns = {
        "user_id": pa.array([1] * n),
        "item_id": pa.array(range(n)),
        "timestamp": pa.array(START + np.arange(n)),
        "reward": pa.array(range(n)),
        "propensity": pa.array([0.5] * n),
        "is_random": pa.array(given),
    }
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    for mapping, wanted in (
        (LogMapping(), [1, 0, 0, 0, 0, 0, 0, 1]),
        (LogMapping({"is_random": "ln(is_random) = 0"}), [1, 0, 0, 0, 0, 0, 0, 1]),
        (LogMapping({"is_random": "1 / is_random > 0.5"}), [1, 0, 0, 0, 0, 0, 0, 1]),
    ):
        out = tmp_path / f"store{len(list(tmp_path.iterdir()))}"
        prepare([tmp_path / "log.parquet"], mapping, out, PrepareOptions(embedding_size=2))
        store = EpisodeStore.open(out)
        assert store.step_values("is_random", *store.all_steps()).tolist() == wanted


def test_undefined_numbers_of_features_are_missing(tmp_path: Path) -> None:
    frame = pd.DataFrame({"user_id": [1, 2, 3, 4], "item_id": [0, 1, 2, 3], "reward": [0, 1, 2, 3]})
    frame.assign(timestamp=START + frame.index).to_parquet(tmp_path / "log.parquet")
    pd.DataFrame({"item_id": [0, 1, 2, 3], "price": [-1, 0, 1, 9]}).to_parquet(
        tmp_path / "items.parquet"
    )
    table = FeatureTable((tmp_path / "items.parquet",), "item_id", ("ln(price)",))
    mapping = LogMapping(item_features=(table,))
    options = PrepareOptions(split=(1.0, 0.0, 0.0), embedding_size=2)
    prepare([tmp_path / "log.parquet"], mapping, tmp_path / "store", options)
    states = EpisodeStore.open(tmp_path / "store").item_states
    assert bool(states.embeddings.isfinite().all())


def csv_of(folder: Path, column: str, first: str, later: str) -> Path:
    """A CSV log whose `column` is `first`, in more rows than types are inferred from, then
    `later`."""
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
        ("1", "25e-2", "x", 0.25),
        ("1", "2.0", "x", 2.0),
        ("2024-01-01", "2024-01-01 12:30:00", "hour(x::TIMESTAMP)", 12.0),
        ("2024-01-01 00:00:00", "2024-01-01 12:30:00+02:00", "hour(x::TIMESTAMP)", 10.0),
    ],
)
def test_later_rows_of_csv_are_not_cut_to_the_type_of_the_first(
    tmp_path: Path, first: str, later: str, reward: str, wanted: float
) -> None:
    path = csv_of(tmp_path, "x", first, later)
    users = pa.Table.from_batches(list(read_histories([path], LogMapping(), reward, last=1)))
    latest = max(users.to_pylist(), key=lambda user: int(user["timestamps"][0]))
    assert latest["rewards"] == [wanted]


@pytest.mark.parametrize("later", ["u7", "99999999999999999999", "9" * 100_000])
def test_later_rows_of_csv_of_another_kind_are_named(tmp_path: Path, later: str) -> None:
    path = csv_of(tmp_path, "visit", "1", later)
    with pytest.raises(InputError, match=r"log.csv, line 25001: column visit: .*Parquet") as caught:
        list(read_histories([path], LogMapping(), "visit", last=1))
    assert len(str(caught.value)) < 700
    # What names a session is text, whatever the first rows look like.
    mapping = LogMapping({"session_id": "visit"})
    assert list(read_histories([path], mapping, "1", last=1, session_by="session_id"))
