"""What the models see: the policy's window and the return left, the same from disk as at once."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ucfrec.acting.decision import DecisionRule
from ucfrec.logs import LogMapping
from ucfrec.off_policy.evaluate import step_features
from ucfrec.off_policy.features import (
    ROWS_AT_ONCE,
    InputsFile,
    StepInputs,
    array_on_disk,
    scores_of,
)
from ucfrec.off_policy.score import LoggedSessions, logged_sessions, scored_steps
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture
def logged(folder: Path, trained: TrainedPolicy) -> Iterator[LoggedSessions]:
    with logged_sessions(trained, [folder / "rest.parquet"], LogMapping()) as logged:
        yield logged


def inputs_of(steps: int, seed: int) -> StepInputs:
    generator = torch.Generator().manual_seed(seed)
    parts = [torch.randn(steps, size, generator=generator) for size in (20, 4, 4, 2)]
    return StepInputs(parts[0], 15, *parts[1:])


def test_a_file_gives_back_what_was_written(tmp_path: Path) -> None:
    sizes = [3, ROWS_AT_ONCE, 500]
    with InputsFile() as file:
        for seed, steps in enumerate(sizes):
            file.append(inputs_of(steps, seed))
        for _ in range(2):  # as often as it is read
            found = [np.concatenate(parts) for parts in zip(*file.chunks(), strict=True)]
            expected = [inputs_of(steps, seed).features() for seed, steps in enumerate(sizes)]
            for mine, theirs in zip(found, zip(*expected, strict=True), strict=True):
                np.testing.assert_array_equal(mine, np.concatenate(theirs))
        states = np.concatenate(list(file.states()))
        assert states.shape == (sum(sizes), 15)
    assert not list(tmp_path.iterdir())


def test_context_is_the_state_the_return_left_and_the_window(
    trained: TrainedPolicy, logged: LoggedSessions
) -> None:
    """Two targets differ in the return left, and in what the policy makes of it."""
    seen = []
    for target in (3.0, 5.0):
        rule = DecisionRule(target, temperature=1.0)
        batch = next(scored_steps(trained, logged.store, rule))
        seen.append(step_features(trained, batch)[2])
        earned = torch.zeros(len(batch.steps))
        for row, (episode, step) in enumerate(zip(batch.episodes, batch.steps, strict=True)):
            steps = np.arange(step)
            values = logged.store.step_values("reward", np.full(step, episode), steps)
            earned[row] = float(values.sum())
        left = seen[-1].context[:, seen[-1].state_size]
        torch.testing.assert_close(left, target - earned, atol=1e-4, rtol=1e-4)
    size = seen[0].state_size
    torch.testing.assert_close(seen[0].context[:, :size], seen[1].context[:, :size])
    assert seen[0].context.shape[1] == size + 1 + trained.policy.config.dim
    assert not torch.allclose(seen[0].context[:, size + 1 :], seen[1].context[:, size + 1 :])


def test_features_are_those_that_the_scores_are_made_from(
    trained: TrainedPolicy, logged: LoggedSessions
) -> None:
    batch = next(scored_steps(trained, logged.store, DecisionRule(3.0)))
    assert batch.features is not None
    predicted = trained.policy.head.predict(batch.features)  # type: ignore[call-arg]
    without_exposure = trained.policy.head.exposure is None
    if without_exposure:
        torch.testing.assert_close(batch.scores, predicted.detach())
    assert batch.features.shape == (len(batch.steps), trained.policy.config.dim)


def test_scores_are_of_the_item_and_their_mean_over_what_is_shown() -> None:
    logs = torch.tensor([[0.5, 0.25, 0.25], [1e-30, 0.5, 0.5]]).log()
    shown = torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.25, 0.25]])
    chosen, mean = scores_of(logs, torch.tensor([0, -1]), shown)
    half = float(np.log(0.5))
    torch.testing.assert_close(mean, torch.tensor([np.log(0.25), 0.5 * -20 + 0.5 * half]).float())
    torch.testing.assert_close(chosen, torch.tensor([half, float(mean[1])]))


def test_an_array_keeps_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    values = array_on_disk((1000, 3))
    assert values.shape == (1000, 3)
    assert not values.any()
    numbers = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    values[:] = numbers
    np.testing.assert_array_equal(values, numbers)
    assert not list(tmp_path.iterdir())
    assert array_on_disk((0, 3)).shape == (0, 3)
