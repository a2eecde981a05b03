"""Guardrails hold, break or stay open by their interval; intervals of groups hold at once."""

from dataclasses import replace

import numpy as np
import pytest

from tests.off_policy.test_verdict import ITEMS, TARGET, logs
from ucfrec.errors import InputError
from ucfrec.off_policy import LoggedSteps, merge_lists
from ucfrec.off_policy.guardrails import Groups, Guardrail, check_guardrail, compare_groups

DWELL = np.linspace(2.0, 1.0, ITEMS)
"""Of which later items, which the policy prefers, have less."""
CHANGE = float(TARGET @ DWELL / DWELL.mean() - 1)


@pytest.mark.parametrize(
    ("text", "outcome"),
    [
        ("dwell >= -30%", "holds"),
        ("dwell >= -5%", "broken"),
        ("dwell <= -5%", "holds"),
        ("dwell <= -30 %", "broken"),
        (f"dwell >= {100 * CHANGE:.4f}%", "open"),
    ],
)
def test_a_guardrail_is_checked_by_the_interval_of_the_change(text: str, outcome: str) -> None:
    steps, items = logs(4000)
    guardrail = check_guardrail(text, DWELL[items], steps, (), 0)
    assert guardrail.measure == "dwell"
    assert guardrail.change.low < CHANGE < guardrail.change.high
    assert guardrail.outcome == outcome
    assert str(guardrail).endswith(outcome)
    doubted = check_guardrail(text, DWELL[items], steps, ("too few users",), 0)
    assert doubted.outcome == "open"
    assert "dwell: –" in str(doubted)
    assert "not above 0" in str(check_guardrail(text, -DWELL[items], steps, (), 0))


def test_a_measure_of_few_users_leaves_a_guardrail_open() -> None:
    """Of complaints that only one item had, all have one weight: an interval would be too tight."""
    steps, items = logs(4000)
    rare = ((items == 2) & (np.cumsum(items == 2) < 10)) * 1.0
    guardrail = check_guardrail("complaints <= 5%", rare, steps, (), 0)
    assert guardrail.outcome == "open"
    assert "only 9 users have both weight and reward" in str(guardrail)


def test_lists_are_weighed_by_the_assumption_of_the_verdict() -> None:
    """Dwell at the first position depends on the item below it: only whole lists show its loss."""
    rng = np.random.default_rng(0)
    liked = rng.random((6000, 2)) < 0.5
    rewards, target = liked.ravel() + rng.normal(size=12_000), np.where(liked, 0.8, 0.2).ravel()
    session, place = np.divmod(np.arange(12_000), 2)
    steps = LoggedSteps(session, rewards, np.full(12_000, 0.5), target, place=place)
    whole = replace(steps, positions="whole list")
    dwell = np.stack([np.where(liked[:, 1], 0.2, 1.0), np.zeros(6000)], axis=1).ravel()
    lifts = merge_lists(steps).session_weights * steps.returns - steps.returns
    few = Groups(("all", "few"), (session >= 5670).astype(int), False)
    for given, outcome, enough in ((steps, "holds", True), (whole, "broken", False)):
        assert check_guardrail("d >= -2%", dwell, given, (), 0).outcome == outcome
        (_, small) = compare_groups(few, given, lifts, 0)
        assert small.difference.is_reliable == enough


@pytest.mark.parametrize("text", ["dwell", "dwell >= -2", ">= -2%", "dwell > -2%"])
def test_a_guardrail_is_written_with_a_bound_in_percent(text: str) -> None:
    with pytest.raises(InputError, match=r"write e\.g\. 'dwell_seconds >= -2%'"):
        Guardrail.parse(text)


@pytest.mark.parametrize("of_items", [False, True])
def test_groups_add_up_and_their_intervals_are_wider(of_items: bool) -> None:
    steps, items = logs(6000)
    lifts = steps.session_weights * steps.returns - steps.returns
    number = items % 2 if of_items else np.where(np.arange(6000) < 100, 2, np.arange(6000) % 2)
    groups = Groups(("even", "odd", "few"), number, of_items)
    even, odd, few = compare_groups(groups, steps, lifts, 0)
    if of_items:
        assert "no session has both weight and reward: the logs support no" in str(few)
        total = even.difference.value + odd.difference.value
        assert total == pytest.approx(lifts.mean(), abs=0.02)
    else:
        assert few.difference.low is None
        assert "effective of 100 users (below 200)" in str(few)
        assert even.difference.value == pytest.approx(lifts[number == 0].mean())
        width = even.difference.high - even.difference.low
        assert width > 2 * 2.1 * lifts[number == 0].std() / even.users**0.5
    assert odd.difference.is_reliable
