"""Windows of running sessions are those of a store; augmented episodes against a slow reader."""

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from tests.support.episodes import (
    LENGTHS,
    N_ITEMS,
    Logged,
    all_windows,
    are_equal,
    random_action_copies,
    random_edits,
    random_episodes,
    some_states,
    state_before,
    write_store,
)
from ucfrec import schema
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes, Sessions, TrainingEpisodes, draw_ends

USERS = 3


@pytest.mark.parametrize("context", [1, 4, 20])
@pytest.mark.parametrize("observation", [0, 2])
def test_windows_are_those_of_a_store(context: int, observation: int) -> None:
    rng, states = np.random.default_rng(context), some_states(USERS, 5)
    counts = np.array([0, 1, 30, 3, 7])
    owner = np.repeat(np.arange(len(counts)), counts)
    items, rewards = rng.integers(N_ITEMS, size=41), rng.normal(size=41).astype(np.float32)
    users = rng.integers(-1, USERS, size=len(counts))
    seen = rng.normal(size=(len(counts), observation)).astype(np.float32)
    # The store has the step to decide too, whose item and reward count for nothing.
    ends = np.cumsum(counts)
    columns = {schema.ITEM: np.insert(items, ends, 0), schema.REWARD: np.insert(rewards, ends, 0)}
    if observation:
        columns[schema.OBSERVATION] = np.repeat(seen, counts + 1, axis=0)
    store = EpisodeStore.from_arrays(columns, counts + 1, {schema.USER: users}, states)
    expected = store.windows(np.arange(len(counts)), counts, context)
    observations = torch.from_numpy(seen).unsqueeze(1).expand(-1, 25, -1) if observation else None
    at = store, np.arange(len(counts)), counts
    for length in (context - 1 + states.window, 60):
        requested = Sessions.from_rows(owner, items, rewards, users, length, observations)
        logged = Sessions.from_store(*at, context, length)
        for sessions in (requested, logged):
            windows = sessions.windows(states, context)
            # The windows are the expected ones but for the step to decide.
            for name in ("states", "timesteps", "mask"):
                assert torch.equal(getattr(windows, name), getattr(expected, name))
            for name in ("actions", "rewards"):
                assert torch.equal(getattr(windows, name)[:, :-1], getattr(expected, name)[:, :-1])
                assert not getattr(windows, name)[:, -1].any()
            collected = np.bincount(owner, rewards, minlength=len(counts))
            np.testing.assert_allclose(sessions.collected.numpy(), collected)
            assert sessions.shown.items[2, :3].tolist() == items[30:27:-1].tolist()


definitions = st.sampled_from(
    [ReturnToGo(), *(ReturnToGo("horizon", steps) for steps in range(1, 6))]
)


def make_store(
    folder: Path | str, items: bool = True, lengths: Sequence[int] = LENGTHS
) -> EpisodeStore:
    states, episodes = some_states() if items else None, random_episodes([*lengths], items=items)
    return write_store(Path(folder) / "store", episodes, states, shard_steps=6)


@given(
    lengths=st.lists(st.integers(1, 8), min_size=1, max_size=6),
    copies=st.integers(0, 6),
    share=st.sampled_from([0.0, 0.3, 1.0]),
    length=st.integers(1, 9),
    items=st.booleans(),
    seed=st.integers(0, 5),
)
def test_copies_differ_from_their_source_at_the_edits_and_nowhere_else(
    lengths: list[int], copies: int, share: float, length: int, items: bool, seed: int
) -> None:
    with tempfile.TemporaryDirectory() as name:
        # A view that skips and reorders: copy_source counts episodes of the store.
        store = make_store(name, items, lengths)
        view = store.select(np.arange(len(lengths))[::-1][: max(1, len(lengths) - 1)])
        augmented, edits = random_edits(view, copies, seed, share)
        training = TrainingEpisodes(view, augmented)
        numbers = np.concatenate([view.episode_ids, augmented.copy_source])
        assert training.n_steps == sum(lengths[number] for number in numbers)
        episodes = np.repeat(np.arange(len(numbers)), store.lengths[numbers])
        steps = np.concatenate([np.arange(lengths[number]) for number in numbers])
        windows = training.windows(episodes, steps, length)
        factual = store.windows(numbers[episodes], steps, length)
    expected = factual.states.clone()
    for row, (episode, end) in enumerate(zip(episodes.tolist(), steps.tolist(), strict=True)):
        for column in range(length):
            edit = edits.get((episode - len(view), end - (length - 1) + column))
            if edit is not None:
                assert not torch.equal(expected[row, column], torch.from_numpy(edit))
                expected[row, column] = torch.from_numpy(edit)
    assert are_equal(windows, replace(factual, states=expected))


def follow(episodes: list[Logged], augmented: AugmentedEpisodes, copy: int) -> Logged:
    """An action copy with everything that followed in its source, and its own action and reward."""
    source, step = episodes[augmented.action_source[copy]], augmented.action_step[copy]
    rewards, items = list(source.rewards), list(source.items)
    rewards[step] = float(augmented.action_reward[copy])
    taken = items if source.actions is None else source.actions.copy()
    taken[step] = augmented.action[copy]
    name = "items" if source.actions is None else "actions"
    return replace(source, rewards=rewards, **{name: taken})


@given(
    lengths=st.lists(st.integers(1, 7), min_size=2, max_size=4),
    definition=definitions,
    items=st.booleans(),
    edits=st.integers(0, 3),
    length=st.integers(1, 8),
    seed=st.integers(0, 99),
)
def test_action_copies_are_their_source_up_to_their_own_last_step(
    lengths: list[int], definition: ReturnToGo, items: bool, edits: int, length: int, seed: int
) -> None:
    episodes, states = random_episodes(lengths, seed, items=items), some_states() if items else None
    with tempfile.TemporaryDirectory() as name:
        store = write_store(Path(name) / "store", episodes, states, shard_steps=6)
        store = store.with_return_to_go(definition)
        logged = all_windows(store, length)
        augmented = random_action_copies(store, 4, seed)
        training = TrainingEpisodes(store, random_edits(store, edits, seed)[0].join(augmented))
        first = len(store) + edits
        for copy in range(4):
            whole, step = follow(episodes, augmented, copy), int(augmented.action_step[copy])
            expected = definition.of_logs(np.array(whole.rewards), np.array([0, len(whole)]))
            window = training.windows(np.array([first + copy]), np.array([step]), length)
            rows = slice(max(0, step + 1 - length), step + 1)
            valid = window.mask[0]
            assert valid.sum() == rows.stop - rows.start
            shown = window.returns_to_go[0][valid]
            np.testing.assert_allclose(shown, expected[rows], rtol=1e-6, atol=1e-6)
            assert window.rewards[0][valid].tolist() == whole.rewards[rows]
            taken = whole.items if whole.actions is None else whole.actions.tolist()
            assert window.actions[0][valid].tolist() == taken[rows]
            before = [state_before(whole, k, states) for k in range(rows.start, rows.stop)]
            np.testing.assert_allclose(window.states[0][valid], before, rtol=1e-4, atol=1e-5)
            for value in (window.actions, window.rewards, window.returns_to_go, window.states):
                assert not value[0][~valid].any()
        # The logged episodes do not notice the copies.
        drawn = training.windows(*store.all_steps(), length)
        for windows in (all_windows(store, length), drawn):
            assert are_equal(windows, logged)


@pytest.mark.parametrize("items", [True, False])
def test_steps_are_uniform_and_of_action_copies_the_last(tmp_path: Path, items: bool) -> None:
    store = make_store(tmp_path, items).select(np.array([0, 2, 3, 5]))
    augmented = random_edits(store, 2, seed=1)[0].join(random_action_copies(store, 5, seed=2))
    training = TrainingEpisodes(store, augmented)
    lengths = [LENGTHS[number] for number in (*store.episode_ids, *augmented.copy_source)]
    pairs = [(episode, step) for episode, n in enumerate(lengths) for step in range(n)]
    pairs += [(6 + copy, int(step)) for copy, step in enumerate(augmented.action_step)]
    assert training.n_steps == len(pairs)
    drawn = list(zip(*training.draw_steps(np.random.default_rng(0), 20_000), strict=True))
    counted = Counter(drawn)
    counts = [counted[pair] for pair in pairs]
    assert sum(counts) == len(drawn)
    assert chisquare(counts).pvalue > 1e-3
    again = training.draw_steps(np.random.default_rng(0), 20_000)
    assert list(zip(*again, strict=True)) == drawn


def test_joined_episodes_are_in_order(tmp_path: Path) -> None:
    store = make_store(tmp_path)
    first, second = (random_edits(store, copies, seed=copies)[0] for copies in (3, 2))
    joined = TrainingEpisodes(store, first.join(second))
    for begin, part in ((0, first), (3, second)):
        copies = np.arange(len(part.copy_source))
        ends = store.lengths[part.copy_source] - 1
        alone = TrainingEpisodes(store, part).windows(len(store) + copies, ends, 9)
        windows = joined.windows(len(store) + begin + copies, ends, 9)
        assert torch.equal(windows.states, alone.states)


@pytest.mark.parametrize("copies", [0, 5])
def test_what_is_saved_is_read(tmp_path: Path, copies: int) -> None:
    store = make_store(tmp_path)
    augmented = random_edits(store, copies, seed=5)[0].join(random_action_copies(store, copies, 6))
    augmented.save(tmp_path / "augmented.safetensors")
    read = AugmentedEpisodes.load(tmp_path / "augmented.safetensors")
    for name, values in vars(augmented).items():
        assert getattr(read, name).dtype == values.dtype
        assert np.array_equal(getattr(read, name), values)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(1, 5))
def test_no_step_is_in_less_than_half_as_many_windows(lengths: list[int], length: int) -> None:
    sizes, counts = np.array(lengths), [np.zeros(n) for n in lengths]
    total = int(sizes.sum()) + (length - 1) * len(sizes)
    episodes, ends = draw_ends(AllInTurn(), total, np.cumsum(sizes), sizes, length)  # type: ignore[arg-type]
    for episode, end in zip(episodes, ends, strict=True):
        counts[episode][max(0, end - length + 1) : end + 1] += 1
    assert length <= min(map(min, counts)) <= max(map(max, counts)) < 2 * length


class AllInTurn:
    """Draws every number once."""

    def integers(self, high: int, size: int) -> np.ndarray:
        assert high == size
        return np.arange(high)
