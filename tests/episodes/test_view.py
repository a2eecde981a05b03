"""Windows and columns of a store against plain Python readers of the same episodes."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.episodes import (
    LENGTHS,
    SHARDS,
    all_windows,
    are_equal,
    random_episodes,
    some_states,
    state_before,
    write_store,
)
from ucfrec import schema
from ucfrec.arrays import Array
from ucfrec.episodes import view as view_module
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json


@given(
    lengths=st.lists(st.integers(1, 8), min_size=1, max_size=6),
    length=st.integers(1, 10),
    state=st.tuples(st.integers(0, 2), st.integers(1, 5)),
    observed=st.integers(0, 2),
    items=st.booleans(),
    shards=st.sampled_from(SHARDS),
    data=st.data(),
)
def test_windows_equal_a_row_by_row_reading(
    lengths: list[int], length: int, state: Any, observed: int, items: bool, shards: int, data: Any
) -> None:
    episodes = random_episodes(lengths, len(lengths), observed + (not items), items)
    states = some_states(*state) if items else None
    episode = st.integers(0, len(lengths) - 1)
    chosen = data.draw(st.lists(episode, min_size=1, max_size=8))
    ends = [data.draw(st.integers(0, lengths[e] - 1)) for e in chosen]
    with tempfile.TemporaryDirectory() as name:
        store = write_store(Path(name) / "store", episodes, states, shards)
        got = store.windows(np.array(chosen), np.array(ends), length)
    assert got.states.dtype == got.rewards.dtype == got.returns_to_go.dtype == torch.float32
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
            taken = logged.items if items else logged.actions
            assert np.array_equal(got.actions[b, k], taken[step])
            expected = state_before(logged, step, states)
            np.testing.assert_allclose(got.states[b, k], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("items", [True, False])
def test_padding_is_zero_with_a_plus_sign(tmp_path: Path, items: bool) -> None:
    episodes = random_episodes(LENGTHS, items=items)
    store = write_store(tmp_path / "store", episodes, some_states() if items else None)
    windows, moved = all_windows(store, 12), store.transitions(*store.all_steps())
    padded = {
        name: values[~windows.mask]
        for name, values in vars(windows).items()
        if values is not None and name != "times"
    }
    assert len(padded["mask"]) > 100
    for name, values in {**padded, "next states": moved.next_states[moved.last]}.items():
        assert not values.any(), name
        assert values.dtype == torch.bool or not torch.signbit(values).any(), name


@pytest.mark.parametrize("shard_steps", SHARDS)
def test_views_see_their_episodes_only(tmp_path: Path, shard_steps: int) -> None:
    episodes = random_episodes(LENGTHS)
    store = write_store(tmp_path / "store", episodes, some_states(), shard_steps)
    view = store.select(np.array([6, 2, 4])).select(np.array([2, 0]))
    assert view.episode_ids.tolist() == [4, 6]
    assert view.lengths.tolist() == [LENGTHS[4], LENGTHS[6]]
    assert view.episode_values(schema.USER).tolist() == [episodes[4].user, episodes[6].user]
    assert view.returns.tolist() == [episodes[4].return_to_go(0), episodes[6].return_to_go(0)]
    at = np.array([0, 0, 1]), np.array([1, 4, 0])
    assert are_equal(view.windows(*at, 5), store.windows(np.array([4, 4, 6]), at[1], 5))
    nothing = np.empty(0, dtype=np.int64)
    assert store.windows(nothing, nothing, 4).states.shape == (0, 4, store.state_size)
    walked = [(number, t) for number, e in enumerate((4, 6)) for t in range(LENGTHS[e])]
    assert list(zip(*view.all_steps(), strict=True)) == walked
    assert np.array_equal(view.locate(np.arange(view.n_steps)), view.all_steps())


@pytest.mark.parametrize("shard_steps", SHARDS)
@pytest.mark.parametrize("items", [True, False])
def test_a_view_leaves_out_some_observations(tmp_path: Path, items: bool, shard_steps: int) -> None:
    episodes = random_episodes(LENGTHS, observation=3, items=items)
    store = write_store(tmp_path / "store", episodes, some_states() if items else None, shard_steps)
    view = store.select(np.array([6, 2, 4])).without_observation_dimensions([1])
    assert (view.observation_size, view.state_size) == (2, store.state_size - 1)
    for part in (view, view.select(np.array([2, 0]))):
        seen, whole = (all_windows(each, 4) for each in (part, store.select(part.episode_ids)))
        # What is observed comes last in a state.
        assert torch.equal(seen.states[..., :-2], whole.states[..., :-3])
        assert torch.equal(seen.states[..., -2:], whole.states[..., [-3, -1]])
        assert are_equal(replace(seen, states=whole.states), whole)
    last = all_windows(view.without_observation_dimensions([0]), 4)
    assert torch.equal(last.states[..., -1], all_windows(view, 4).states[..., -1])


def test_steps_that_an_episode_does_not_have_are_refused(tmp_path: Path) -> None:
    store = write_store(tmp_path / "store", random_episodes(LENGTHS), some_states())
    for episodes, ends, length, message in (
        ([0], [LENGTHS[0]], 2, "episode 0 has 3 steps, none numbered 3"),
        ([-1], [0], 2, "no episodes -1 to -1"),
        ([0, len(LENGTHS)], [0, 0], 2, f"no episodes 0 to {len(LENGTHS)}"),
        ([[0]], [[0]], 2, "two arrays of the same length"),
        ([0], [0], 0, "at least 1 step"),
    ):
        with pytest.raises(InputError, match=message):
            store.windows(np.array(episodes), np.array(ends), length)
    with pytest.raises(InputError, match="no split is called 'training'; there are train, valid"):
        store.split("training")
    with pytest.raises(InputError, match="no column 'action'"):
        store.step_values(schema.ACTION, np.array([0]), np.array([0]))


def test_columns_are_mapped_when_they_are_used(tmp_path: Path) -> None:
    store = write_store(tmp_path / "store", random_episodes(LENGTHS, items=False))
    at = np.array([0]), np.array([0])
    before = float(store.step_values(schema.REWARD, *at)[0])
    column = np.load(tmp_path / "store" / "shard-00000" / "reward.npy", mmap_mode="r+")
    column[0] = before + 1
    column.flush()
    assert store.step_values(schema.REWARD, *at)[0] == before + 1
    for file in tmp_path.glob("store/shard-*/*"):
        file.write_bytes(bytes(file.stat().st_size))
    assert EpisodeStore.open(store.path).record.n_steps == sum(LENGTHS)


def use(store: EpisodeStore) -> None:
    store.episode_values(schema.USER)
    all_windows(store, 3)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "cut in the data": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "not numpy": lambda path: path.write_bytes(b"PK or something else entirely" * 9),
    "a flipped bit": lambda path: path.write_bytes(
        (content := path.read_bytes())[:-1] + bytes([content[-1] ^ 16])
    ),
}
COLUMNS = ("reward", "item", "return_to_go", "offsets", "user")


@pytest.mark.parametrize(
    ("column", "damage"), [*product(COLUMNS, ["a flipped bit"]), *product(["item"], DAMAGE)]
)
def test_a_damaged_column_is_named(tmp_path: Path, column: str, damage: str) -> None:
    store = write_store(tmp_path / "store", random_episodes(LENGTHS), some_states(), shard_steps=6)
    DAMAGE[damage](tmp_path / "store" / "shard-00001" / f"{column}.npy")
    with pytest.raises(InputError, match=rf"shard-00001/{column}\.npy"):
        use(EpisodeStore.open(store.path))


@pytest.mark.parametrize(
    ("column", "change", "message"),
    [
        ("reward", lambda values: values[:-1], "'reward' has 31 of 32 steps"),
        ("offsets", lambda values: values[[0, 2, 1, *range(3, 9)]], "do not ascend from 0"),
        ("offsets", lambda values: np.put(values, [1, 2], [2**63 - 1, -(2**63)]), "do not ascend"),
        ("item", lambda values: np.put(values, 3, 10**6), "has items from 0 to 1000000, there are"),
    ],
)
def test_a_column_that_cannot_be_is_named(
    tmp_path: Path, column: str, change: Callable[[Array], Array | None], message: str
) -> None:
    store = write_store(tmp_path / "store", random_episodes(LENGTHS), some_states())
    path = store.path / "shard-00000" / f"{column}.npy"
    values = np.load(path)
    changed = change(values)
    np.save(path, values if changed is None else changed)
    with pytest.raises(InputError, match=rf"{column}\.npy "):
        use(EpisodeStore.open(store.path))
    # Without checksums.
    write_json(store.path / "meta.json", {**read_json(store.path / "meta.json"), "files": {}})
    with pytest.raises(InputError, match=message):
        use(EpisodeStore.open(store.path))


def test_steps_in_batches_are_all_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_module, "_BATCH_STEPS", 7)
    store = write_store(tmp_path / "store", random_episodes(LENGTHS), some_states(), shard_steps=6)
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
