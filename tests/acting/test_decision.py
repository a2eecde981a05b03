"""The decision rule: probabilities by hand, what it leaves out, and what it asks for."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.policies.test_ucf import CATALOG, ITEMS, VECTORS, B, K, build, other, random_windows
from ucfrec.acting.decision import Decider, DecisionRule
from ucfrec.episodes.exposure import Likeness, Shown
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.user_model.main_tags import MainTags

SCORES = torch.tensor([[1.0, 3.0, -math.inf, 2.0], [0.0, 0.0, 5.0, -1.0]])
rules = st.builds(
    DecisionRule,
    target=st.one_of(st.none(), st.floats(-1e6, 1e6)),
    floor=st.one_of(st.none(), st.floats(-1e6, 1e6)),
    reward_weight=st.floats(0, 100),
    temperature=st.floats(0, 100),
    top_k=st.one_of(st.none(), st.integers(1, 99)),
    exclude_seen=st.booleans(),
    tag_window=st.integers(0, 9),
    tag_run=st.integers(0, 10),
)


# The rule as data.


@given(rules)
def test_a_rule_read_back_from_json_is_the_same_rule(rule: DecisionRule) -> None:
    again = DecisionRule.from_dict(json.loads(json.dumps(rule.as_dict())), "rule.json")
    assert again == rule
    assert again.hash == rule.hash
    assert str(again) == str(rule)


def test_the_hash_is_that_of_the_values_alone() -> None:
    assert DecisionRule(5.0).hash == "537dff980f53"
    for same in (
        DecisionRule(5),
        DecisionRule(np.float32(5)),
        DecisionRule(5.0, reward_weight=-0.0),
    ):
        assert (same, same.hash) == (DecisionRule(5.0), DecisionRule(5.0).hash)
    others = [
        DecisionRule(None),
        DecisionRule(5.0, floor=5.0),
        DecisionRule(5.0, reward_weight=1.0),
        DecisionRule(5.0, temperature=1.0),
        DecisionRule(5.0, top_k=1),
        DecisionRule(5.0, exclude_seen=True),
        DecisionRule(5.0, tag_window=1),
        DecisionRule(5.0, tag_run=1),
    ]
    assert len({rule.hash for rule in [DecisionRule(5.0), *others]}) == 9
    assert len({str(rule) for rule in others}) == 8


HOSTILE: dict[str, Any] = {
    "not a number": {"target": "5"},
    "a list": {"target": [5.0]},
    "true": {"target": True},
    "nan": {"target": math.nan},
    "infinite": {"target": -math.inf},
    "huge": {"target": 10**400},
    "no target": {"reward_weight": 1.0},
    "unknown": {"target": 1.0, "__class__": "x"},
    "nan floor": {"target": 1.0, "floor": math.nan},
    "negative reward weight": {"target": 1.0, "reward_weight": -1.0},
    "no reward weight": {"target": 1.0, "reward_weight": None},
    "huge reward weight": {"target": 1.0, "reward_weight": 1e300},
    "negative temperature": {"target": 1.0, "temperature": -0.1},
    "no temperature": {"target": 1.0, "temperature": None},
    "no item": {"target": 1.0, "top_k": 0},
    "half an item": {"target": 1.0, "top_k": 2.5},
    "negative window": {"target": 1.0, "tag_window": -1},
    "no window": {"target": 1.0, "tag_window": None},
    "huge window": {"target": 1.0, "tag_window": 10**12},
    "text": {"target": 1.0, "exclude_seen": "yes"},
    "one": {"target": 1.0, "exclude_seen": 1},
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_values_are_refused_in_one_line(case: str) -> None:
    with pytest.raises(InputError, match=r"^run/rule\.json") as caught:
        DecisionRule.from_dict(HOSTILE[case], "run/rule.json")
    assert "\n" not in str(caught.value)


# Probabilities.


@pytest.mark.parametrize("temperature", [0.25, 1.0, 3.0])
def test_probabilities_by_hand(temperature: float) -> None:
    rule = DecisionRule(0.0, temperature=temperature)
    found = rule.log_probabilities(SCORES).exp()
    for row, scores in enumerate(SCORES.tolist()):
        chances = [math.exp(score / temperature) for score in scores]
        expected = [chance / sum(chances) for chance in chances]
        assert found[row].tolist() == pytest.approx(expected, rel=1e-5)


def test_without_temperature_the_best_is_certain() -> None:
    found = DecisionRule(0.0).log_probabilities(SCORES).exp()
    assert found.tolist() == [[0, 1, 0, 0], [0, 0, 1, 0]]
    # Of equal ones, one.
    assert DecisionRule(0.0).log_probabilities(torch.zeros(1, 3)).exp().sum() == 1


@pytest.mark.parametrize("temperature", [1e-300, 1e-30, 1e-9, 1e6])
def test_extreme_temperatures_have_their_limits(temperature: float) -> None:
    found = DecisionRule(0.0, temperature=temperature).log_probabilities(1e4 * SCORES).exp()
    assert torch.isfinite(found).all()
    torch.testing.assert_close(found.sum(1), torch.ones(2))
    if temperature < 1:
        assert found.argmax(1).tolist() == [1, 2]
        assert found.max(1).values.tolist() == [1, 1]


def test_only_the_best_are_drawn_from() -> None:
    rule = DecisionRule(0.0, temperature=1.0, top_k=2)
    found = rule.log_probabilities(SCORES).exp()
    share = math.e / (1 + math.e)
    assert found[0].tolist() == pytest.approx([0, share, 0, 1 - share])
    many = replace(rule, top_k=99)
    torch.testing.assert_close(many.log_probabilities(SCORES).exp(), SCORES.softmax(1))
    # Fewer are allowed than may be drawn from.
    few = torch.tensor([[-math.inf, 1.0, -math.inf, -math.inf]])
    assert rule.log_probabilities(few).exp().tolist() == [[0, 1, 0, 0]]


@pytest.mark.parametrize(
    "rule",
    [
        DecisionRule(0.0),
        DecisionRule(0.0, temperature=1.0),
        DecisionRule(0.0, temperature=2.0, top_k=2),
    ],
)
def test_what_is_chosen_and_ranked_first_follows_the_probabilities(rule: DecisionRule) -> None:
    generator, n = torch.Generator().manual_seed(0), 20_000
    probabilities = rule.log_probabilities(SCORES).exp()
    for row in range(2):
        scores = SCORES[row].expand(n, -1)
        items, chances = rule.choose(scores, generator)
        torch.testing.assert_close(chances, probabilities[row][items])
        firsts = rule.ranked(scores, 3, torch.rand(scores.shape, generator=generator))[:, 0]
        for drawn in (items, firsts):
            shares = torch.bincount(drawn, minlength=4) / n
            torch.testing.assert_close(shares, probabilities[row], rtol=0, atol=0.015)


def test_ranked_items_are_drawn_one_after_the_other_without_repetition() -> None:
    """The second item is drawn as the first, from what is left."""
    generator, n = torch.Generator().manual_seed(1), 40_000
    scores = torch.tensor([[0.0, 1.0, 2.0]]).expand(n, -1)
    found = DecisionRule(0.0, temperature=1.0).ranked(
        scores, 3, torch.rand(scores.shape, generator=generator)
    )
    assert (found.sort(1).values == torch.arange(3)).all()
    chances = scores[0].softmax(0)
    for first in range(3):
        for second in set(range(3)) - {first}:
            share = ((found[:, 0] == first) & (found[:, 1] == second)).float().mean()
            expected = chances[first] * chances[second] / (1 - chances[first])
            assert float(share) == pytest.approx(float(expected), abs=0.012)


@pytest.mark.parametrize(
    "rule", [DecisionRule(0.0), DecisionRule(0.0, temperature=1.0, top_k=2)], ids=str
)
def test_items_left_out_are_ranked_last_and_good_ones_first(rule: DecisionRule) -> None:
    scores = torch.tensor([[1.0, -math.inf, 7.0, 3.0, 2.0, 6.0]]).expand(200, -1)
    uniforms = torch.rand(scores.shape, generator=torch.Generator().manual_seed(0))
    found = rule.ranked(scores, 6, uniforms)
    assert (found.sort(1).values == torch.arange(6)).all()
    assert (found[:, :2].sort(1).values == torch.tensor([2, 5])).all()
    assert (found[:, 2:] == torch.tensor([3, 4, 0, 1])).all()
    assert (len(found.unique(dim=0)) > 1) == (rule.temperature > 0)


# What is asked for.


def test_a_target_is_of_a_session_or_of_every_step() -> None:
    collected = torch.tensor([0.0, 3.0, 9.0]).double()
    session, step = ReturnToGo(), ReturnToGo("horizon", horizon=2)
    rule = DecisionRule(5.0)
    assert rule.asked(session, collected, None).tolist() == [5, 2, -4]
    assert rule.asked(step, collected, None).tolist() == [5, 5, 5]
    floored = replace(rule, floor=1.5)
    assert floored.asked(session, collected, None).tolist() == [5, 2, 1.5]
    assert floored.asked(step, collected, None).tolist() == [5, 5, 5]
    best = torch.tensor([0.5, 1.0, 2.0])
    for returns in (session, step):
        assert DecisionRule(None).asked(returns, collected, best).tolist() == [0.5, 1, 2]
        assert DecisionRule(None, floor=1.0).asked(returns, collected, best).tolist() == [1, 1, 2]


@pytest.mark.parametrize("definition", ["session", "discounted", "horizon"])
def test_windows_show_what_is_asked_for_after_what_was_earned(definition: Any) -> None:
    returns = ReturnToGo(definition, 0.5, 2)
    windows, collected = random_windows(CATALOG), torch.tensor([1.0, 2.0, 3.0]).double()
    decider = Decider(build("dt", CATALOG), DecisionRule(4.0), returns)
    asked = decider.asked(windows, collected)
    last = returns.asked(4.0, collected)
    expected = returns.before(last, windows.rewards).masked_fill(~windows.mask, 0.0)
    torch.testing.assert_close(asked.returns_to_go, expected)
    torch.testing.assert_close(asked.returns_to_go[:, -1], last.float())
    if definition == "session":
        # Each reward earned lowers what is asked for from the next step on.
        fall = -asked.returns_to_go.diff(dim=1)
        there = windows.mask[:, :-1]
        torch.testing.assert_close(fall[there], windows.rewards[:, :-1][there])


def test_the_largest_return_must_have_been_learned() -> None:
    windows, collected = random_windows(CATALOG), torch.zeros(B).double()
    with pytest.raises(InputError, match=r"--set policy\.max_return=true"):
        Decider(build("dt", CATALOG), DecisionRule(None)).asked(windows, collected)
    torch.manual_seed(0)
    policy = DTPolicy(DTConfig(context=K, dim=16, max_return=True), CATALOG).eval()
    policy.return_scale.fill_(8.0)
    asked = Decider(policy, DecisionRule(None)).asked(windows, collected)
    assert policy.values is not None
    with torch.no_grad():
        actions = policy.head.embed(windows.actions)
        best = 8 * policy.values(policy.normalized(windows), actions)[:, -1, 1]
    torch.testing.assert_close(asked.returns_to_go[:, -1], best)


# What is decided, from what.


class KnownRewards:
    """A reward model that anyone can compute: of states, items shown before, and users."""

    lags = 2

    def scores(self, states: Tensor, shown: Shown, users: Tensor | None) -> Tensor:
        items = torch.arange(ITEMS)
        of_user = torch.zeros(len(states)) if users is None else users.float()
        repeated = (shown.items[:, : self.lags].unsqueeze(2) == items).any(1)
        return states[:, :1] * items / 10 + of_user.unsqueeze(1) * items - 3.0 * repeated


TAGS = torch.tensor([[0], [0], [1], [1], [2], [2], [3], [3], [4], [4], [4]])


def decider_of(name: str = "dt", **parts: Any) -> Decider:
    states = replace(ItemStates(torch.eye(ITEMS), torch.zeros(0, 0), 0.0, 1.0), tags=TAGS)
    rule = DecisionRule(3.0, **parts)
    model: Any = KnownRewards()
    return Decider(
        build(name, CATALOG), rule, ReturnToGo(), model, Likeness.of(states), MainTags.of(states)
    )


def shown_in(windows: Windows, row: int, last: int) -> list[int]:
    """Items of the last steps before the one to decide, most recent first."""
    steps = [t for t in range(K - 2, -1, -1) if windows.mask[row, t]][:last]
    return [int(windows.actions[row, t]) for t in steps]


def test_scores_are_the_policys_plus_the_reward_weight() -> None:
    windows, collected = random_windows(CATALOG), torch.tensor([0.0, 1.0, 2.5]).double()
    users = torch.tensor([2, 0, -1])
    plain, weighted = decider_of(), decider_of(reward_weight=0.5)
    logits = plain.scores(windows, collected)
    torch.testing.assert_close(logits, plain.policy.act(plain.asked(windows, collected)).detach())
    found = weighted.scores(windows, collected, users=users)
    for row in range(B):
        shown = shown_in(windows, row, KnownRewards.lags)
        for item in range(ITEMS):
            reward = float(windows.states[row, -1, 0]) * item / 10 + float(users[row]) * item
            reward -= 3.0 * (item in shown)
            expected = float(logits[row, item]) + 0.5 * reward
            assert float(found[row, item]) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("window", [1, 2, K - 1])
def test_items_that_share_a_recent_tag_are_left_out(window: int) -> None:
    windows, collected = random_windows(CATALOG), torch.zeros(B).double()
    scores = decider_of(tag_window=window).scores(windows, collected)
    plain = decider_of().scores(windows, collected)
    for row in range(B):
        recent = {int(TAGS[item, 0]) for item in shown_in(windows, row, window)}
        left = {item for item in range(ITEMS) if int(TAGS[item, 0]) not in recent}
        assert left, "the windows are too long for this test"
        assert set(torch.isfinite(scores[row]).nonzero()[:, 0].tolist()) == left
        kept = torch.isfinite(scores[row])
        torch.testing.assert_close(scores[row][kept], plain[row][kept])


def test_the_tag_window_gives_way_where_nothing_would_be_left() -> None:
    windows, collected = random_windows(CATALOG), torch.zeros(B).double()
    windows = replace(windows, actions=torch.zeros_like(windows.actions))
    windows.actions[0, -2] = 4
    forbidden = torch.ones(ITEMS, dtype=torch.bool)
    forbidden[:2] = False
    decider = decider_of(tag_window=1)
    found = torch.isfinite(decider.scores(windows, collected, forbidden))
    assert found[0].nonzero()[:, 0].tolist() == [0, 1], "their tag was not shown last"
    assert found[1].nonzero()[:, 0].tolist() == [0, 1], "all that is allowed has the tag"
    first = torch.isfinite(decider.scores(windows, collected))
    assert first[0].nonzero()[:, 0].tolist() == [0, 1, 2, 3, 6, 7, 8, 9, 10]


@pytest.mark.parametrize("run", [1, 2, 3])
def test_items_of_a_main_tag_that_was_liked_on_end_are_left_out(run: int) -> None:
    windows, collected = random_windows(CATALOG), torch.zeros(B).double()
    items, tag = torch.arange(ITEMS), TAGS[:, 0]
    same, other_tag = items[tag == tag[4]], int(items[tag != tag[4]][0])
    shown = Shown(same[torch.zeros(B, 10, dtype=torch.int64)], torch.ones(B, 10))
    shown.rewards[1, run - 1] = 0.0
    shown.items[2, run - 1] = other_tag
    found = torch.isfinite(decider_of(tag_run=run).scores(windows, collected, shown=shown))
    assert found[0].tolist() == (tag != tag[4]).tolist()
    assert found[1].all(), "one of them was not liked"
    if run > 1:
        assert found[2].all(), "one of them had another tag"
    # Of what went before it does not matter, nor where nothing else is allowed.
    shown.items[0, run:], shown.rewards[0, run:] = -1, 0.0
    again = torch.isfinite(decider_of(tag_run=run).scores(windows, collected, shown=shown))
    assert torch.equal(again, found)
    given = decider_of(tag_run=run).scores(windows, collected, tag != tag[4], shown=shown)
    assert torch.isfinite(given[0]).tolist() == (tag == tag[4]).tolist()


def test_everything_left_out_is_an_error() -> None:
    windows, collected = random_windows(CATALOG), torch.zeros(B).double()
    forbidden = torch.zeros(B, ITEMS, dtype=torch.bool)
    forbidden[1] = True
    with pytest.raises(InputError, match="in 1 of 3 decisions every item is left out"):
        decider_of().scores(windows, collected, forbidden)
    forbidden[1, 4] = False
    assert decider_of().scores(windows, collected, forbidden)[1].argmax() == 4


@pytest.mark.parametrize("name", ["ucf", "dt", "dc", "lsdt"])
def test_the_steps_own_action_and_reward_are_not_read(name: str) -> None:
    windows, collected = random_windows(CATALOG), torch.tensor([0.0, 1.0, 2.0]).double()
    actions, rewards = windows.actions.clone(), windows.rewards.clone()
    actions[:, -1], rewards[:, -1] = other(actions[:, -1]), math.nan
    logged = torch.rand(windows.mask.shape)
    changed = replace(windows, actions=actions, rewards=rewards, returns_to_go=logged)
    decider = decider_of(name, reward_weight=1.0, tag_window=2, tag_run=1)
    before, after = (decider.scores(each, collected) for each in (windows, changed))
    assert torch.equal(before, after)
    earlier = windows.actions.clone()
    earlier[:, -2] = other(earlier[:, -2])
    assert not torch.equal(before, decider.scores(replace(windows, actions=earlier), collected))


def test_vectors_are_predicted_at_the_target() -> None:
    windows, collected = random_windows(VECTORS), torch.tensor([0.0, 1.0, 2.0]).double()
    policy = build("dt", VECTORS)
    found = Decider(policy, DecisionRule(2.0)).act(windows, collected)
    asked = replace(
        windows,
        returns_to_go=ReturnToGo().before(2.0 - collected, windows.rewards) * windows.mask,
    )
    with torch.no_grad():
        torch.testing.assert_close(found, policy.act(asked))


def test_a_rule_needs_what_it_uses() -> None:
    policy, states = build("dt", CATALOG), ItemStates(torch.eye(ITEMS), torch.zeros(0, 0), 0, 1)
    with pytest.raises(InputError, match="no reward model of items"):
        Decider(policy, DecisionRule(1.0, reward_weight=0.5))
    for likeness in (None, Likeness.of(states)):
        with pytest.raises(InputError, match="the store has none"):
            Decider(policy, DecisionRule(1.0, tag_window=2), likeness=likeness)
    for tags in (None, MainTags.of(states)):
        with pytest.raises(InputError, match="by their main tag, but the store has none"):
            Decider(policy, DecisionRule(1.0, tag_run=2), main_tags=tags)
    with pytest.raises(InputError, match="tag_run 11; give a whole number from 0 to 10"):
        DecisionRule(1.0, tag_run=11)
    tagged = Likeness.of(replace(states, tags=TAGS))
    assert K < 10  # items further back than the policy sees are known from the session
    Decider(policy, DecisionRule(1.0, tag_window=10), likeness=tagged)
    with pytest.raises(InputError, match="of a session 10 are known"):
        Decider(policy, DecisionRule(1.0, tag_window=11), likeness=tagged)
