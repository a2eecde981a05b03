"""Action copies in a view, against what a slow reader makes of their sources."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.episodes import (
    Logged,
    random_action_augmentation,
    random_episodes,
    random_overlay,
    some_states,
    state_before,
    write_store,
)
from ucfrec import schema
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay
from ucfrec.errors import InputError

LENGTHS = [4, 1, 7, 3]
definitions = st.one_of(
    st.just(ReturnToGo()),
    st.sampled_from([0.25, 0.5, 1.0]).map(lambda gamma: ReturnToGo("discounted", gamma)),
    st.integers(1, 5).map(lambda steps: ReturnToGo("horizon", horizon=steps)),
)


def copied(episodes: list[Logged], overlay: Overlay, copy: int) -> Logged:
    """An action copy with everything that followed in its source, and its own action and reward."""
    source, step = episodes[overlay.action_source[copy]], overlay.action_step[copy]
    rewards, items = list(source.rewards), list(source.items)
    rewards[step] = float(overlay.action_reward[copy])
    if source.actions is None:
        items[step] = int(overlay.action[copy])
        return replace(source, rewards=rewards, items=items)
    actions = source.actions.copy()
    actions[step] = overlay.action[copy]
    return replace(source, rewards=rewards, actions=actions)


@given(
    lengths=st.lists(st.integers(1, 7), min_size=2, max_size=4),
    definition=definitions,
    items=st.booleans(),
    edits=st.integers(0, 3),
    length=st.integers(1, 8),
    seed=st.integers(0, 99),
)
def test_action_augmentation_are_their_source_up_to_their_own_last_step(
    lengths: list[int], definition: ReturnToGo, items: bool, edits: int, length: int, seed: int
) -> None:
    episodes, states = random_episodes(lengths, seed, items=items), some_states() if items else None
    with tempfile.TemporaryDirectory() as name:
        base = write_store(Path(name) / "store", episodes, states, shard_steps=6)
        base = base.with_return_to_go(definition)
        logged = every_value(base, length)
        overlay = random_action_augmentation(base, 4, seed)
        union = base.with_overlay(random_overlay(base, edits, seed)[0].joined(overlay))
        first = len(base) + edits
        assert len(union) == first + 4
        assert union.lengths[first:].tolist() == (overlay.action_step + 1).tolist()
        assert union.n_steps == union.lengths[:first].sum() + 4
        assert not union.terminated[first:].any()
        for copy in range(4):
            whole, step = copied(episodes, overlay, copy), int(overlay.action_step[copy])
            expected = definition.of_logs(np.array(whole.rewards), np.array([0, len(whole)]))
            window = union.windows(np.array([first + copy]), np.array([step]), length)
            kept = slice(max(0, step + 1 - length), step + 1)
            assert window.mask[0].sum() == kept.stop - kept.start
            valid = window.mask[0]
            np.testing.assert_allclose(
                window.returns_to_go[0][valid], expected[kept], rtol=1e-6, atol=1e-6
            )
            assert window.rewards[0][valid].tolist() == whole.rewards[kept]
            taken = whole.items if whole.actions is None else whole.actions.tolist()
            assert window.actions[0][valid].tolist() == taken[kept]
            before = [state_before(whole, k, states) for k in range(kept.start, kept.stop)]
            np.testing.assert_allclose(window.states[0][valid], before, rtol=1e-4, atol=1e-5)
            for value in (window.actions, window.rewards, window.returns_to_go, window.states):
                assert not value[0][~valid].any()
            np.testing.assert_allclose(union.returns[first + copy], expected[0], atol=1e-6)
        # Neither the logged episodes nor a view without the copies notice them.
        assert same_values(logged, every_value(base, length))
        rows = np.arange(base.n_steps)
        assert same_values(logged, every_value(union, length, rows))


def every_value(
    view: EpisodeStore, length: int, rows: np.ndarray | None = None
) -> dict[str, torch.Tensor]:
    rows = np.arange(view.n_steps) if rows is None else rows
    windows = view.windows(*view.locate(rows), length)
    return {**vars(windows), "returns": torch.from_numpy(view.returns[: len(view.episode_ids)])}


def same_values(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(value, second[name]) for name, value in first.items())


@pytest.mark.parametrize("items", [True, False])
def test_training_draws_the_last_step_of_an_action_copy_alone(tmp_path: Path, items: bool) -> None:
    states = some_states() if items else None
    base = write_store(tmp_path / "store", random_episodes(LENGTHS, items=items), states)
    overlay = random_overlay(base, 2, seed=1)[0].joined(random_action_augmentation(base, 5, seed=2))
    union = base.with_overlay(overlay)
    episodes, steps = union.all_steps()
    first = len(base) + 2
    pairs = [(e, t) for e, n in enumerate(union.lengths[:first]) for t in range(n)]
    pairs += [(first + copy, int(step)) for copy, step in enumerate(overlay.action_step)]
    assert list(zip(episodes, steps, strict=True)) == pairs
    again = union.locate(np.arange(union.n_steps))
    assert np.array_equal(again[0], episodes)
    assert np.array_equal(again[1], steps)
    drawn = set(zip(*union.draw_steps(np.random.default_rng(0), 2_000), strict=True))
    assert drawn == set(pairs)
    moved = union.transitions(episodes[-5:], steps[-5:])
    assert moved.last.all()
    assert not moved.next_states.any()
    own = torch.from_numpy(overlay.action)
    assert torch.equal(moved.actions, base.action_vectors(own))
    assert moved.rewards.tolist() == overlay.action_reward.tolist()
    # Columns that an action copy does not change are its source's.
    times = union.step_values(schema.TIMESTAMP, episodes[-5:], steps[-5:])
    position = {int(number): at for at, number in enumerate(base.episode_ids)}
    source = np.array([position[int(number)] for number in overlay.action_source])
    assert np.array_equal(times, base.step_values(schema.TIMESTAMP, source, steps[-5:]))


def test_no_state_of_an_action_copy_depends_on_its_action(tmp_path: Path) -> None:
    base = write_store(tmp_path / "store", random_episodes(LENGTHS), some_states(window=5))
    overlay = random_action_augmentation(base, 8, seed=3)
    other = replace(overlay, action=(overlay.action + 1) % 11, action_reward=-overlay.action_reward)
    at = len(base) + np.arange(8), overlay.action_step
    first, second = (base.with_overlay(each).windows(*at, 6) for each in (overlay, other))
    assert torch.equal(first.states, second.states)
    assert torch.equal(first.actions[:, :-1], second.actions[:, :-1])
    assert not torch.equal(first.actions[:, -1], second.actions[:, -1])


def test_what_an_action_copy_says_of_the_steps_before(tmp_path: Path) -> None:
    base = write_store(tmp_path / "store", random_episodes(LENGTHS), some_states())
    overlay = random_action_augmentation(base, 6, seed=4)
    union, copies = base.with_overlay(overlay), len(base) + np.arange(6)
    position = {int(number): at for at, number in enumerate(base.episode_ids)}
    source = np.array([position[int(number)] for number in overlay.action_source])
    before = union.rewards_before(copies, overlay.action_step)
    assert np.array_equal(before, base.rewards_before(source, overlay.action_step))
    for one, other in zip(
        union.items_before(copies, overlay.action_step),
        base.items_before(source, overlay.action_step),
        strict=True,
    ):
        assert np.array_equal(one, other)
    assert repr(union).count("6 action copies") == repr(overlay).count("6 action copies") == 1
    with pytest.raises(InputError, match=r"has 3 steps, none numbered|steps are numbered from 0"):
        union.windows(copies[:1], overlay.action_step[:1] + 1, 2)
