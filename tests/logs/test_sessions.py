"""Sessions end where they must, and splits begin at the row that they name."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import START
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate


def write_log(folder: Path, times: np.ndarray, **columns: object) -> Path:
    log = pd.DataFrame({"user_id": 1, "item_id": 1, "timestamp": START + times} | columns)
    log["reward"] = np.arange(len(log)) % 2
    log.to_parquet(folder / "log.parquet")
    return folder / "log.parquet"


@pytest.mark.parametrize(("pause", "sessions"), [(60_000, 1), (60_001, 2)])
def test_only_a_longer_pause_ends_a_session(tmp_path: Path, pause: int, sessions: int) -> None:
    path = write_log(tmp_path, np.array([0, pause]))
    options = PrepareOptions(gap_minutes=1, split=(1.0, 0.0, 0.0))
    assert validate([path], LogMapping(), options)["sessions"] == sessions
    # A session that ended within the gap before the end of the log may have gone on.
    path = write_log(tmp_path, np.array([0, pause]), user_id=[1, 2])
    assert validate([path], LogMapping(), options)["sessions_censored"] == 3 - sessions
    # Rows before the one that precedes them in time are out of order.
    path = write_log(tmp_path, np.array([3, 1, 2, 7, 7, 5]), user_id=[1, 1, 1, 2, 3, 3])
    assert validate([path], LogMapping(), options)["unsorted_rows"] == 2


@pytest.mark.parametrize("span", [1, 50, 10**7, 10**10])
@pytest.mark.parametrize("shares", [(0.8, 0.1, 0.1), (0.005, 0.0, 0.995), (0.5, 0.5, 0.0)])
def test_splits_begin_at_a_place_of_the_sorted_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, span: int, shares: tuple[float, ...]
) -> None:
    monkeypatch.setattr("ucfrec.logs.typed.BATCH_ROWS", 17)
    times = np.random.default_rng(0).integers(span, size=200)
    times[0] = -1  # so that some row is before the first boundary
    path = write_log(tmp_path, times, user_id=np.arange(200) % 9, item_id=range(200))
    report = validate([path], LogMapping(), PrepareOptions(split=shares))
    ordered = [*np.sort(times), times.max() + 1]
    places = round(200 * shares[0]), round(200 * (shares[0] + shares[1]))
    assert report["split_times_ms"] == [START + ordered[place] for place in places]


def test_a_request_is_one_decision_whatever_the_order_of_its_rows(tmp_path: Path) -> None:
    """Over a pause, with another session_id, without a position; rows without one stand alone."""
    times = np.repeat([0, 1, 2, 3, 4], [1, 1, 1, 3, 3]) * 1_800_000
    times[[5, 6, 8]] += np.array([1_800_001, 2, 3])  # b begins before, and goes on after
    log = pd.read_parquet(write_log(tmp_path, times, item_id=range(9), session_id=range(9)))
    log["request_id"] = ["a"] * 3 + [None] * 3 + ["b"] * 3
    log["position"] = [0, 1, 2, None, None, None, 2, 1, None]
    log = pd.concat([log, log.assign(position=9 - log.position, excludes_seen=True)])
    options, stores = PrepareOptions(split=(1.0, 0.0, 0.0), session_by="gap", gap_minutes=20), []
    for seed in range(4):
        log.sample(frac=1, random_state=seed).to_parquet(tmp_path / "log.parquet")
        prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / f"{seed}", options)
        stores.append(EpisodeStore.open(tmp_path / f"{seed}"))
        assert stores[seed].column("place").tolist() == [0, 1, 2, 0, 0, 0, 1, 2, 0]
        assert stores[seed].column("item").tolist()[5:] == [7, 6, 8, 5]
        assert (np.diff(stores[seed].column("timestamp")) >= 0).all()
        assert stores[seed].record.fingerprint == stores[0].record.fingerprint


@pytest.mark.parametrize(("pause", "listed"), [(0, 1), (5_000, 1), (10**8, 1), (10**8, 0)])
def test_a_request_id_that_comes_again_is_another_decision(
    tmp_path: Path, pause: int, listed: int
) -> None:
    rows = {"request_id": "a", "position": [1, 2, 3] * 2 if listed else None}
    path = write_log(tmp_path, np.repeat([0, pause], 3), item_id=range(6), **rows)
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        prepare([path], LogMapping(), tmp_path / "store", PrepareOptions(split=(1.0, 0.0, 0.0)))
    store = EpisodeStore.open(tmp_path / "store")
    assert store.column("place").tolist() == [0, 1, 2] * 2
    assert store.lengths.tolist() == ([3, 3] if pause == 10**8 else [6])
    assert any("3 rows repeat" in str(note.message) for note in notes) == (pause < 10**8)


@pytest.mark.parametrize("skew", [-50, 0, 50])
def test_clocks_that_differ_do_not_split_sessions(tmp_path: Path, skew: int) -> None:
    minutes = np.array([0, 5, 10, 11, 16]) * 60_000 + START  # a session begins after 11
    # The third row is of a client that sends its latest row alone.
    began = np.array([0, 0, minutes[1] - minutes[0], 0, 0]) + minutes[[0, 0, 0, 3, 3]]
    began += np.array([0, skew, skew, 0, skew])
    parts = {"user_id": np.repeat(np.arange(20), 5), "item_id": np.arange(100) % 7}
    log = pd.DataFrame({**parts, "reward": np.arange(100) % 2, "timestamp": np.tile(minutes, 20)})
    log.assign(session_began=np.tile(began, 20)).to_parquet(tmp_path / "log.parquet")
    options = PrepareOptions(session_by="gap", reward="reward", split=(1.0, 0.0, 0.0))
    prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / "store", options)
    assert EpisodeStore.open(tmp_path / "store").lengths.tolist() == [3, 2] * 20


@pytest.mark.filterwarnings("error:.*as bots have")  # only beside the single rows held out
@pytest.mark.parametrize("last", [1, 3])
def test_the_last_rows_of_every_user_test(tmp_path: Path, last: int) -> None:
    rng = np.random.default_rng(0)
    users = np.concatenate([rng.integers(40, size=300), np.zeros(200, dtype=int)])
    parts = {"user_id": users, "item_id": rng.integers(9, size=500)}
    parts["session_id"] = rng.integers(3, size=500)  # sessions overlap
    times = START + 60_000 * rng.permutation(500)
    log = pd.DataFrame({**parts, "timestamp": times, "reward": rng.random(500)})
    log.to_parquet(tmp_path / "log.parquet")
    split = parse_split(f"leave-last-{'out' if last == 1 else last}")
    options = PrepareOptions(session_by="user" if last == 1 else "session_id", split=split)
    prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / "store", options)
    found = EpisodeStore.open(tmp_path / "store").to_frame().sort_values(["user_id", "timestamp"])
    of_user = log.sort_values(["user_id", "timestamp"]).groupby("user_id").item_id
    ahead, rows = of_user.cumcount(ascending=False), of_user.transform("size")
    split = np.where(ahead < last, "test", np.where(ahead < 2 * last, "validation", "train"))
    np.testing.assert_array_equal(found.split, np.where(rows > 2 * last, split, "train"))
    for wrong in ("leave-last-0", "leave-last-some", "leave-last-1.5", f"leave-last-{'9' * 400}"):
        with pytest.raises(InputError, match="split"):
            PrepareOptions(split=parse_split(wrong))
