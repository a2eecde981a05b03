"""What the models see: the policy's window and the return left, the same from disk as at once."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ucfrec.acting.decision import DecisionRule
from ucfrec.logs import LogMapping
from ucfrec.off_policy.features import ROWS_AT_ONCE, InputsFile, StepInputs, make_inputs
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


def test_a_file_gives_back_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    sizes = [3, ROWS_AT_ONCE, 500]
    file = InputsFile(sum(sizes))
    for seed, steps in enumerate(sizes):
        file.append(inputs_of(steps, seed))
    expected = [inputs_of(steps, seed).features() for seed, steps in enumerate(sizes)]
    for _ in range(2):  # as often as it is read
        features = [np.concatenate(parts) for parts in zip(*file.chunks(), strict=True)]
        for mine, theirs in zip(features, zip(*expected, strict=True), strict=True):
            np.testing.assert_array_equal(mine, np.concatenate(theirs))
    assert np.concatenate(list(file.states())).shape == (sum(sizes), 15)
    assert not list(tmp_path.iterdir())


def test_context_is_the_state_the_return_left_and_the_window(
    trained: TrainedPolicy, logged: LoggedSessions
) -> None:
    """Two targets differ in the return left, and in what the policy makes of it."""
    seen = []
    for target in (3.0, 5.0):
        rule = DecisionRule(target, temperature=1.0)
        batch = next(scored_steps(trained, logged.store, rule))
        seen.append(make_inputs(trained, batch)[2])
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
    if trained.policy.head.exposure is None:
        predicted = trained.policy.head.predict(batch.features)  # type: ignore[call-arg]
        torch.testing.assert_close(batch.scores, predicted.detach())
    assert batch.features.shape == (len(batch.steps), trained.policy.config.dim)


def test_scores_are_of_the_item_and_their_mean_over_what_is_shown(
    trained: TrainedPolicy, logged: LoggedSessions
) -> None:
    """Of an unknown item, the mean; what is all but impossible counts as e^−20."""
    batch = next(scored_steps(trained, logged.store, DecisionRule(3.0, temperature=1.0)))
    items = batch.items.clone()
    items[1] = -1
    batch = replace(batch, items=items, scores=batch.scores.clone())
    batch.scores[:, 5] = -1e9
    scores = batch.scores.log_softmax(-1).clamp(min=-20)
    target, shown, inputs = make_inputs(trained, batch)
    torch.testing.assert_close(inputs.scores[:, 1], (shown * scores).sum(1))
    assert inputs.scores[0, 0] == scores[0, items[0]]
    assert inputs.scores[1, 0] == inputs.scores[1, 1]
    assert target[1] == 0
    assert not inputs.chosen[1].any()
