"""Screening of states finds what causes nothing, keeps what causes something, and is acted on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tensors import assert_same_tensors
from ucfrec import schema
from ucfrec.arrays import Float64Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import TrainingEpisodes
from ucfrec.episodes.writer import read_observations, write_observations
from ucfrec.errors import InputError
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.refit import refit
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.training import train
from ucfrec_control.training.screening import (
    TREATMENT,
    DimensionReport,
    ScreeningConfig,
    ScreeningReport,
    read_screening,
    screen_states,
)
from ucfrec_control.training.train import make_interventions, train_control

FAST = ScreeningConfig(hidden=48, shared_steps=300, own_steps=100, trees=25)
SOURCE = {"where": "planted", "dataset": "planted", "env_id": None, "versions": {}}


def written(
    out: Path, states: Float64Array, actions: Float64Array, rewards: Float64Array
) -> EpisodeStore:
    """The store of states (E, T, S), actions (E, T, 1) and rewards (E, T)."""
    trajectories, length = rewards.shape
    columns = {
        schema.OBSERVATION: states.reshape(-1, states.shape[2]).astype(np.float32),
        schema.ACTION: actions.reshape(-1, 1).astype(np.float32),
        schema.REWARD: rewards.reshape(-1).astype(np.float32),
    }
    # As control stores are split: every twentieth is for validation.
    split = {schema.SPLIT: (np.arange(trajectories) % 20 == 10).astype(np.int8)}
    return EpisodeStore.write(out, columns, np.full(trajectories, length), split, source=SOURCE)


def planted_vectors(
    out: Path, trajectories: int = 60, length: int = 40, jolt: float = 0.0
) -> EpisodeStore:
    """Five dimensions: 0 drives 1, 1 drives 0 and the reward, 2 the reward alone, 3 measures the
    reward, 4 is noise. 3 and 4 have no effect. In 0.3% of the steps 1 is jolted by `jolt`."""
    rng = np.random.default_rng(0)
    shape = (trajectories, length)
    states, actions = np.zeros((*shape, 5)), rng.uniform(-1, 1, (*shape, 1))
    states[:, :, [2, 4]] = rng.normal(size=(*shape, 2))
    states[:, 0, :2] = rng.normal(size=(trajectories, 2))
    for t in range(length - 1):
        x, y = states[:, t, 0], states[:, t, 1]
        states[:, t + 1, 0] = 0.8 * x + 0.5 * np.tanh(y) + 0.2 * actions[:, t, 0]
        states[:, t + 1, 1] = 0.7 * y - 0.6 * x + 0.3 * rng.normal(size=trajectories)
        if jolt:
            states[:, t + 1, 1] += jolt * (rng.random(trajectories) < 0.003)
    rewards = states[:, :, 1] + np.abs(states[:, :, 2]) + 0.3 * actions[:, :, 0]
    states[:, :, 3] = rewards > np.median(rewards)
    return written(out, states, actions, rewards)


def planted_category(out: Path, moves: float = 0.5, noise: float = 0.0) -> EpisodeStore:
    """Eight dimensions: 0 drives itself and the reward, to which `noise` is added, 1 to 5 are of a
    category that a trajectory keeps and that moves the reward, 6 is whether it is high, 7 is 0."""
    rng, trajectories, length = np.random.default_rng(0), 150, 12
    shape = (trajectories, length)
    states, actions = np.zeros((*shape, 8)), rng.uniform(-1, 1, (*shape, 1))
    category = rng.integers(5, size=trajectories)
    states[np.arange(trajectories), :, 1 + category] = 1.0
    states[:, 0, 0] = rng.normal(size=trajectories)
    for t in range(length - 1):
        drift = 0.3 * rng.normal(size=trajectories)
        states[:, t + 1, 0] = 0.8 * states[:, t, 0] + 0.4 * actions[:, t, 0] + drift
    rewards = states[:, :, 0] + moves * category[:, None] + 0.8 * actions[:, :, 0]
    rewards += noise * np.random.default_rng(1).normal(size=shape)
    states[:, :, 6] = rewards > np.median(rewards)
    return written(out, states, actions, rewards)


def test_what_causes_nothing_is_flagged_and_nothing_else(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store")
    report = screen_states(store.split("train"), FAST, seed=0)
    assert report.flagged == (3, 4)
    first, _, third, fourth, _ = report.dimensions
    assert first.helps[0] == 1
    assert abs(fourth.effect) < 0.03 < 0.1 < first.effect
    assert fourth.reward_effect < 0.01 < 0.1 < third.reward_effect
    assert screen_states(store.split("train"), FAST, seed=0) == report
    few = planted_vectors(tmp_path / "few", trajectories=8)
    with pytest.raises(InputError, match="screening needs at least 15"):
        screen_states(few.split("train"), FAST, seed=0)


def test_a_few_violent_steps_do_not_decide(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store", jolt=40.0)
    report = screen_states(store.split("train"), FAST, seed=0)
    assert report.flagged == (3, 4)
    # What they would decide: that nearly nothing helps to predict what is jolted.
    uncapped = screen_states(store.split("train"), replace(FAST, capped=0.0), seed=0)
    assert uncapped.dimensions[0].effect < 0.02 < 0.08 < report.dimensions[0].effect


def test_a_few_far_episodes_do_not_decide(tmp_path: Path) -> None:
    """0 drives the reward alone, and 1 drives 2."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(100, 40, 3)), rng.uniform(-1, 1, (100, 40, 1))
    states[2::10, :, :2] *= 3
    squares = states[:, :, :2] ** 2
    states[:, 1:, 2] = squares[:, :-1, 1]
    store = written(tmp_path / "store", states, actions, actions[:, :, 0] + squares[:, :, 0])
    assert screen_states(store.split("train"), FAST, seed=0).flagged == (2,)


def test_indicators_of_a_category_are_kept_beside_a_measurement(tmp_path: Path) -> None:
    """One by one they follow from the others, and never change within an episode."""
    store = planted_category(tmp_path / "store")
    report = screen_states(store.split("train"), FAST, seed=0)
    assert report.flagged == (6, 7)
    indicators = report.dimensions[1:6]
    assert all(each.reward_effect < 0.01 for each in indicators)
    assert all(not set(each.helps) & {1, 2, 3, 4, 5} for each in report.dimensions)


def test_weak_causes_of_a_noisy_reward_are_kept(tmp_path: Path) -> None:
    """Where a quarter of the reward is noise, no visible help is not evidence."""
    store = planted_category(tmp_path / "store", moves=0.05, noise=0.5)
    report = screen_states(store.split("train"), FAST, seed=0)
    assert report.flagged == (6,)
    # Taken as evidence, the same help would do away with the category.
    trusting = screen_states(store.split("train"), replace(FAST, min_reward_r2=0.5), seed=0)
    assert set(trusting.flagged) >= {1, 2, 3, 4, 5, 6}


SETTINGS = ["train.steps=4", "train.validate_every=2", "policy.dim=8", "policy.context=3"]
SETTINGS += ["augment.copies=1", "crm.epochs=1", "csg.epochs=1"]
FLAGGED = (0, 4)


def screen_as(flagged: Sequence[int]) -> Callable[[EpisodeStore, int], ScreeningReport]:
    def screen(store: EpisodeStore, seed: int) -> ScreeningReport:
        dimensions = (DimensionReport(d, causes=d not in flagged) for d in range(store.state_size))
        return ScreeningReport(tuple(dimensions), 0.5, 100)

    return screen


@pytest.fixture
def _known_verdicts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "screen_store", screen_as(FLAGGED))


@pytest.mark.usefixtures("_known_verdicts")
def test_what_is_dropped_might_never_have_been_logged(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store", 30, 8)
    kept = np.delete(read_observations(store), FLAGGED, axis=1)
    never = write_observations(store, tmp_path / "never", kept, {})
    config = resolve_config("ucf", None, SETTINGS)
    record = train_control(store, tmp_path / "dropped", config, screening="drop")
    plain = train_control(never, tmp_path / "plain", config)
    assert record.dropped_observations == FLAGGED
    assert record.sizes == plain.sizes
    names = ("augmented", "policy/last", "policy/best")
    assert_same_tensors(tmp_path / "dropped", tmp_path / "plain", *names)
    # The actor is shown everything that was logged, and sees what is left.
    seen = np.random.default_rng(0).normal(size=(6, 5)).astype(np.float32)
    decided = []
    for run, shown in (("dropped", seen), ("plain", np.delete(seen, FLAGGED, axis=1))):
        actor = TrainedPolicy.load(tmp_path / run).actor(6)
        actor.begin(np.arange(6))
        decided.append(actor.act(shown, np.ones(6, dtype=bool))[0])
    np.testing.assert_array_equal(*decided)


@pytest.mark.usefixtures("_known_verdicts")
def test_a_run_goes_on_as_it_was_started_and_is_refitted_so(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store", 30, 8)
    config = resolve_config("bc", None, SETTINGS)
    record = train_control(store, tmp_path / "run", config, screening="drop")
    again = train_control(store, tmp_path / "run", config, screening="drop")
    assert again.policy == record.policy
    assert read_screening(again) == read_screening(record)
    for other in ("copies", None):
        with pytest.raises(InputError, match="was started with --screen drop"):
            train_control(store, tmp_path / "run", config, screening=other)
    whole = refit(store, tmp_path / "run", tmp_path / "whole")
    assert (whole.sizes, whole.dropped_observations) == (record.sizes, FLAGGED)
    assert read_screening(whole) == read_screening(record)


def test_shared_stages_are_screened_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    screened_stores = []

    def screen(store: EpisodeStore, seed: int) -> ScreeningReport:
        screened_stores.append((store.path, seed))
        return screen_as(FLAGGED)(store, seed)

    monkeypatch.setattr(train, "screen_store", screen)
    stores = [planted_vectors(tmp_path / str(n), n, 8) for n in (30, 31)]
    reports = []
    for store, how, seed in product(stores, ("copies", "drop"), (0, 1)):
        config = resolve_config("bc", None, SETTINGS, seed)
        out = tmp_path / f"{store.path.name}-{how}-{seed}"
        record = train_control(store, out, config, screening=how, shared=tmp_path / "stages")
        reports.append((record.extra[TREATMENT], read_screening(record)))
    assert screened_stores == [(store.path, 0) for store in stores]
    assert [how for how, _ in reports[:3]] == ["copies", "copies", "drop"]
    assert reports[0] == reports[1]
    record = RunRecord.read(tmp_path / "30-copies-0")
    assert (record.dropped_observations, record.sizes["state"]) == ((), stores[0].state_size)


def test_screening_must_leave_some_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "screen_store", screen_as(range(5)))
    store, config = planted_vectors(tmp_path / "store", 30, 8), resolve_config("bc", None, SETTINGS)
    with pytest.raises(InputError, match="no effect of any of the 5 state dimensions"):
        train_control(store, tmp_path / "run", config, screening="drop")
    assert not (tmp_path / "run").exists()


def test_interventions_change_the_flagged_dimensions_alone(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store", trajectories=20, length=30)
    view = store.split("train")
    made = make_interventions(view, [1, 4], seed=5)
    union = TrainingEpisodes(view, made)
    n = view.n_episodes
    assert union.n_steps == 3 * view.n_steps
    windows = union.windows(np.arange(3 * n), np.tile(view.lengths - 1, 3), 30)
    factual, held, redrawn = windows.states.chunk(3)
    for copy in (held, redrawn):
        assert torch.equal(copy[..., [0, 2, 3]], factual[..., [0, 2, 3]])
    assert torch.equal(held[:, 1:, [1, 4]], held[:, :-1, [1, 4]])
    assert (redrawn[:, 1:, 4] != redrawn[:, :-1, 4]).float().mean() > 0.9
    # Jointly from the marginal: every pair of values is some step's own.
    pairs = {tuple(pair) for pair in factual[..., [1, 4]].reshape(-1, 2).tolist()}
    drawn = redrawn[..., [1, 4]].reshape(-1, 2)
    assert all(tuple(pair) in pairs for pair in drawn.tolist())
    assert abs(np.corrcoef(drawn[:, 0], factual[..., 1].reshape(-1))[0, 1]) < 0.15
    again = make_interventions(view, [1, 4], seed=5)
    np.testing.assert_array_equal(again.edit_state, made.edit_state)
