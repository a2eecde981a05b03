"""Screening of states finds what causes nothing, keeps what causes something, and is acted on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.causes import planted_category, planted_vectors
from tests.support.tensors import assert_same_tensors
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
    assert screen_states(store.split("train"), FAST, seed=0).flagged == (3, 4)
    # What they would decide: that nothing helps to predict what is jolted.
    uncapped = screen_states(store.split("train"), replace(FAST, capped=0.0), seed=0)
    assert uncapped.dimensions[0].p_value > FAST.level


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
    """A screening that flags these dimensions."""

    def screen(store: EpisodeStore, seed: int) -> ScreeningReport:
        dimensions = (DimensionReport(d, causes=d not in flagged) for d in range(store.state_size))
        return ScreeningReport(tuple(dimensions), 0.5, 100)

    return screen


@pytest.fixture
def _known_verdicts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Screening itself is tested above; here its verdicts are known."""
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


def test_runs_that_share_stages_are_screened_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_screening_that_leaves_no_state_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
