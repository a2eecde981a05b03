"""The episode store against plain Python readers of the same episodes."""

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain, pairwise, product
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from tests.recommending.test_recommend import random_log
from tests.support.episodes import (
    Logged,
    episode_columns,
    lengths_of,
    random_episodes,
    some_states,
    state_before,
    step_columns,
    write_store,
)
from ucfrec import schema
from ucfrec.episodes import store as store_module
from ucfrec.episodes import view as view_module
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.episodes.writer import StoreWriter
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, read_json, write_json
from ucfrec.logs import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare

LENGTHS = [3, 1, 7, 2, 5, 9, 1, 4]
SHARDS = (2**24, 6, 1)


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def same(a: Windows, b: Windows) -> bool:
    return all(torch.equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True))


def every_window(store: EpisodeStore, length: int) -> Windows:
    return store.windows(*store.all_steps(), length)


lengths_of_episodes = st.lists(st.integers(1, 8), min_size=1, max_size=6)


# What is written is what is read.


@pytest.mark.parametrize("shard_steps", SHARDS)
@pytest.mark.parametrize("items", [True, False])
def test_every_column_comes_back(folder: Path, items: bool, shard_steps: int) -> None:
    episodes = random_episodes(LENGTHS, items=items)
    write_store(folder / "store", episodes, shard_steps=shard_steps)
    store = EpisodeStore.open(folder / "store")

    assert len(store) == store.n_episodes == len(LENGTHS)
    assert store.n_steps == sum(LENGTHS)
    assert store.lengths.tolist() == LENGTHS
    assert store.has_items == items
    for name, values in step_columns(episodes).items():
        read = store.step_values(name, *store.all_steps())
        assert read.dtype == np.dtype(schema.STEP_DTYPES[name])
        assert np.array_equal(read, values.astype(schema.STEP_DTYPES[name]))
    for name, values in episode_columns(episodes).items():
        read = store.episode_values(name)
        assert read.dtype == np.dtype(schema.EPISODE_DTYPES[name])
        assert np.array_equal(read, values.astype(schema.EPISODE_DTYPES[name]))


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
            writer.append(
                {k: v[begin:end] for k, v in steps.items()},
                first[begin:end],
                {k: v[begin:end] for k, v in of_steps.items()},
            )
        writer.finish(reward=schema.REWARD, source={})
        some_states().save(pieces / "item_states.safetensors")
        parts = EpisodeStore.open(pieces)

        assert parts.record.n_shards >= min(len(lengths), sum(lengths) // (shard_steps + 8))
        layout = {"n_shards": 1, "files": {}}
        assert parts.record.copy_with(**layout) == whole.record.copy_with(**layout)
        assert parts.lengths.tolist() == lengths
        assert np.array_equal(parts.returns, whole.returns)
        for column in of_episodes:
            assert np.array_equal(parts.episode_values(column), whole.episode_values(column))
        assert same(every_window(parts, 4), every_window(whole, 4))


def test_large_stores_are_cut_between_episodes(folder: Path) -> None:
    lengths = [3, 3, 6, 1, 7, 2, 4, 5]
    store = write_store(folder / "store", random_episodes(lengths), shard_steps=6)
    cut = [np.diff(np.load(p)).tolist() for p in sorted(folder.glob("store/shard-*/offsets.npy"))]
    assert list(chain(*cut)) == lengths
    assert len(cut) == store.record.n_shards > 2
    # A shard is full when it holds 6 steps; the episode that fills it is not torn apart.
    assert all(sum(shard) >= 6 > sum(shard[:-1]) for shard in cut[:-1])


def test_splits_are_counted_in_the_record(folder: Path) -> None:
    episodes = random_episodes(LENGTHS)
    store = write_store(folder / "store", episodes, shard_steps=6)
    for number, name in enumerate(schema.SPLITS):
        mine = [e for e in episodes if e.split == number]
        assert store.record.splits[name] == {"episodes": len(mine), "steps": sum(map(len, mine))}


def test_without_a_split_everything_is_for_training(folder: Path) -> None:
    store = EpisodeStore.write(
        folder / "store", {schema.REWARD: np.ones(3), schema.ACTION: np.ones((3, 1))}, np.array([3])
    )
    assert store.split("train").n_steps == 3
    assert store.split("test").n_episodes == 0


# The fingerprint.


def fingerprint(
    folder: Path,
    steps: dict[str, np.ndarray],
    lengths: np.ndarray,
    of_episodes: dict[str, np.ndarray],
) -> str:
    with tempfile.TemporaryDirectory(dir=folder) as name:
        store = EpisodeStore.write(Path(name) / "store", steps, lengths, of_episodes)
        return str(store.record.fingerprint)


@pytest.mark.parametrize("items", [True, False])
def test_the_fingerprint_knows_every_value(folder: Path, items: bool) -> None:
    episodes = random_episodes(LENGTHS, items=items)
    steps, lengths, of_episodes = (
        step_columns(episodes),
        lengths_of(episodes),
        episode_columns(episodes),
    )
    seen = {fingerprint(folder, steps, lengths, of_episodes)}
    assert fingerprint(folder, steps, lengths, of_episodes) in seen

    rng = np.random.default_rng(0)
    for columns in (steps, of_episodes):
        for name, values in columns.items():
            changed = values.copy()
            at = tuple(rng.integers(size) for size in values.shape)
            changed[at] = not changed[at] if values.dtype == bool else 1 - changed[at]
            new = fingerprint(
                folder,
                {**steps, name: changed} if columns is steps else steps,
                lengths,
                {**of_episodes, name: changed} if columns is of_episodes else of_episodes,
            )
            assert new not in seen, name
            seen.add(new)

    shifted = lengths.copy()
    shifted[[2, 3]] += (-1, 1)  # the same steps, another boundary
    assert fingerprint(folder, steps, shifted, of_episodes) not in seen
    without = {k: v for k, v in steps.items() if k != schema.PROPENSITY}
    assert fingerprint(folder, without, lengths, of_episodes) not in seen


def test_the_fingerprint_knows_what_numbers_stand_for(folder: Path) -> None:
    def write(name: str, ids: list[str]) -> str:
        (folder / name).mkdir()
        writer = StoreWriter(folder / name)
        steps = {schema.REWARD: np.ones(2), schema.ITEM: np.array([0, 1])}
        writer.append(steps, np.array([True, False]), {schema.SPLIT: np.zeros(2, dtype=int)})
        return str(writer.finish("reward", {}, ids={"items": ids}).fingerprint)

    assert write("a", ["x", "y"]) == write("b", ["x", "y"]) != write("c", ["y", "x"])


# Windows.


@given(
    lengths=lengths_of_episodes,
    length=st.integers(1, 10),
    window=st.integers(1, 5),
    users=st.integers(0, 2),
    observation=st.integers(0, 2),
    items=st.booleans(),
    shard_steps=st.sampled_from(SHARDS),
    data=st.data(),
)
def test_windows_equal_a_row_by_row_reading(
    lengths: list[int],
    length: int,
    window: int,
    users: int,
    observation: int,
    items: bool,
    shard_steps: int,
    data: st.DataObject,
) -> None:
    observation = observation if items else observation + 1
    episodes = random_episodes(lengths, seed=len(lengths), observation=observation, items=items)
    states = some_states(users, window) if items else None
    episode = st.integers(0, len(lengths) - 1)
    chosen = data.draw(st.lists(episode, min_size=1, max_size=8))
    ends = [data.draw(st.integers(0, lengths[e] - 1)) for e in chosen]
    with tempfile.TemporaryDirectory() as name:
        store = write_store(Path(name) / "store", episodes, states, shard_steps)
        got = store.windows(np.array(chosen), np.array(ends), length)

    assert got.states.shape == (len(chosen), length, store.state_size)
    assert got.states.dtype == got.rewards.dtype == got.returns_to_go.dtype == torch.float32
    assert got.timesteps.dtype == torch.int64
    assert got.actions.dtype == (torch.int64 if items else torch.float32)
    for b, (number, end) in enumerate(zip(chosen, ends, strict=True)):
        logged = episodes[number]
        for k in range(length):
            step = end - (length - 1) + k
            assert got.mask[b, k] == (step >= 0)
            if step < 0:
                continue
            assert got.rewards[b, k] == logged.rewards[step]
            assert got.returns_to_go[b, k] == logged.return_to_go(step)
            assert got.timesteps[b, k] == step
            if logged.actions is None:
                assert got.actions[b, k] == logged.items[step]
            else:
                assert np.array_equal(got.actions[b, k], logged.actions[step])
            expected = state_before(logged, step, states)
            np.testing.assert_allclose(got.states[b, k], expected, rtol=1e-5, atol=1e-6)


def test_the_documented_example(folder: Path) -> None:
    steps = {schema.REWARD: np.array([9.0, 5, 6, 7, 8]), schema.ACTION: np.zeros((5, 1))}
    steps[schema.OBSERVATION] = np.zeros((5, 1))
    store = EpisodeStore.write(folder / "store", steps, np.array([1, 4]))
    window = store.windows(np.array([1]), np.array([1]), 3)
    assert window.rewards.tolist() == [[0, 5, 6]]
    assert window.mask.tolist() == [[False, True, True]]
    assert window.timesteps.tolist() == [[0, 0, 1]]
    assert window.returns_to_go.tolist() == [[0, 26, 21]]


@pytest.mark.parametrize("items", [True, False])
def test_padding_is_zero_with_a_plus_sign(folder: Path, items: bool) -> None:
    episodes = random_episodes(LENGTHS, items=items)
    for episode in episodes:  # all signs negative: a product with the mask would leave −0.0
        episode.rewards = [-1.0] * len(episode)
        episode.observations = -np.abs(episode.observations)
        if episode.actions is not None:
            episode.actions = -np.abs(episode.actions)
    store = write_store(folder / "store", episodes, some_states() if items else None)
    windows = every_window(store, 12)
    padding = ~windows.mask
    assert padding.sum() > 100
    for name, values in vars(windows).items():
        padded = values[padding]
        assert not padded.any(), name
        assert padded.dtype == torch.bool or not torch.signbit(padded).any(), name

    moved = store.transitions(*store.all_steps())
    beyond = moved.next_states[moved.last]
    assert len(beyond) == store.n_episodes
    assert not beyond.any()
    assert not torch.signbit(beyond).any()


def test_a_window_of_no_rows_is_empty(folder: Path) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states())
    none = np.empty(0, dtype=np.int64)
    assert store.windows(none, none, 4).states.shape == (0, 4, store.state_size)


# Views, splits and drawing.


@pytest.mark.parametrize("shard_steps", SHARDS)
def test_views_see_their_episodes_only(folder: Path, shard_steps: int) -> None:
    episodes = random_episodes(LENGTHS)
    store = write_store(folder / "store", episodes, some_states(), shard_steps)
    view = store.select(np.array([6, 2, 4])).select(np.array([2, 0]))
    assert view.episode_ids.tolist() == [4, 6]
    assert view.lengths.tolist() == [LENGTHS[4], LENGTHS[6]]
    assert view.episode_values(schema.USER).tolist() == [episodes[4].user, episodes[6].user]
    assert view.returns.tolist() == [episodes[4].return_to_go(0), episodes[6].return_to_go(0)]
    at = np.array([0, 0, 1]), np.array([1, 4, 0])
    assert same(view.windows(*at, 5), store.windows(np.array([4, 4, 6]), at[1], 5))
    walked = view.all_steps()
    assert np.array_equal(view.locate(np.arange(view.n_steps)), walked)
    assert walked[0].tolist() == [0] * LENGTHS[4] + [1] * LENGTHS[6]
    assert walked[1].tolist() == [*range(LENGTHS[4]), *range(LENGTHS[6])]


@pytest.mark.parametrize("shard_steps", SHARDS)
@pytest.mark.parametrize("items", [True, False])
def test_a_view_leaves_out_some_of_what_was_observed(
    folder: Path, items: bool, shard_steps: int
) -> None:
    episodes = random_episodes(LENGTHS, observation=3, items=items)
    store = write_store(folder / "store", episodes, some_states() if items else None, shard_steps)
    view = store.select(np.array([6, 2, 4])).without_observation_dimensions([1])
    assert (view.observation_size, view.state_size) == (2, store.state_size - 1)
    for part in (view, view.select(np.array([2, 0]))):
        seen, whole = (every_window(each, 4) for each in (part, store.select(part.episode_ids)))
        # What is observed comes last in a state.
        assert torch.equal(seen.states[..., :-2], whole.states[..., :-3])
        assert torch.equal(seen.states[..., -2:], whole.states[..., [-3, -1]])
        assert same(replace(seen, states=whole.states), whole)
    last = every_window(view.without_observation_dimensions([0]), 4)
    assert torch.equal(last.states[..., -1], every_window(view, 4).states[..., -1])
    assert last.states.shape[-1] == view.state_size - 1
    assert store.observation_size == 3


def test_splits_part_the_episodes(folder: Path) -> None:
    episodes = random_episodes(LENGTHS * 4)
    store = write_store(folder / "store", episodes, shard_steps=6)
    views = [store.split(name) for name in schema.SPLITS]
    for number, view in enumerate(views):
        assert view.episode_ids.tolist() == [
            i for i, episode in enumerate(episodes) if episode.split == number
        ]
        assert (view.episode_values(schema.SPLIT) == number).all()
    everything = np.concatenate([view.episode_ids for view in views])
    assert sorted(everything.tolist()) == list(range(len(episodes)))


def test_draws_are_uniform_over_steps(folder: Path) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states())
    store = store.select(np.array([0, 2, 3, 5]))
    episodes, steps = store.draw_steps(np.random.default_rng(0), 40_000)
    assert (steps >= 0).all()
    assert (steps < store.lengths[episodes]).all()
    starts = np.cumsum(store.lengths) - store.lengths
    counts = np.bincount(starts[episodes] + steps, minlength=store.n_steps)
    assert len(counts) == store.n_steps
    assert chisquare(counts).pvalue > 1e-3

    again = store.draw_steps(np.random.default_rng(0), 40_000)
    assert np.array_equal(episodes, again[0])
    assert np.array_equal(steps, again[1])
    other = store.draw_steps(np.random.default_rng(1), 40_000)
    assert not np.array_equal(steps, other[1])


@pytest.mark.parametrize("limit", [1_000_000, 10])
def test_state_statistics(folder: Path, limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "_STATISTICS_STEPS", limit)
    episodes = random_episodes(LENGTHS)
    states = some_states()
    store = write_store(folder / "store", episodes, states).select(np.array([1, 2, 5, 7]))
    logged = [
        state_before(episodes[e], t, states) for e in store.episode_ids for t in range(LENGTHS[e])
    ]
    seen = np.array(logged)[:: -(-len(logged) // limit)]
    mean, std = store.state_statistics
    np.testing.assert_allclose(mean, seen.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(std, seen.std(0), rtol=1e-3, atol=1e-4)


# A store in memory.


@given(lengths_of_episodes, st.booleans(), st.integers(0, 9))
def test_a_store_in_memory_is_the_one_on_disk(lengths: list[int], items: bool, seed: int) -> None:
    episodes = random_episodes(lengths, seed, items=items)
    states = some_states() if items else None
    of_steps, of_episodes = step_columns(episodes), episode_columns(episodes)
    memory = EpisodeStore.from_arrays(of_steps, lengths_of(episodes), of_episodes, states)
    with tempfile.TemporaryDirectory() as name:
        disk = write_store(Path(name) / "store", episodes, states)
        for a, b in ((memory, disk), (memory.split("train"), disk.split("train"))):
            assert same(every_window(a, 3), every_window(b, 3))
            assert np.array_equal(a.returns, b.returns)
            for column in of_steps:
                read = a.step_values(column, *a.all_steps()), b.step_values(column, *b.all_steps())
                assert np.array_equal(*read)
                assert read[0].dtype == read[1].dtype
            for column in of_episodes:
                assert np.array_equal(a.episode_values(column), b.episode_values(column))
    with pytest.raises(InputError, match="<memory> has no column 'zeal'"):
        memory.step_values("zeal", *memory.all_steps())


def test_wrong_arrays_make_no_store_in_memory() -> None:
    steps = {schema.REWARD: np.ones(4), schema.ACTION: np.ones((4, 2))}
    for lengths, changed, message in (
        ([3, 2], {}, "'reward' has 4 values instead of 5"),
        ([4, 0], {}, "without steps"),
        ([4], {schema.ACTION: np.ones((3, 2))}, "'action' has 3 values instead of 4"),
        ([4], {schema.REWARD: np.array([1, np.nan, 1, 1])}, "1 of 4 rewards are not finite"),
    ):
        with pytest.raises(InputError, match=message):
            EpisodeStore.from_arrays({**steps, **changed}, np.array(lengths))
    with pytest.raises(InputError, match="'user' has 1 values instead of 2"):
        EpisodeStore.from_arrays(steps, np.array([3, 1]), {schema.USER: np.zeros(1)})


# What is said of them, and shapes.


def test_a_store_says_what_it_holds(folder: Path) -> None:
    episodes = random_episodes([700, 800])
    episodes[0].split = episodes[1].split = 0
    store = write_store(folder / "store", episodes, some_states())
    assert repr(store) == "EpisodeStore(1,500 steps, 2 episodes, 11 items, reward=reward)"
    train = store.split("train").select(np.array([0]))
    assert (
        repr(train) == "EpisodeStore(700 steps, 1 episodes, 11 items, reward=reward, split=train)"
    )
    at = np.array([0, 1, 1]), np.array([5, 6, 7])
    assert repr(store.windows(*at, 4)) == (
        f"Windows(3 of 4 steps, states of {store.state_size}, actions are items)"
    )
    assert repr(store.transitions(*at)) == (
        f"Transitions(3 steps, states of {store.state_size}, actions of 4)"
    )


def test_steps_that_an_episode_does_not_have_are_refused(folder: Path) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states())
    for episodes, ends, length, message in (
        ([0], [LENGTHS[0]], 2, "episode 0 has 3 steps, none numbered 3"),
        ([0], [-1], 2, "episode 0 has 3 steps, none numbered -1"),
        ([-1], [0], 2, "no episodes -1 to -1"),
        ([0, len(LENGTHS)], [0, 0], 2, f"no episodes 0 to {len(LENGTHS)}"),
        ([0, 1], [0], 2, "two arrays of the same length"),
        ([[0]], [[0]], 2, "two arrays of the same length"),
        ([0], [0], 0, "at least 1 step"),
    ):
        with pytest.raises(InputError, match=message):
            store.windows(np.array(episodes), np.array(ends), length)
    with pytest.raises(InputError, match="no split is called 'training'; there are train, valid"):
        store.split("training")


# Opening, and what can be wrong.


def test_opening_reads_the_record_only(folder: Path) -> None:
    write_store(folder / "store", random_episodes(LENGTHS), shard_steps=6)
    for column in folder.glob("store/shard-*/*"):
        column.write_bytes(bytes(column.stat().st_size))
    store = EpisodeStore.open(folder / "store")
    assert store.record.n_steps == sum(LENGTHS)


def test_columns_are_mapped_not_read(folder: Path) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS, items=False))
    at = np.array([0]), np.array([0])
    before = float(store.step_values(schema.REWARD, *at)[0])
    column = np.load(folder / "store" / "shard-00000" / "reward.npy", mmap_mode="r+")
    column[0] = before + 1
    column.flush()
    assert store.step_values(schema.REWARD, *at)[0] == before + 1


def change_reward_name(path: Path) -> None:
    path.write_text(path.read_text().replace('"reward": "reward"', '"reward": "reword"'))


RECORDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "newer": (
        lambda path: path.write_text(json.dumps({"version": schema.STORE_VERSION + 1})),
        "upgrade ucfrec",
    ),
    "cut": (lambda path: path.write_text("{"), r"meta\.json"),
    "no object": (lambda path: path.write_text("[]"), r"meta\.json"),
    "nothing in it": (lambda path: path.write_text("{}"), r"meta\.json"),
    "another type": (lambda path: path.write_text('{"version": "1"}'), r"meta\.json"),
    "no text": (lambda path: path.write_bytes(b"\xff"), r"meta\.json"),
    "missing": (Path.unlink, r"not an episode store.*meta\.json"),
    "changed": (change_reward_name, r"meta\.json was changed after ucfrec wrote it"),
}


@pytest.mark.parametrize(("damage", "message"), RECORDS.values(), ids=RECORDS)
def test_a_damaged_record_is_named(
    folder: Path, damage: Callable[[Path], object], message: str
) -> None:
    write_store(folder / "store", random_episodes(LENGTHS))
    damage(folder / "store" / "meta.json")
    with pytest.raises(InputError, match=message):
        EpisodeStore.open(folder / "store")


def use(store: EpisodeStore) -> None:
    store.episode_values(schema.USER)
    every_window(store, 3)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut in the header": lambda path: path.write_bytes(path.read_bytes()[:50]),
    "cut in the data": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "not numpy": lambda path: path.write_bytes(b"PK or something else entirely" * 9),
    "a flipped bit": lambda path: path.write_bytes(flip(path.read_bytes())),
}
COLUMNS = ("reward", "item", "return_to_go", "offsets", "user")


def flip(content: bytes) -> bytes:
    return content[:-1] + bytes([content[-1] ^ 16])


@pytest.mark.parametrize(
    ("column", "damage"), [*product(COLUMNS, ["a flipped bit"]), *product(["item"], DAMAGE)]
)
def test_a_damaged_column_is_named_when_it_is_used(folder: Path, column: str, damage: str) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states(), shard_steps=6)
    DAMAGE[damage](folder / "store" / "shard-00001" / f"{column}.npy")
    with pytest.raises(InputError, match=rf"shard-00001/{column}\.npy") as caught:
        use(EpisodeStore.open(store.path))
    assert "\n" not in str(caught.value)


def test_a_column_of_another_length_is_named(folder: Path) -> None:
    write_store(folder / "store", random_episodes(LENGTHS), some_states(), shard_steps=6)
    path = folder / "store" / "shard-00001" / "reward.npy"
    np.save(path, np.load(path)[:-1])
    with pytest.raises(InputError, match=r"reward\.npy is truncated: 152 of 156 bytes"):
        use(EpisodeStore.open(folder / "store"))
    without_checksums(folder / "store")
    with pytest.raises(InputError, match="'reward' has 31 of 32 steps"):
        use(EpisodeStore.open(folder / "store"))


def without_checksums(store: Path) -> None:
    """Let other content of its files pass."""
    write_json(store / "meta.json", {**read_json(store / "meta.json"), "files": {}})


@pytest.mark.parametrize("middle", [[2**63 - 1, -(2**63)], [3, 3], [4, 2]])
def test_offsets_that_do_not_ascend_are_damage(folder: Path, middle: list[int]) -> None:
    """Differences of the first wrap around to positive numbers."""
    write_store(folder / "store", random_episodes([3, 3, 3]))
    path = folder / "store" / "shard-00000" / "offsets.npy"
    np.save(path, np.array([0, *middle, np.load(path)[-1]]))
    without_checksums(folder / "store")
    with pytest.raises(InputError, match="do not ascend from 0"):
        use(EpisodeStore.open(folder / "store"))


def test_an_item_that_the_catalogue_lacks_is_named(folder: Path) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states())
    without_checksums(store.path)
    path = store.path / "shard-00000" / "item.npy"
    items = np.load(path)
    items[3] = 10**6
    np.save(path, items)
    with pytest.raises(InputError, match="'item' has items from 0 to 1000000, there are 11"):
        use(EpisodeStore.open(store.path))


def test_a_column_that_was_never_logged_is_named(folder: Path) -> None:
    steps = {schema.REWARD: np.ones(3), schema.ACTION: np.ones((3, 1))}
    store = EpisodeStore.write(folder / "store", steps, np.array([3]))
    with pytest.raises(InputError, match="no column 'propensity'"):
        store.step_values(schema.PROPENSITY, np.array([0]), np.array([0]))


@pytest.mark.parametrize("shard_steps", SHARDS)
def test_steps_beyond_the_store_are_refused(folder: Path, shard_steps: int) -> None:
    store = write_store(folder / "store", random_episodes(LENGTHS), shard_steps=shard_steps)
    with pytest.raises(IndexError):
        store.step_values(schema.REWARD, np.array([7]), np.array([LENGTHS[7]]))


# Writing whole or not at all.


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def bad_writes() -> dict[str, tuple[dict[str, object], str]]:
    steps = {schema.REWARD: np.ones(4), schema.ACTION: np.ones((4, 2))}
    return {
        "unknown column": ({"steps": {**steps, "zeal": np.ones(4)}}, "zeal"),
        "column of another length": (
            {"steps": {**steps, schema.TIMESTAMP: np.arange(3)}},
            "'timestamp' has 3 steps instead of 4",
        ),
        "lengths that do not add up": ({"lengths": np.array([3, 2])}, "4 steps instead of 5"),
        "an empty episode": ({"lengths": np.array([3, 0, 1])}, "without steps"),
        "rewards that are not numbers": (
            {"steps": {**steps, schema.REWARD: np.array([1, np.nan, 2, np.inf])}},
            "2 of 4 rewards are not finite",
        ),
        "no episode at all": (
            {"steps": {k: v[:0] for k, v in steps.items()}, "lengths": np.empty(0, dtype=int)},
            "no episode is left",
        ),
    }


@pytest.mark.parametrize("case", bad_writes())
def test_a_write_that_fails_leaves_nothing(folder: Path, case: str) -> None:
    arguments, message = bad_writes()[case]
    steps = {schema.REWARD: np.ones(4), schema.ACTION: np.ones((4, 2))}
    given_arguments = {"steps": steps, "lengths": np.array([3, 1]), "shard_steps": 1} | arguments
    with pytest.raises((InputError, KeyError), match=message):
        EpisodeStore.write(folder / "store", **given_arguments)  # type: ignore[arg-type]
    assert list(folder.iterdir()) == []


def test_a_failure_half_way_leaves_nothing(folder: Path) -> None:
    steps = {schema.REWARD: np.ones(4), schema.ITEM: np.arange(4)}

    def write() -> None:
        with atomic_folder(folder / "store") as scratch:
            writer = StoreWriter(scratch, shard_steps=2)
            for _ in range(3):
                first = np.array([True, False, True, False])
                writer.append(steps, first, {schema.SPLIT: np.zeros(4, dtype=int)})
            assert len(list(scratch.iterdir())) > 2
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert list(folder.iterdir()) == []


def test_a_store_is_never_overwritten(folder: Path) -> None:
    write_store(folder / "store", random_episodes(LENGTHS))
    before = contents(folder)
    with pytest.raises(InputError, match="exists already"):
        write_store(folder / "store", random_episodes([2, 2]))
    assert contents(folder) == before


def test_the_same_episodes_make_the_same_bytes(folder: Path) -> None:
    for name in ("a", "b"):
        write_store(folder / name, random_episodes(LENGTHS), shard_steps=6)
    assert contents(folder / "a") == contents(folder / "b")


@pytest.mark.parametrize("long_enough", [1, 1000])
def test_steps_in_batches_are_all_steps(
    folder: Path, monkeypatch: pytest.MonkeyPatch, long_enough: int
) -> None:
    """Also where they are read as slices across shards."""
    monkeypatch.setattr(view_module, "_BATCH_STEPS", 7)
    monkeypatch.setattr(view_module, "_LONG_ENOUGH", long_enough)
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states(), shard_steps=6)
    for view in (store, store.select(np.array([2, 0, 2])), store.select(np.array([1, 2, 0]))):
        episodes, steps = zip(*view.step_batches(), strict=True)
        assert len(episodes) == -(-view.n_steps // 7)
        listed = view.all_steps()
        np.testing.assert_array_equal(np.concatenate(episodes), listed[0])
        np.testing.assert_array_equal(np.concatenate(steps), listed[1])
        rewards, items = (view.step_values(n, *listed) for n in (schema.REWARD, schema.ITEM))
        np.testing.assert_array_equal(view.column(schema.REWARD), rewards)
        counts = np.bincount(items, minlength=len(view.item_states.embeddings))
        np.testing.assert_array_equal(view.item_counts(), counts)
    assert store.select(np.array([], dtype=np.int64)).column(schema.REWARD).shape == (0,)


def test_views_share_mapped_columns_with_their_store(folder: Path) -> None:
    """A view costs no second mapping; its windows are those of the store it was taken from."""
    store = write_store(folder / "store", random_episodes(LENGTHS), some_states())
    whole = every_window(store, 3)
    for column in folder.glob("store/shard-*/reward.npy"):
        column.unlink()
    assert same(every_window(store.select(np.arange(len(LENGTHS))), 3), whole)


def test_user_rows_are_those_of_the_source(folder: Path) -> None:
    states = some_states(users=2)
    logged = [
        Logged([1.0], np.zeros((1, 0)), items=[0], user=3),
        Logged([1.0], np.zeros((1, 0)), items=[0], user=-1),
    ]
    store = write_store(folder / "store", logged, states)
    seen = every_window(store, 1).states[:, 0, -2:]
    assert torch.equal(seen[0], states.user_features[3])
    assert not seen[1].any()


def test_the_frame_has_the_rows_of_the_log(tmp_path: Path) -> None:
    log = random_log(rows=300).assign(propensity=0.25)
    log["user_id"] = "u" + log.user_id.astype(str)
    log.to_parquet(tmp_path / "log.parquet")
    options = PrepareOptions(session_by="gap", gap_minutes=60)
    prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / "store", options)
    store = EpisodeStore.open(tmp_path / "store")
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


def test_a_notebook_shows_the_store(tmp_path: Path) -> None:
    mpl.use("Agg")
    random_log().to_parquet(tmp_path / "log.parquet")
    prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / "store")
    store = EpisodeStore.open(tmp_path / "store")
    html = store._repr_html_()
    assert all(f"<td>{name}</td>" in html for name in ("all", "train", "validation", "test"))
    axes = store.plot()
    assert sum(bar.get_height() for bar in axes.patches) == len(store)
