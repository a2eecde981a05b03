"""Models of logged choices and of future reward: what they see, and how good they are."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.logged_steps import steps_of
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float32Array, Float64Array, IntArray
from ucfrec.off_policy.logged_steps import Modelled
from ucfrec.off_policy.models import (
    ROWS_AT_ONCE,
    InputsFile,
    ModelReport,
    StepInputs,
    fit_behavior,
    fit_models,
    group_items,
    make_inputs,
)
from ucfrec.off_policy.score import LoggedSessions, score_steps
from ucfrec.runs.trained_policy import TrainedPolicy


def inputs_of(steps: int, seed: int) -> StepInputs:
    generator = torch.Generator().manual_seed(seed)
    return StepInputs(*(torch.randn(steps, size, generator=generator) for size in (15, 5, 4, 4, 2)))


def test_a_file_gives_back_its_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert file.states.shape == (sum(sizes), 15)
    assert not list(tmp_path.iterdir())


def test_context_holds_the_return_left(trained: TrainedPolicy, logged: LoggedSessions) -> None:
    """Two targets differ in the return left, and in what the policy makes of it."""
    seen = []
    for target in (3.0, 5.0):
        rule = DecisionRule(target, temperature=1.0)
        batch = next(score_steps(trained, logged.store, logged.rows, rule))
        seen.append(make_inputs(trained, batch)[2])
        earned = torch.zeros(len(batch.steps))
        for row, (episode, step) in enumerate(zip(batch.episodes, batch.steps, strict=True)):
            steps = np.arange(step)
            values = logged.store.step_values("reward", np.full(step, episode), steps)
            earned[row] = float(values.sum())
        left = seen[-1].window[:, 0]
        torch.testing.assert_close(left, target - earned, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(seen[0].states, seen[1].states)
    assert seen[0].window.shape[1] == 1 + trained.policy.config.dim
    assert not torch.allclose(seen[0].window[:, 1:], seen[1].window[:, 1:])


def test_scores_of_the_item_and_of_all(trained: TrainedPolicy, logged: LoggedSessions) -> None:
    """Of an unknown item, the mean; what is all but impossible counts as e^−20."""
    batch = next(
        score_steps(trained, logged.store, logged.rows, DecisionRule(3.0, temperature=1.0))
    )
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


GROUP_OF = np.array([0, 0, 0, 1, 1, 2, 2, 2, 2])
STEPS = 6000


def behavior() -> tuple[Float32Array, Float64Array]:
    """States (N, 3), and the probability (N, 9) of every item: groups by the state, items of a
    group alike but for the first, which is shown twice as often."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(STEPS, 3)).astype(np.float32)
    logits = 0.5 * states @ rng.normal(size=(3, 3))
    groups = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    share = np.array([2, 1, 1, 2, 1, 2, 1, 1, 1])
    share = share / np.bincount(GROUP_OF, share)[GROUP_OF]
    return states, groups[:, GROUP_OF] * share


def test_probabilities_are_those_of_the_logging_policy() -> None:
    states, probabilities = behavior()
    drawn, user = np.random.default_rng(1).random((STEPS, 1)), np.arange(STEPS) // 4
    item = (drawn > probabilities.cumsum(axis=1)).sum(axis=1).clip(0, 8)
    model = fit_behavior(states, item, GROUP_OF[item], user, 0)
    true = probabilities[np.arange(STEPS), item]
    assert np.corrcoef(model.item, true)[0, 1] > 0.97
    assert model.log_loss < model.share_log_loss - 0.1
    assert model.calibration_error < 0.05


def test_users_are_predicted_by_models_of_others() -> None:
    """What one user does changes nothing of what is said of that user."""
    states, _ = behavior()
    user = np.arange(STEPS) // 4
    item = np.random.default_rng(3).integers(9, size=STEPS)
    changed = np.where(user == 11, 0, item)
    same = (item == changed) & (user == 11)
    models = [fit_behavior(states, one, GROUP_OF[one], user, 0) for one in (item, changed)]
    np.testing.assert_array_equal(models[0].item[same], models[1].item[same])


@pytest.mark.parametrize("groups", [GROUP_OF, 0 * GROUP_OF])
def test_unknown_items_are_left_alone(groups: IntArray) -> None:
    states, _ = behavior()
    item = np.where(np.arange(STEPS) % 5 == 0, -1, np.arange(STEPS) % 9)
    group = groups[np.maximum(item, 0)]
    model = fit_behavior(states, item, group, np.arange(STEPS), 0)
    assert (model.item[item < 0] == 1).all()
    # Items do not follow the state: each of nine, whatever it is.
    np.testing.assert_allclose(model.item[item >= 0], 1 / 9, rtol=0.1)


def test_groups_are_the_clusters_of_embeddings() -> None:
    rng = np.random.default_rng(0)
    centres, true = 10 * rng.normal(size=(4, 8)), rng.integers(4, size=200)
    embeddings = (centres[true] + 0.1 * rng.normal(size=(200, 8))).astype(np.float32)
    found = group_items(embeddings, seed=0)
    # Of more groups than there are centres, none has items of two.
    assert len(set(zip(true, found, strict=True))) == len(set(found)) == 14


@pytest.mark.parametrize(("items", "groups"), [(1, 1), (80, 9), (2000, 32)])
def test_their_number_follows_the_catalogue(items: int, groups: int) -> None:
    embeddings = np.random.default_rng(0).normal(size=(items, 2)).astype(np.float32)
    assert group_items(embeddings, seed=0).max() + 1 == groups


def chain(sessions: int = 300, length: int = 4, seed: int = 0) -> tuple[Float32Array, ...]:
    """Sessions with a reward of their x at every step; features 1, x and x · steps left."""
    rng = np.random.default_rng(seed)
    x = np.repeat(rng.normal(size=sessions), length)
    left = np.tile(np.arange(length, 0, -1), sessions)
    features = np.column_stack([np.ones(len(x)), x, x * left]).astype(np.float32)
    return features, x + 0.01 * rng.normal(size=len(x)), np.repeat(np.arange(sessions), length)


def fitted(
    features: Float32Array, reward: Float32Array, session: Float32Array, rows: int
) -> tuple[Modelled, ModelReport]:
    def chunks() -> Iterator[tuple[Float32Array, Float32Array]]:
        for begin in range(0, len(features), rows):
            yield features[begin : begin + rows], features[begin : begin + rows]

    return fit_models(chunks, steps_of(reward, session), seed=0)


@pytest.mark.parametrize("rows", [1, 7, 512])
def test_chunks_change_nothing(rows: int) -> None:
    """Also where a session lies in several."""
    features, reward, session = chain()
    found = fitted(features, reward, session, rows)[0]
    whole = fitted(features, reward, session, len(features))[0]
    for name, values in vars(whole).items():
        np.testing.assert_allclose(vars(found)[name], values, rtol=1e-3, atol=1e-4)


def test_q_is_what_is_still_to_come() -> None:
    features, reward, session = chain(3000)
    modelled, report = fitted(features, reward, session, 512)
    # The penalty takes off a little.
    assert np.abs(modelled.q - features[:, 2]).mean() < 0.03
    assert np.abs(modelled.reward - features[:, 1]).mean() < 0.01
    assert 4 < report.iterations < 40
    assert report.converged
    assert report.reward_r2 > 0.99
    assert report.td_loss < 1e-3
    assert abs(report.td_bias) < 0.01
    # A model that knows nothing reports so.
    noise = np.random.default_rng(1).normal(size=(len(features), 3))
    noise[:, 0] = 1
    report = fitted(noise.astype(np.float32), reward, session, 512)[1]
    assert report.reward_r2 < 0.02
    assert report.td_loss == pytest.approx(reward.var(), rel=0.1)


def test_q_that_runs_away_is_stopped_and_said() -> None:
    """The evaluated policy's features are five times the logged: each step multiplies Q."""
    features, reward, session = chain(length=40)
    ones = np.ones((len(features), 1), dtype=np.float32)
    logged = np.hstack([ones, 1 + features[:, [1]] ** 2])
    five = logged * np.array([1, 5], dtype=np.float32)
    steps = steps_of(np.abs(reward), session)
    report = fit_models(lambda: iter([(logged, five)]), steps, seed=0)[1]
    assert not report.converged
    assert report.iterations < 400
    assert np.isfinite(report.td_loss)


def test_users_are_never_judged_by_models_that_saw_them() -> None:
    rng = np.random.default_rng(0)
    user, session = np.repeat(np.arange(20), 5), np.arange(100)
    features = np.column_stack([np.ones(100), rng.normal(size=(100, 3))]).astype(np.float32)
    mine, reward = user == 7, rng.normal(size=100)
    before, after = (
        fit_models(lambda: iter([(features, features)]), steps_of(rewards, session, user), 3)[0].q
        for rewards in (reward, np.where(mine, 50.0, reward))
    )
    np.testing.assert_array_equal(after[mine], before[mine])
    assert not np.allclose(after[~mine], before[~mine])
