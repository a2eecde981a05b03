"""From views of the log to copies of both kinds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.causes import planted_vectors
from tests.support.planted import planted_store
from ucfrec import schema
from ucfrec.counterfactual.augmentation import counterfactual_augmentation, interventions
from ucfrec.counterfactual.generators import CSGConfig
from ucfrec.counterfactual.reward_model import CRMConfig, EffectTransitions
from ucfrec.counterfactual.state_augmentation import AugmentConfig
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay
from ucfrec.user_model.reward_fit import fit_item_reward_model

QUICK = CRMConfig(epochs=2, hidden=32)
LOOSE = AugmentConfig(copies=2, epsilon_r=3.0)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def test_from_views_to_an_overlay(tmp_path: Path) -> None:
    overlay, report = counterfactual_augmentation(
        planted_store().split("train"),
        planted_store().split("validation"),
        QUICK,
        CSGConfig(kind="faithful", epochs=2, hidden=32),
        LOOSE,
        tmp_path,
        seed=0,
    )
    assert report.reward_model.validation_transitions == planted_store().split("validation").n_steps
    assert any(warning.startswith("edit collapse") for warning in report.warnings)
    assert len(overlay.edit_step) > 0


def made(config: AugmentConfig, folder: Path, kind: str = "tangent") -> Overlay:
    views = planted_store().split("train"), planted_store().split("validation")
    csg = CSGConfig(kind=kind, epochs=1, hidden=32)  # type: ignore[arg-type]
    return counterfactual_augmentation(*views, QUICK, csg, config, folder, seed=0)[0]


def test_asking_about_actions_leaves_the_edits_as_they_are(tmp_path: Path) -> None:
    without, with_ = (made(replace(LOOSE, actions=n), tmp_path / str(n)) for n in (0, 2))
    for name in ("copy_source", "edit_copy", "edit_step", "edit_state"):
        assert np.array_equal(getattr(without, name), getattr(with_, name))
    assert len(without.action_source) == 0
    assert len(with_.action_source) > 0


def test_actions_alone_need_no_generator(tmp_path: Path) -> None:
    views = planted_store().split("train"), planted_store().split("validation")
    config = AugmentConfig(copies=0, actions=1, epsilon_r=3.0, reward_quantile=0.5)
    kind = CSGConfig(kind="faithful")
    overlay, report = counterfactual_augmentation(*views, QUICK, kind, config, tmp_path, seed=0)
    assert not (tmp_path / "csg").exists()
    assert (len(overlay.copy_source), report.copies, report.proposals) == (0, 0, 0)
    assert report.verdict == "no state is edited"
    assert report.actions is not None
    assert report.actions.copies == len(overlay.action_source) > 0
    rewards = views[0].step_values(schema.REWARD, *views[0].all_steps())
    logged = planted_store().step_values(schema.REWARD, overlay.action_source, overlay.action_step)
    assert logged.min() >= np.quantile(rewards, 0.5)


def item_store() -> EpisodeStore:
    """Sessions of ten items, of which clicks depend on item and user, and some on what came."""
    rng = np.random.default_rng(0)
    sessions, length, items = 80, 6, 10
    shown = rng.integers(items, size=(sessions, length))
    user = rng.integers(8, size=sessions)
    chance = 1 / (1 + np.exp(-np.linspace(-2, 2, items)[shown] - 0.3 * (user - 4)[:, None]))
    return EpisodeStore.from_arrays(
        {
            schema.ITEM: shown.ravel(),
            schema.REWARD: (rng.random((sessions, length)) < chance).ravel(),
        },
        np.full(sessions, length),
        {schema.USER: user, schema.SPLIT: np.arange(sessions) % 5 == 0},
        ItemStates(
            embeddings=torch.randn(items, 3, generator=torch.Generator().manual_seed(0)),
            user_features=torch.zeros(8, 0),
            reward_low=0.0,
            reward_high=1.0,
        ),
    )


def with_other_items(store: EpisodeStore, overlay: Overlay, copy: int) -> EpisodeStore:
    """The store as if the log had shown the item of an action copy."""
    at = store.all_steps()
    items = store.step_values(schema.ITEM, *at)
    here = (at[0] == overlay.action_source[copy]) & (at[1] == overlay.action_step[copy])
    items[here] = overlay.action[copy]
    return EpisodeStore.from_arrays(
        {schema.ITEM: items, schema.REWARD: store.step_values(schema.REWARD, *at)},
        store.lengths,
        {name: store.episode_values(name) for name in (schema.USER, schema.SPLIT)},
        store.item_states,
    )


def test_additive_effects_read_the_other_item_where_it_would_have_been_shown(
    tmp_path: Path,
) -> None:
    store = item_store()
    train, validation = store.split("train"), store.split("validation")
    config = AugmentConfig(copies=0, actions=2, epsilon_r=10.0)
    crm = CRMConfig(mean="effects", epochs=1, hidden=16)
    overlay, report = counterfactual_augmentation(
        train, validation, crm, CSGConfig(), config, tmp_path, seed=0
    )
    assert report.actions is not None
    assert report.actions.copies > 20
    assert overlay.action_reward.min() >= 0
    assert overlay.action_reward.max() <= 1
    model, _ = fit_item_reward_model(train, validation, tmp_path / "item-reward", 0)
    read, places = EffectTransitions(model), train.n_episodes + np.arange(5)
    copied = read(train.with_overlay(overlay), places, overlay.action_step[:5])
    for copy in range(5):
        episode, step = overlay.action_source[[copy]], overlay.action_step[[copy]]
        shown = read(with_other_items(store, overlay, copy), episode, step)
        torch.testing.assert_close(copied.actions[copy], shown.actions[0])
        # What was not known before the step is not in its state.
        assert torch.equal(shown.states, store.transitions(episode, step).states)


def test_interventions_change_the_flagged_dimensions_alone(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store", trajectories=20, length=30)
    train = store.split("train")
    union = train.with_overlay(interventions(train, [1, 4], seed=5))
    n = train.n_episodes
    assert union.n_episodes == 3 * n
    factual = train.windows(np.arange(n), train.lengths - 1, 30).states
    held, redrawn = (
        union.windows(np.arange(k * n, (k + 1) * n), train.lengths - 1, 30) for k in (1, 2)
    )
    rest = [0, 2, 3]
    for copy in (held, redrawn):
        assert torch.equal(copy.states[..., rest], factual[..., rest])
    assert torch.equal(held.states[:, 1:, [1, 4]], held.states[:, :-1, [1, 4]])
    assert (redrawn.states[:, 1:, 4] != redrawn.states[:, :-1, 4]).float().mean() > 0.9
    # Jointly from the marginal: every pair of values is some step's own.
    pairs = {tuple(pair) for pair in factual[..., [1, 4]].reshape(-1, 2).tolist()}
    drawn = redrawn.states[..., [1, 4]].reshape(-1, 2)
    assert all(tuple(pair) in pairs for pair in drawn.tolist())
    cut = np.corrcoef(drawn[:, 0], factual[..., 1].reshape(-1))[0, 1]
    assert abs(cut) < 0.15
    again = interventions(train, [1, 4], seed=5)
    assert union.overlay is not None
    np.testing.assert_array_equal(again.edit_state, union.overlay.edit_state)


def test_overlays_join_in_order(tmp_path: Path) -> None:
    train = planted_vectors(tmp_path / "store", trajectories=20, length=10).split("train")
    first, second = (interventions(train, [d], seed=d, copies=1) for d in (0, 3))
    union, n = train.with_overlay(first.joined(second)), train.n_episodes
    for k, alone in ((1, first), (2, second)):
        copies = np.arange(k * n, (k + 1) * n)
        there = union.windows(copies, train.lengths - 1, 10).states
        wanted = train.with_overlay(alone).windows(np.arange(n, 2 * n), train.lengths - 1, 10)
        assert torch.equal(there, wanted.states)
