"""A grown store has all rows of its logs once, with the old numbers, and reads no old log."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.later import NEW, later_log, later_mapping
from tests.support.logs import store_of, write
from tests.support.tagged import ITEMS, USERS, tagged_log, tagged_mapping, tagged_store
from ucfrec import schema
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.append import AppendOptions, append_logs, find_end


def rows_of(path: Path) -> list[tuple[int | str, int | str, int, float]]:
    """All rows of a store, with the identifiers of its users and items, sorted."""
    return rows_in(EpisodeStore.open(path).to_frame())


def rows_in(*logs: pd.DataFrame) -> list[tuple[int | str, int | str, int, float]]:
    frame = pd.concat(logs)[["user_id", "item_id", "timestamp", "reward"]]
    return sorted(frame.itertuples(index=False, name=None))


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `store` and the one that was grown from it, `grown`."""
    folder = tmp_path_factory.mktemp("grown")
    tagged_store(folder)
    (folder / "log.parquet").unlink()  # no old log is read again
    later_log().to_parquet(folder / "later.parquet")
    mapping = later_mapping(folder)
    append_logs(folder / "store", [folder / "later.parquet"], folder / "grown", mapping)
    return folder


def test_every_row_is_there_once_and_old_numbers_stay(grown: Path) -> None:
    assert rows_of(grown / "grown") == rows_in(tagged_log(), later_log())
    for name, new in (("users", USERS + NEW), ("items", ITEMS + NEW)):
        old, all_ids = (
            pq.read_table(grown / store / f"{name}.parquet")[f"{name[:-1]}_id"].to_pylist()
            for store in ("store", "grown")
        )
        assert all_ids[: len(old)] == old
        assert len(all_ids) == len(set(all_ids)) == new
    assert main(["verify", str(grown / "grown"), str(grown / "store")]) == 0


def test_old_rows_train_and_the_newest_are_held_out(grown: Path) -> None:
    store = EpisodeStore.open(grown / "grown")
    ends = [
        store.split(name).step_values(schema.TIMESTAMP, *store.split(name).all_steps())
        for name in schema.SPLITS
    ]
    assert ends[0].max() < ends[1].min() <= ends[1].max() < ends[2].min()
    assert len(ends[1]) == len(ends[2]) == 60
    counts = store.split("train").item_counts()
    assert pq.read_table(grown / "grown" / "items.parquet")["train_count"].to_pylist() == [*counts]


def test_old_shards_are_shared_and_old_vectors_stay(grown: Path) -> None:
    old, new = (EpisodeStore.open(grown / name) for name in ("store", "grown"))
    shard = "shard-00000/item.npy"
    assert (grown / "store" / shard).samefile(grown / "grown" / shard)
    vectors = new.item_states.embeddings.numpy()
    np.testing.assert_array_equal(vectors[:ITEMS], old.item_states.embeddings.numpy())
    # New items have the tags of items 0 to 5, which the tables call by other numbers.
    tags = new.item_states.tags.numpy()
    for item in range(ITEMS, ITEMS + NEW):
        assert {*tags[item]} == {*tags[item - 12]}
        distance = np.linalg.norm(vectors[:ITEMS] - vectors[item], axis=1)
        assert item % 4 == distance.argmin() % 4


@pytest.mark.filterwarnings("error::ucfrec.errors.InputNote")
def test_the_same_logs_count_once(grown: Path, tmp_path: Path) -> None:
    mapping, logs = later_mapping(grown), [grown / "later.parquet"]
    again = append_logs(grown / "store", logs, grown / "grown", mapping)
    assert again["new_items"] == NEW
    later_log(seed=2).to_parquet(tmp_path / "next.parquet")
    both = [*logs, tmp_path / "next.parquet"]
    report = append_logs(grown / "grown", both, tmp_path / "third", mapping)
    assert report["dropped"]["clock_out_of_range"] == 300
    assert rows_of(tmp_path / "third") == rows_in(tagged_log(), later_log(), later_log(seed=2))
    with pytest.raises(InputError, match="store of other logs"):
        append_logs(grown / "store", both, grown / "grown", mapping)
    other = "grown is a store of other feature tables in the mapping and of another window; give"
    with pytest.raises(InputError, match=other):
        append_logs(grown / "store", logs, grown / "grown", None, AppendOptions(window_ms=9))
    with pytest.raises(InputError, match="is a store that no update made"):
        append_logs(grown / "store", logs, grown / "store", mapping)


@settings(max_examples=8)
@given(hours=st.integers(3, 60))
def test_a_window_forgets_the_sessions_that_ended_before(
    grown: Path, tmp_path_factory: pytest.TempPathFactory, hours: int
) -> None:
    out = tmp_path_factory.mktemp("window") / "store"
    window = AppendOptions(window_ms=hours * 3_600_000)
    logs, mapping = [grown / "later.parquet"], later_mapping(grown)
    report = append_logs(grown / "store", logs, out, mapping, window)
    found, every = rows_of(out), rows_in(tagged_log(), later_log())
    cut = later_log().timestamp.max() - window.window_ms if window.window_ms else 0
    assert {row for row in every if row[2] >= cut} <= {*found} <= {*every}
    assert len(found) == len(every) - report["expired_steps"]
    store = EpisodeStore.open(out)
    # Sessions stay whole: the latest step of each old one is inside.
    places = store.all_steps()
    times = store.step_values(schema.TIMESTAMP, *places)
    assert all(times[places[0] == e].max() >= cut for e in range(store.n_episodes))
    counts = store.split("train").item_counts()
    assert pq.read_table(out / "items.parquet")["train_count"].to_pylist() == [*counts]


@pytest.mark.parametrize("text", [False, True])
def test_a_fast_clock_neither_loses_rows_nor_counts_them_twice(tmp_path: Path, text: bool) -> None:
    hour, old, new = 3_600_000, tagged_log(), later_log(seed=2)
    logs = [old, new] = [old, new.assign(timestamp=new.timestamp - 20 * hour)]
    old.loc[899, "timestamp"] += 60 * hour
    new.loc[299, "timestamp"] += 50 * hour
    if text:
        logs = [log.astype({"user_id": str, "item_id": str}) for log in logs]
    store_of(logs[0], tmp_path, None, reward="reward", session_by="gap", gap_minutes=120)
    files = [write(log, tmp_path / f"{name}.parquet") for name, log in zip("ab", logs, strict=True)]
    told = rf"store: 1 row\(s\) are after 2023-.*{old.timestamp[899]}.*300 new rows between"
    window = AppendOptions(window_ms=5 * hour)
    with pytest.warns(InputNote, match=told), pytest.warns(InputNote, match="the window ends"):
        report = append_logs(tmp_path / "store", files, tmp_path / "recent", None, window)
    cut = new.timestamp[:299].max() - 5 * hour
    recent = [row for row in rows_in(*logs) if row[2] >= cut]
    assert report["steps"] == 300
    assert {*recent} <= {*rows_of(tmp_path / "recent")}
    append_logs(tmp_path / "store", files, tmp_path / "grown")
    assert rows_of(tmp_path / "grown") == rows_in(*logs)
    with pytest.raises(InputError, match="all 1,200 rows are not newer than"):
        append_logs(tmp_path / "grown", files, tmp_path / "again")


def test_the_end_of_a_log_is_its_last_row_unless_the_rows_before_are_dense() -> None:
    every_30_s, hour = np.arange(2880) * 30_000, 3_600_000
    assert [find_end(every_30_s[:n]) for n in (1, 2, 9, 2880)] == [0, 30_000, 240_000, 86_370_000]
    evening = np.append(every_30_s, every_30_s[-1] + np.arange(1, 20) * 300_000)  # a tenth as dense
    assert find_end(evening) == evening.max()
    for fast in ([1], [20], [1, 20], [2] * 5, np.linspace(3, 20, 100)):
        late = every_30_s[: len(fast)] + 24 * hour + np.round(np.multiply(fast, hour)).astype(int)
        assert find_end(np.append(late, every_30_s)) == every_30_s[-1]


def test_propensities_may_begin_with_the_new_logs(grown: Path, tmp_path: Path) -> None:
    log = later_log(propensity=True)
    log.assign(is_random=np.arange(len(log)) % 3 == 0).to_parquet(tmp_path / "later.parquet")
    append_logs(grown / "store", [tmp_path / "later.parquet"], tmp_path / "store")
    store = EpisodeStore.open(tmp_path / "store")
    known = ~np.isnan(store.step_values(schema.PROPENSITY, *store.all_steps()))
    assert known.sum() == 300
    assert store.step_values(schema.IS_RANDOM, *store.all_steps()).sum() == 100


def test_sessions_of_the_lengths_that_prepare_left_out_stay_out(tmp_path: Path) -> None:
    given = {"reward": "reward", "session_by": "gap", "gap_minutes": 20}
    lengths = {"min_steps": 2, "max_session": 7}
    store_of(tagged_log(), tmp_path, None, **given, **lengths)
    later_log().to_parquet(tmp_path / "later.parquet")
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)  # without features, new ids need none
        report = append_logs(tmp_path / "store", [tmp_path / "later.parquet"], tmp_path / "grown")
    assert report["dropped"]["short_episode"] > 0 < report["dropped"]["long_session"]
    steps = EpisodeStore.open(tmp_path / "grown").lengths
    assert (steps.min(), steps.max()) == (2, 7)


def test_logs_that_are_all_old_or_too_short_are_refused(grown: Path, tmp_path: Path) -> None:
    out, log = tmp_path / "again", later_log()
    told = r"all 300 rows are not newer than .*grown, whose last row is of 2023-.*UTC"
    with pytest.raises(InputError, match=told):
        append_logs(grown / "grown", [grown / "later.parquet"], out)
    seconds = log.assign(timestamp=log.timestamp // 1000)
    seconds.to_parquet(tmp_path / "seconds.parquet")
    with pytest.raises(InputError, match="is the time in milliseconds"):
        append_logs(grown / "grown", [tmp_path / "seconds.parquet"], out)
    log.head(1).to_parquet(tmp_path / "one.parquet")
    with pytest.raises(InputError, match=r"\(1, in 1 session\(s\)\) leave no validation rows"):
        append_logs(grown / "store", [tmp_path / "one.parquet"], out)
    assert not out.exists()


def test_a_damaged_store_does_not_grow(grown: Path, tmp_path: Path) -> None:
    file = shutil.copytree(grown / "store", tmp_path / "store") / "shard-00000" / "offsets.npy"
    file.write_bytes(file.read_bytes()[:-1] + b"\xff")
    with pytest.raises(InputError, match=r"store/shard-00000/offsets\.npy has another content"):
        append_logs(tmp_path / "store", [grown / "later.parquet"], tmp_path / "grown")


@pytest.mark.parametrize("name", ["user_id", "item_id"])
def test_logs_of_only_new_ids_are_noted(grown: Path, tmp_path: Path, name: str) -> None:
    log = later_log()
    log.assign(**{name: log[name] + 10_000}).to_parquet(tmp_path / "strange.parquet")
    count = log[name].nunique()
    noted = f"{count} of {count} {name[:4]}s are not among those of .*how {name} is written"
    with pytest.warns(InputNote, match=noted):
        append_logs(grown / "store", [tmp_path / "strange.parquet"], tmp_path / "grown")


def test_new_ids_without_features_are_noted(grown: Path, tmp_path: Path) -> None:
    logs, old = [grown / "later.parquet"], tagged_mapping(tmp_path)
    items = rf"items\.parquet: {NEW} of {NEW} new items have no row; their features count as"
    users = rf"users\.parquet: {NEW} of {NEW} new users have no row"
    with pytest.warns(InputNote, match=items), pytest.warns(InputNote, match=users):
        append_logs(grown / "store", logs, tmp_path / "old", old)
    items = rf"store was prepared with item features and none .* all {NEW} new items .* --mapping"
    with pytest.warns(InputNote, match=items), pytest.warns(InputNote, match="all 6 new users"):
        append_logs(grown / "store", logs, tmp_path / "none")


@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_integers_follow_text_as_their_text(tmp_path: Path, suffix: str) -> None:
    in_text = [log.astype({"user_id": str, "item_id": str}) for log in (tagged_log(), later_log())]
    in_text[0].loc[0, "user_id"] = "guest"
    options = {"reward": "reward", "session_by": "gap", "gap_minutes": 120, "embedding_size": 6}
    store_of(in_text[0], tmp_path, tagged_mapping(tmp_path), **options)
    file = write(later_log(), tmp_path / f"later.{suffix}")
    report = append_logs(tmp_path / "store", [file], tmp_path / "grown", later_mapping(tmp_path))
    assert (report["new_users"], report["new_items"]) == (NEW, NEW)
    assert rows_of(tmp_path / "grown") == rows_in(*in_text)
