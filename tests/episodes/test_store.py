"""The episode store against plain Python readers of the same episodes."""

import tempfile
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.recommending.test_recommend import random_log
from tests.support.episodes import (
    LENGTHS,
    SHARDS,
    all_windows,
    are_equal,
    episode_columns,
    lengths_of,
    random_episodes,
    some_states,
    state_before,
    step_columns,
    write_store,
)
from tests.support.logs import store_of as prepared
from tests.support.short_validation import short_validation
from tests.support.tagged import tagged_log, tagged_mapping
from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes import store as store_module
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.episodes.writer import StoreWriter
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run

lengths_of_episodes = st.lists(st.integers(1, 8), min_size=1, max_size=6)


@given(lengths_of_episodes, st.booleans(), st.sampled_from(SHARDS), st.integers(0, 9))
def test_every_column_comes_back_from_disk_and_memory(
    lengths: list[int], items: bool, shard_steps: int, seed: int
) -> None:
    episodes = random_episodes(lengths, seed, items=items)
    states = some_states() if items else None
    steps, of_episodes = step_columns(episodes), episode_columns(episodes)
    memory = EpisodeStore.from_arrays(steps, lengths_of(episodes), of_episodes, states)
    with tempfile.TemporaryDirectory() as name:
        disk = write_store(Path(name) / "store", episodes, states, shard_steps=shard_steps)
        for store in (memory, disk):
            assert (store.lengths.tolist(), store.has_items) == (lengths, items)
            read = {name: store.column(name) for name in steps}
            read |= {name: store.episode_values(name) for name in of_episodes}
            for column, values in {**steps, **of_episodes}.items():
                dtype = (schema.STEP_DTYPES | schema.EPISODE_DTYPES)[column]
                assert read[column].dtype == np.dtype(dtype)
                assert np.array_equal(read[column], values.astype(dtype))
        for a, b in ((memory, disk), (memory.split("train"), disk.split("train"))):
            assert are_equal(all_windows(a, 3), all_windows(b, 3))
            assert np.array_equal(a.returns, b.returns)


@given(lengths_of_episodes, st.integers(1, 20), st.lists(st.integers(0, 48), max_size=5))
def test_neither_shards_nor_the_size_of_appends_show(
    lengths: list[int], shard_steps: int, cuts: list[int]
) -> None:
    episodes = random_episodes(lengths)
    steps, of_episodes = step_columns(episodes), episode_columns(episodes)
    first = np.zeros(sum(lengths), dtype=bool)
    first[np.cumsum(lengths) - lengths] = True
    of_steps = {name: np.repeat(v, lengths) for name, v in of_episodes.items()}
    bounds = sorted({0, sum(lengths), *(min(cut, sum(lengths)) for cut in cuts)})
    with tempfile.TemporaryDirectory() as name:
        whole = write_store(Path(name) / "whole", episodes, some_states())
        pieces = Path(name) / "pieces"
        pieces.mkdir()
        writer = StoreWriter(pieces, shard_steps)
        for begin, end in pairwise(bounds):
            own = ({k: v[begin:end] for k, v in each.items()} for each in (steps, of_steps))
            writer.append(next(own), first[begin:end], next(own))
        writer.finish(reward=schema.REWARD, source={})
        some_states().save(pieces / "item_states.safetensors")
        parts = EpisodeStore.open(pieces)
        cut = [np.diff(np.load(path)) for path in sorted(pieces.glob("shard-*/offsets.npy"))]
        assert np.concatenate(cut).tolist() == lengths
        # An episode that fills a shard is not torn apart.
        assert all(sum(shard) >= shard_steps > sum(shard[:-1]) for shard in cut[:-1])
        layout = {"n_shards": 1, "files": {}}
        assert parts.record.copy_with(**layout) == whole.record.copy_with(**layout)
        for column in of_episodes:
            assert np.array_equal(parts.episode_values(column), whole.episode_values(column))
        assert are_equal(all_windows(parts, 4), all_windows(whole, 4))


def test_splits_part_the_episodes_and_are_counted_in_the_record(tmp_path: Path) -> None:
    episodes = random_episodes(LENGTHS * 4)
    store = write_store(tmp_path / "store", episodes, shard_steps=6)
    for number, name in enumerate(schema.SPLITS):
        mine = [i for i, episode in enumerate(episodes) if episode.split == number]
        steps = sum(len(episodes[i]) for i in mine)
        assert store.split(name).episode_ids.tolist() == mine
        assert store.record.splits[name] == {"episodes": len(mine), "steps": steps}
    unsplit = EpisodeStore.from_arrays(REWARDS | VECTORS, np.array([4]))
    assert [unsplit.split(name).n_steps for name in schema.SPLITS] == [4, 0, 0]


@pytest.mark.parametrize("items", [True, False])
def test_the_fingerprint_knows_every_value(tmp_path: Path, items: bool) -> None:
    episodes = random_episodes(LENGTHS, items=items)
    given = steps, _ = step_columns(episodes), episode_columns(episodes)
    lengths, rng, seen = lengths_of(episodes), np.random.default_rng(0), set[str]()

    def add(
        steps: dict[str, Array], of_episodes: dict[str, Array], lengths: IntArray = lengths
    ) -> bool:
        """Whether the fingerprint is a new one."""
        with tempfile.TemporaryDirectory(dir=tmp_path) as name:
            store = EpisodeStore.write(Path(name) / "store", steps, lengths, of_episodes)
        known = len(seen)
        seen.add(store.record.fingerprint)
        return len(seen) > known

    assert add(*given)
    assert not add(*given)
    for columns in given:
        for name, values in columns.items():
            changed = values.copy()
            at = tuple(rng.integers(size) for size in values.shape)
            changed[at] = not changed[at] if values.dtype == bool else 1 - changed[at]
            both = (each | {name: changed} if each is columns else each for each in given)
            assert add(*both), name
    shifted = lengths.copy()
    shifted[[2, 3]] += (-1, 1)  # the same steps, another boundary
    assert add(*given, shifted)
    del steps[schema.PROPENSITY]
    assert add(*given)


def test_the_fingerprint_knows_what_numbers_stand_for(tmp_path: Path) -> None:
    def write(name: str, ids: list[str]) -> str:
        (tmp_path / name).mkdir()
        writer = StoreWriter(tmp_path / name)
        steps = {schema.REWARD: np.ones(2), schema.ITEM: np.array([0, 1])}
        writer.append(steps, np.array([True, False]), {schema.SPLIT: np.zeros(2, dtype=int)})
        return str(writer.finish("reward", {}, ids={"items": ids}).fingerprint)

    assert write("a", ["x", "y"]) == write("b", ["x", "y"]) != write("c", ["y", "x"])


def test_state_statistics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = random_episodes(LENGTHS)
    states = some_states()
    store = write_store(tmp_path / "store", episodes, states).select(np.array([1, 2, 5, 7]))
    places = [(episodes[e], t) for e in store.episode_ids for t in range(LENGTHS[e])]
    logged = [state_before(*place, states) for place in places]
    mean, std = store.state_statistics
    np.testing.assert_allclose(mean, np.mean(logged, axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(std, np.std(logged, axis=0), rtol=1e-3, atol=1e-4)
    # Of many steps some count, but not the same ones of episodes that are equally long.
    monkeypatch.setattr(store_module, "_STATISTICS_STEPS", 100)
    seen = np.tile(np.column_stack([np.arange(10.0) / 2**30, np.full(10, 1000.1)]), (100, 1))
    columns = {schema.OBSERVATION: seen, schema.ACTION: seen, schema.REWARD: seen[:, 0]}
    mean, std = EpisodeStore.from_arrays(columns, np.full(100, 10)).state_statistics
    np.testing.assert_allclose(mean, seen.mean(0), rtol=0.2)
    np.testing.assert_allclose(std, [seen[:, 0].std(), 0], rtol=0.2)


REWARDS, VECTORS = {schema.REWARD: np.ones(4)}, {schema.ACTION: np.ones((4, 2))}


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize(
    ("changed", "lengths", "message"),
    [
        ({"zeal": np.ones(4)}, [3, 1], "zeal"),
        ({schema.TIMESTAMP: np.arange(3)}, [3, 1], "'timestamp' has 3 .* instead of 4"),
        ({}, [3, 2], "4 .* instead of 5"),
        ({}, [3, 0, 1], "without steps"),
        ({schema.REWARD: np.array([1, np.nan, 2, np.inf])}, [3, 1], "2 of 4 rewards are not fin"),
        ({schema.REWARD: np.array([1, 2, 3, 1e30])}, [3, 1], "1 of 4 rewards are not fin"),
    ],
)
def test_wrong_arrays_make_no_store(
    tmp_path: Path, in_memory: bool, changed: dict[str, Array], lengths: list[int], message: str
) -> None:
    write = partial(EpisodeStore.write, tmp_path / "store", shard_steps=1)
    make = EpisodeStore.from_arrays if in_memory else write
    with pytest.raises((InputError, KeyError), match=message):
        make({**REWARDS, **VECTORS, **changed}, np.array(lengths))
    assert list(tmp_path.iterdir()) == []


def test_the_same_episodes_make_the_same_bytes_that_are_never_overwritten(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_store(tmp_path / name, random_episodes(LENGTHS), shard_steps=6)
    with pytest.raises(InputError, match="exists already"):
        write_store(tmp_path / "b", random_episodes([2, 2]))
    for path in (paths := [path for path in tmp_path.glob("a/**/*") if path.is_file()]):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()
    assert len(paths) > 20


def test_the_frame_has_the_rows_of_the_log_and_a_notebook_shows_it(tmp_path: Path) -> None:
    log = random_log(rows=300).assign(propensity=0.25)
    log["user_id"] = "u" + log.user_id.astype(str)
    store = prepared(log, tmp_path, session_by="gap", gap_minutes=60)
    frame = store.to_frame()
    keys = ["user_id", "timestamp", "item_id", "reward", "propensity"]
    found = frame[keys].sort_values(keys, ignore_index=True)
    expected = log[keys].sort_values(keys, ignore_index=True)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False)
    pauses = frame.sort_values(keys).groupby("user_id").timestamp.diff().gt(60 * 60_000)
    assert frame.session_id.nunique() == frame.user_id.nunique() + pauses.sum()
    assert frame.groupby("session_id").timestamp.apply(lambda t: t.is_monotonic_increasing).all()
    test = store.split("test").to_frame()
    assert set(test.split) == {"test"}
    assert len(test) == (frame.split == "test").sum()
    assert all(f"<td>{name}</td>" in store._repr_html_() for name in ("all", *schema.SPLITS))


def with_bot(log: pd.DataFrame, rows: int) -> pd.DataFrame:
    """The log with a user of one session, who is shown what people are and clicks on all of it."""
    rng, begin = np.random.default_rng(1), int(log.timestamp.min())
    bot = pd.DataFrame({"user_id": 101, "item_id": rng.choice(log.item_id, rows), "reward": 1.0})
    bot["timestamp"] = begin + np.sort(rng.choice(10**7, rows, replace=False))
    return pd.concat([log[log.user_id != 101], bot])


def trained(tmp_path: Path, log: pd.DataFrame) -> tuple[EpisodeStore, dict[str, Any]]:
    tmp_path.mkdir()
    bounds = tuple(float(log.timestamp[log.user_id != 101].quantile(q)) for q in (0.8, 0.9))
    own = {"session_by": "gap", "gap_minutes": 30, "embedding_size": 6, "split": bounds}
    store = prepared(log, tmp_path, tagged_mapping(tmp_path), **own)
    settings = ["rule.least_items=2.0", "rule.temperatures=[1.0]", "rule.lookaheads=[0.0]"]
    settings += ["rule.reward_weights=[0.0, 2.0]", "rule.tag_windows=[0]", "rule.tag_runs=[0]"]
    settings += ["policy.dim=16", "policy.context=4"]
    with short_validation():
        train_run(store, tmp_path / "run", resolve_config("popular", None, settings))
    candidates = read_json(tmp_path / "run" / "candidates.json")
    return store, {**read_json(tmp_path / "run" / "run.json"), "candidates": candidates}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*as bots have")
def test_a_user_of_4000_rows_in_a_session_changes_nothing_that_is_learned(tmp_path: Path) -> None:
    log = tagged_log(1500)
    _, people = trained(tmp_path / "people", log)
    store, bot = trained(tmp_path / "bot", with_bot(log, 4000))
    store = store.split("train")
    kept = store.without_long_sessions()
    assert kept.n_steps == store.n_steps - 4000
    ends = [each["rule"]["session_end"] for each in (people, bot)]
    assert ends[0]["kept"] == ends[1]["kept"]
    assert ends[1]["loss"]["constant"] == pytest.approx(ends[0]["loss"]["constant"], rel=0.1)
    rules = [each["rule"]["rule"] for each in (people, bot)]
    for name in rules[0].keys() - {"target"}:
        assert rules[0][name] == rules[1][name], name
    targets = [each["rule"]["target"] for each in bot["candidates"]]
    assert max(target for target in targets if target is not None) <= kept.returns.max()


GAP = 10


def store_of(log: pd.DataFrame, gap: int | None) -> EpisodeStore:
    """A store of rows by user and time, whose sessions end with a pause of more than `gap`."""
    first = (log.user.diff() != 0) | (log.timestamp.diff() > (np.inf if gap is None else gap))
    session = first.cumsum() - 1
    return EpisodeStore.from_arrays(
        {name: log[name].to_numpy() for name in (schema.ITEM, schema.REWARD, schema.TIMESTAMP)},
        np.bincount(session),
        {schema.USER: log.user[first].to_numpy()},
        ItemStates(torch.randn(12, 3), torch.zeros(0, 0), 0.0, 1.0),
    )


@given(seed=st.integers(0, 10_000), gap=st.sampled_from([None, GAP]), share=st.floats(0.1, 0.9))
def test_rows_before_a_step_are_those_of_the_user(seed: int, gap: int | None, share: float) -> None:
    rng = np.random.default_rng(seed)
    log = pd.DataFrame({"user": rng.integers(5, size=40), "item": rng.integers(12, size=40)})
    log["reward"] = rng.integers(2, size=40).astype(float)
    log["timestamp"] = np.cumsum(rng.integers(1, 8, size=40))
    early = log.timestamp <= log.timestamp.quantile(share)
    parts = [log[rows].sort_values(["user", "timestamp"]) for rows in (early, ~early)]
    earlier, later = (store_of(part, gap) for part in parts)
    rows = UserRows.of(later, later.episode_values(schema.USER), earlier)
    view = rows.continue_sessions(gap)
    assert view.n_steps == later.n_steps
    assert view.column(schema.ITEM).tolist() == parts[1]["item"].tolist()
    episodes, steps = view.all_steps()
    recent = rows.recent(np.arange(view.n_steps), 4)
    owner, seen = rows.seen(np.arange(view.n_steps))
    for number, row in enumerate(parts[1].itertuples()):
        before = log[(log.user == row.user) & (log.timestamp < row.timestamp)]
        newest = before.iloc[::-1][:4]
        count = len(newest)
        assert recent[0][number].tolist() == [*newest["item"], *[-1] * (4 - count)]
        assert recent[1][number].tolist() == [*newest["reward"], *[0.0] * (4 - count)]
        assert sorted(seen[owner == number]) == sorted(before["item"])
        pauses = np.diff([*before.timestamp, row.timestamp])
        ended = np.flatnonzero(pauses > (np.inf if gap is None else gap))
        session = before.iloc[ended[-1] + 1 if len(ended) else 0 :]
        at = np.array([episodes[number]]), np.array([steps[number]])
        assert steps[number] == len(session)
        assert view.rewards_before(*at)[0] == session["reward"].sum()
        assert view.step_values(schema.ITEM, *at)[0] == row.item
        window = view.windows(*at, 6)
        assert int(window.mask.sum()) == min(6, len(session) + 1)
        assert window.returns_to_go[0, -1] == _rest(parts[1], row, gap)


def _rest(part: pd.DataFrame, row, gap: int | None) -> float:  # type: ignore[no-untyped-def]
    after = part[(part.user == row.user) & (part.timestamp >= row.timestamp)]
    ended = np.flatnonzero(np.diff(after.timestamp) > (np.inf if gap is None else gap))
    return float(after.reward.iloc[: ended[0] + 1 if len(ended) else None].sum())


def test_rows_in_both_logs_count_once_and_unknown_users_have_none() -> None:
    log = pd.DataFrame({"user": 0, "item": range(8), "reward": 1.0, "timestamp": range(8)})
    rows = UserRows.of(store_of(log[4:], None), np.array([0]), store_of(log, None))
    assert rows.recent(np.array([3]), 8)[0].tolist() == [[6, 5, 4, 3, 2, 1, 0, -1]]
    unknown = store_of(log[4:].assign(user=-1), None)
    rows = UserRows.of(unknown, np.array([7]), store_of(log, None))
    assert rows.continue_sessions(None) is unknown
