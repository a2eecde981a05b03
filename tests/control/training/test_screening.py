"""Screening of states finds what causes nothing, and keeps what causes something."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.causes import planted_category, planted_vectors
from ucfrec.counterfactual import screening
from ucfrec.errors import InputError
from ucfrec_control.training.screening import ScreeningConfig, screen_states

FAST = ScreeningConfig(hidden=48, shared_steps=300, own_steps=100)


@pytest.fixture(autouse=True)
def _few_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "TREES", 25)


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
