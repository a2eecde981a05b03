"""States are identical in training and in acting, and do not depend on later steps."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.support.episodes import DIM, N_ITEMS, Logged, random_episodes, some_states, write_store
from ucfrec.episodes.states import TAGS_PER_ITEM, ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, save_tensors

lengths_of_episodes = st.lists(st.integers(1, 12), min_size=1, max_size=7)


def acted(episodes: list[Logged], states: ItemStates, rows: int) -> list[Tensor]:
    """(T, S) states of each episode, played `rows` at a time as `rollout` plays them: row i plays
    episodes i, i + rows, …, and starts the next while the others are under way."""
    sessions = Sessions.begun(rows, states.window)
    seen: list[list[Tensor]] = [[] for _ in episodes]
    playing, step = list(range(rows)), [0] * rows
    sessions.begin(np.arange(rows))
    size = episodes[0].observations.shape[1]
    while any(number < len(episodes) for number in playing):
        live = [row for row in range(rows) if playing[row] < len(episodes)]
        observations = torch.full((rows, size), 5.0)
        # Rows without an episode get arbitrary values, which must not affect the others.
        items, rewards = np.full(rows, 1), np.full(rows, 2.0)
        for row in live:
            logged = episodes[playing[row]]
            sessions.users[row] = logged.user
            observations[row] = torch.from_numpy(logged.observations[step[row]])
            items[row], rewards[row] = logged.items[step[row]], logged.rewards[step[row]]
        current = sessions.latest_states(states, observations)
        for row in live:
            seen[playing[row]].append(current[row])
        sessions = sessions.add_step(torch.from_numpy(items), torch.from_numpy(rewards))
        ended = []
        for row in live:
            step[row] += 1
            if step[row] == len(episodes[playing[row]]):
                playing[row], step[row] = playing[row] + rows, 0
                ended.append(row)
        sessions.begin(np.array(ended, dtype=np.int64))
    return [torch.stack(states_of_one) for states_of_one in seen]


@settings(max_examples=50)
@given(
    lengths=lengths_of_episodes,
    rows=st.integers(1, 9),
    length=st.integers(1, 9),
    window=st.integers(1, 5),
    users=st.integers(0, 2),
    observation=st.integers(0, 3),
    seed=st.integers(0, 99),
)
def test_training_and_acting_agree_to_the_last_bit(
    lengths: list[int], rows: int, length: int, window: int, users: int, observation: int, seed: int
) -> None:
    episodes = random_episodes(lengths, seed, observation)
    rng = np.random.default_rng(seed)
    for episode in episodes:  # rewards with all their digits, as an environment gives them
        episode.rewards = rng.normal(0.5, 2.0, size=len(episode)).tolist()
    states = some_states(users, window, seed)
    with tempfile.TemporaryDirectory() as name:
        store = write_store(Path(name) / "store", episodes, states, shard_steps=7)
        windows = store.windows(*store.all_steps(), length)
        moved = store.transitions(*store.all_steps())
    played = torch.cat(acted(episodes, states, rows))
    assert torch.equal(windows.states[:, -1], played)
    assert torch.equal(moved.states, played)
    for back in range(1, length):
        inside = windows.mask[:, -1 - back]
        ends = torch.nonzero(inside).squeeze(1)
        assert torch.equal(windows.states[ends, -1 - back], played[ends - back])


@pytest.mark.parametrize("batch", [1, 3, 7, 8, 17, 64, 1000])
def test_bits_do_not_depend_on_the_batch(batch: int) -> None:
    """Vectorised kernels end in a remainder; no row may notice where it stands."""
    generator = torch.Generator().manual_seed(0)
    states = some_states(users=2, window=4)
    given = (
        torch.randint(-1, N_ITEMS, (1000, 6), generator=generator),
        torch.randn(1000, 6, generator=generator),
        torch.randint(5000, (1000, 3), generator=generator),
        torch.randint(-1, 5, (1000,), generator=generator),
        torch.randn(1000, 3, 3, generator=generator),
    )
    parts = zip(*(each.split(batch) for each in given), strict=True)
    assert torch.equal(torch.cat([states.build(*part) for part in parts]), states.build(*given))


def test_rewards_out_of_range_count_as_no_or_full_liking() -> None:
    states = some_states(low=0.0, high=1.0)
    sessions = Sessions.begun(4, states.window)
    assert not sessions.latest_states(states, torch.zeros(4, 0)).any()
    sessions = sessions.add_step(torch.ones(4, dtype=torch.int64), torch.tensor([-7.0, 0, 1, 99]))
    seen = sessions.latest_states(states, torch.zeros(4, 0))
    assert torch.equal(seen[0], seen[1])
    assert torch.equal(seen[2], seen[3])
    assert not seen[0, DIM : 2 * DIM].any()
    assert torch.equal(seen[3, DIM : 2 * DIM], states.embeddings[1])


@pytest.mark.parametrize("users", [0, 3])
def test_states_come_back_from_their_file(tmp_path: Path, users: int) -> None:
    tags = torch.arange(2 * N_ITEMS).view(N_ITEMS, 2) % 9 - 1
    states = replace(some_states(users, window=4), tags=tags[:, : users or 1])
    states.save(tmp_path / "states.safetensors")
    read = ItemStates.load(tmp_path / "states.safetensors")
    assert read.size == states.size == 3 * DIM + 2 + users
    for name, value in vars(states).items():
        assert np.array_equal(getattr(read, name), value), name


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"tags": torch.zeros(N_ITEMS, TAGS_PER_ITEM + 1, dtype=torch.int64)}, "of at most 16"),
        ({"tags": torch.zeros(N_ITEMS, 2)}, "integers"),
        ({"tags": torch.full((N_ITEMS, 1), N_ITEMS)}, "integers from -1 to"),
        ({"tags": torch.zeros(N_ITEMS - 1, 1, dtype=torch.int64)}, "one row per item"),
        ({"reward_low": 3.0}, "reward_low must be below reward_high"),
        ({"reward_high": float("nan")}, "reward_low must be below reward_high"),
        ({"window": 2.0}, "have window 2.0"),
        ({"decay": "x"}, "decay 'x'; give 1 to 10,000 and 0 to 1"),
    ],
)
def test_what_strangers_wrote_is_checked(
    tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    path = tmp_path / "states.safetensors"
    some_states().save(path)
    tensors, about = load_tensors(path)
    part = tensors if "tags" in changed else about
    part.update(changed)
    save_tensors(path, tensors, about)
    with pytest.raises(InputError, match=message):
        ItemStates.load(path)


def test_a_damaged_file_of_states_is_named(tmp_path: Path) -> None:
    store = write_store(tmp_path / "store", random_episodes([3, 2]), some_states())
    path = tmp_path / "store" / "item_states.safetensors"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=r"item_states\.safetensors is damaged"):
        EpisodeStore.open(store.path).windows(np.array([0]), np.array([0]), 2)
