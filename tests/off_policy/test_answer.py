"""The answer follows from the evidence, and what it plans is enough."""

from dataclasses import replace

import numpy as np
import pytest

from tests.off_policy.test_verdict import TARGET, logs
from ucfrec.off_policy import LoggedSteps, conclude
from ucfrec.off_policy.answer import MOST_LINES, Traffic, cut_to_steps, plan_test
from ucfrec.off_policy.guardrails import Guardrail
from ucfrec.off_policy.logged_steps import Modelled
from ucfrec.off_policy.verdict import diagnose
from ucfrec.results.evidence import Evidence

GOOD = logs(5000)[0]


@pytest.mark.parametrize(
    ("steps", "lift", "change", "answer"),
    [
        (GOOD, None, None, "launch"),
        (GOOD, None, (-0.01, 0.01), "launch"),
        (GOOD, None, (-0.03, 0.01), "test it"),
        (GOOD, None, (-0.05, -0.03), "do not launch"),
        (replace(GOOD, reward=1 - GOOD.reward), None, None, "do not launch"),
        (replace(GOOD, reward=np.arange(5000) % 2 * 1.0), 0.001, None, "test it"),
        (replace(GOOD, reward=np.arange(5000) % 2 * 1.0), 0.2, None, "do not launch"),
        (logs(150)[0], None, None, "the log cannot say"),
    ],
)
def test_the_answer_follows_from_the_evidence(
    steps: LoggedSteps, lift: float | None, change: tuple[float, float] | None, answer: str
) -> None:
    verdict = conclude(steps, seed=0, wanted_lift=lift, days=10)
    if change is not None:
        guardrail = replace(Guardrail.parse("dwell >= -2%"), change=Evidence(0.0, *change))
        verdict = replace(verdict, guardrails=[guardrail])
    lines = verdict.list_lines()
    assert verdict.answer == answer
    assert lines[0].startswith(answer)
    assert len(lines) <= MOST_LINES
    assert ("of such traffic" in "".join(lines)) == (answer == "test it")
    assert ("[" in lines[0]) == (answer != "the log cannot say")


def test_a_planned_test_finds_the_lift_four_times_in_five() -> None:
    rng = np.random.default_rng(0)
    rates = rng.beta(1, 3, 300)  # each of a user with five sessions
    returns = (rng.random((300, 5)) < rates[:, None]).astype(float).ravel()
    session, ones = np.arange(1500), np.ones(1500)
    steps = LoggedSteps(session, returns, ones, ones, user=session // 5)
    plan = plan_test(steps, 0.05, days=3)
    assert plan.days == pytest.approx(3 * plan.users / 300, rel=0.01)
    found = 0
    for _ in range(200):
        arms = rng.beta(1, 3, (2, plan.users // 2)) + np.array([[0.0], [0.05]])
        means = rng.binomial(5, np.clip(arms, 0, 1)) / 5
        error = np.sqrt((means.var(axis=1) / means.shape[1]).sum())
        found += means[1].mean() - means[0].mean() > 1.96 * error
    assert 140 <= found <= 180
    for lift, factor in ((0.05, 0), (1e-170, 1), (0.05, 1e160)):
        assert plan_test(replace(steps, reward=factor * returns), lift, 3) is None


@pytest.mark.parametrize("users", [300, 3000])
def test_a_planned_exploration_leaves_enough_users(users: int) -> None:
    """Of a policy that always shows one of 50 items, where the log never did."""
    rng = np.random.default_rng(users)
    traffic = Traffic(days=1.0, users=users, steps=5 * users, draws=50.0)
    share, days = (float(word) for word in traffic.plan_exploration().split() if word[0].isdigit())
    served = int(users * days)
    shown = (rng.random(5 * served) < share) & (rng.random(5 * served) < 1 / 50)
    weights = np.where(shown, 50 / share, 0.0)
    user = np.repeat(np.arange(served), 5)
    target = weights / weights.max()
    steps = LoggedSteps(np.arange(len(user)), weights, np.ones(len(user)), target, user=user)
    assert diagnose(steps).effective_users > 150
    assert replace(traffic, days=0.0).plan_exploration() == ""


def test_steps_answer_where_sessions_cannot() -> None:
    """Of sessions of thirty steps, products of ratios leave no one; single ratios do."""
    steps, items = logs(3000, length=30)
    value = np.full(len(steps.reward), steps.reward.mean())
    steps = replace(steps, model=Modelled(value, 0 * value, 0 * value, value))
    verdict = conclude(steps, seed=0)
    assert verdict.answer == "the log cannot say"
    verdict = replace(verdict, per_step=conclude(cut_to_steps(steps), 0))
    assert verdict.answer == "test it"
    assert "per step, by REG" in verdict.headline
    assert "per session: – (" in verdict.list_lines()[1]
    bad = replace(steps, target=TARGET[::-1][items])
    assert replace(verdict, per_step=conclude(cut_to_steps(bad), 0)).answer == "do not launch"
    doubted = conclude(cut_to_steps(steps), 0, forbidden=["seen in training"])
    assert replace(verdict, per_step=doubted).answer == "the log cannot say"
