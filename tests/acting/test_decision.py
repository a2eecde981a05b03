"""The decision rule: probabilities worked out, the best items, and target returns."""

import json
import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from ucfrec.acting.decision import DecisionRule, ListTerm, best_items
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.errors import InputError

SCORES = torch.tensor([[1.0, 3.0, -math.inf, 2.0], [0.0, 0.0, 5.0, -1.0]])
rules = st.builds(
    DecisionRule,
    target=st.floats(-1e6, 1e6),
    minimum_target=st.one_of(st.none(), st.floats(-1e6, 1e6)),
    reward_weight=st.floats(0, 100),
    temperature=st.floats(0, 100),
    top_k=st.one_of(st.none(), st.integers(1, 99)),
    by_marginal_gain=st.booleans(),
    exclude_seen=st.booleans(),
    tag_window=st.integers(0, 9),
    tag_run=st.integers(0, 10),
    explore=st.floats(0, 1),
    explore_top=st.one_of(st.none(), st.integers(1, 99)),
)


def draws(scores: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Uniforms for `DecisionRule.rank_items`."""
    return torch.rand(len(scores), scores.shape[1] + 1, generator=generator)


# The rule as data.


@given(rules)
def test_a_rule_read_back_from_json_is_the_same_rule(rule: DecisionRule) -> None:
    again = DecisionRule.from_dict(json.loads(json.dumps(rule.as_dict())), "rule.json")
    assert again == rule
    assert again.hash == rule.hash
    assert str(again) == str(rule)


def test_the_hash_is_that_of_the_values_alone() -> None:
    rule = DecisionRule(5.0)
    for same in (DecisionRule(np.float32(5)), DecisionRule(5, reward_weight=-0.0)):
        assert (same, same.hash) == (rule, rule.hash)
    whole = dict.fromkeys(("top_k", "tag_window", "tag_run", "explore_top"), 1)
    values = whole | {"exclude_seen": True, "by_marginal_gain": True, "policy_weight": 0.5}
    names = (field.name for field in fields(DecisionRule))
    others = [
        DecisionRule(**{"target": 5.0, "explore": 0.5, name: values.get(name, 1.0)})
        for name in names
    ]
    assert len({rule.hash for rule in [DecisionRule(5.0, explore=0.5), *others]}) == len(others) + 1
    assert len({str(rule) for rule in others}) == len(others)


HOSTILE: dict[str, Any] = {
    "not a number": {"target": "5"},
    "no target": {"target": None},
    "nan": {"target": math.nan},
    "huge": {"target": 10**400},
    "unknown": {"target": 1.0, "__class__": "x"},
    "negative reward weight": {"target": 1.0, "reward_weight": -1.0},
    "huge reward weight": {"target": 1.0, "reward_weight": 1e300},
    "no item": {"target": 1.0, "top_k": 0},
    "long run": {"target": 1.0, "tag_run": 11},
    "text": {"target": 1.0, "exclude_seen": "yes"},
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_values_are_refused_in_one_line(case: str) -> None:
    with pytest.raises(InputError, match=r"^run/rule\.json") as caught:
        DecisionRule.from_dict(HOSTILE[case], "run/rule.json")
    assert "\n" not in str(caught.value)


# Probabilities.


@pytest.mark.parametrize("temperature", [0.25, 1.0, 3.0])
def test_probabilities_are_a_softmax(temperature: float) -> None:
    rule = DecisionRule(0.0, temperature=temperature)
    expected = (SCORES / temperature).softmax(1)
    torch.testing.assert_close(rule.log_probabilities(SCORES).exp(), expected)


@pytest.mark.parametrize("temperature", [1e-300, 1e-30, 1e-9, 1e6])
def test_extreme_temperatures_have_their_limits(temperature: float) -> None:
    found = DecisionRule(0.0, temperature=temperature).log_probabilities(1e4 * SCORES).exp()
    assert torch.isfinite(found).all()
    torch.testing.assert_close(found.sum(1), torch.ones(2))
    if temperature < 1:
        assert [part.tolist() for part in found.max(1)] == [[1, 1], [1, 2]]


def test_only_the_best_are_drawn_from() -> None:
    rule = DecisionRule(0.0, temperature=1.0, top_k=2)
    found = rule.log_probabilities(SCORES).exp()
    assert found[0].tolist() == pytest.approx([0, math.e / (1 + math.e), 0, 1 / (1 + math.e)])
    many = replace(rule, top_k=99)
    torch.testing.assert_close(many.log_probabilities(SCORES).exp(), SCORES.softmax(1))
    few = torch.tensor([[-math.inf, 1.0, -math.inf, -math.inf]])
    assert rule.log_probabilities(few).exp().tolist() == [[0, 1, 0, 0]]
    assert rule.log_probabilities(torch.zeros(1, 4)).exp().tolist() == [[0.5, 0.5, 0, 0]]


RANDOM = [
    DecisionRule(0.0, temperature=1.0),
    DecisionRule(0.0, temperature=0.5, top_k=2),
    DecisionRule(0.0, explore=0.2),
    DecisionRule(0.0, temperature=0.7, top_k=2, explore=0.3),
    DecisionRule(0.0, temperature=0.7, explore=0.5, explore_top=2),
]


@pytest.mark.parametrize("rule", [DecisionRule(0.0), *RANDOM], ids=str)
def test_what_is_chosen_and_ranked_first_follows_the_probabilities(rule: DecisionRule) -> None:
    generator, n = torch.Generator().manual_seed(0), 20_000
    probabilities = rule.log_probabilities(SCORES).exp()
    for row in range(2):
        scores = SCORES[row].expand(n, -1)
        items, chances = rule.choose(scores, generator)
        torch.testing.assert_close(chances, probabilities[row][items])
        ranked, propensities = rule.rank_items(scores, 3, draws(scores, generator))
        firsts = ranked[:, 0]
        torch.testing.assert_close(propensities[:, 0].float(), probabilities[row][firsts])
        for drawn in (items, firsts):
            shares = torch.bincount(drawn, minlength=4) / n
            torch.testing.assert_close(shares, probabilities[row], rtol=0, atol=0.015)


def repel(items: torch.Tensor) -> torch.Tensor:
    """Of seven items, those of the same parity as one above lose one and a half."""
    return -1.5 * ((torch.arange(7) - items.unsqueeze(1)) % 2 == 0)


@pytest.mark.parametrize("rule", RANDOM, ids=str)
@pytest.mark.parametrize("n", [20_000, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("term", [None, repel])
def test_lists_are_as_frequent_as_their_propensities_say(
    rule: DecisionRule, n: int, term: ListTerm | None
) -> None:
    """Chi-square over all lists of three of four items; the others may not be shown."""
    scores = torch.tensor([[0.0, 1.5, -math.inf, 2.0, 0.5, *[-math.inf] * 2]]).expand(n, -1)
    generator = torch.Generator().manual_seed(2)
    items, propensities = rule.rank_items(scores, 3, draws(scores, generator), term)
    lists, number, counts = items.unique(dim=0, return_inverse=True, return_counts=True)
    stated = torch.zeros(len(lists), dtype=torch.float64)
    stated[number] = propensities.prod(1)
    torch.testing.assert_close(propensities.prod(1), stated[number])
    assert float(stated.sum()) == pytest.approx(1, abs=1e-6)
    assert chisquare(counts.numpy(), n * (stated / stated.sum()).numpy()).pvalue > 1e-3


@pytest.mark.parametrize("rule", [*RANDOM, DecisionRule(0.0)], ids=str)
@pytest.mark.parametrize("term", [None, repel])
def test_probabilities_of_a_list_are_those_with_which_it_was_drawn(
    rule: DecisionRule, term: ListTerm | None
) -> None:
    generator = torch.Generator().manual_seed(3)
    scores = torch.randn(300, 7, generator=generator)
    scores[torch.rand(300, 7, generator=generator) < 0.2] = -math.inf
    items, propensities = rule.rank_items(scores, 4, draws(scores, generator), term)
    for place in range(5):
        earlier = torch.nn.functional.pad(items[:, :place], (0, 1), value=-1)
        chances = rule.log_probabilities(scores, earlier, term).double().exp()
        torch.testing.assert_close(chances.sum(1), torch.ones(300).double(), atol=1e-5, rtol=0)
        assert not chances.gather(1, items[:, :place]).any()
        for item in range(7):  # each of them alone
            lists = torch.nn.functional.pad(earlier, (0, 1), value=item)
            alone = rule.log_probabilities_of(scores, lists, term).double().exp()
            torch.testing.assert_close(alone, chances[:, item], atol=1e-6, rtol=1e-5)
        if place < 4:
            of_items = chances.gather(1, items[:, place : place + 1])[:, 0]
            torch.testing.assert_close(of_items, propensities[:, place], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("rule", [*RANDOM, DecisionRule(0.0)], ids=str)
def test_a_list_by_marginal_gain_is_drawn_as_single_items_of_what_is_left(
    rule: DecisionRule,
) -> None:
    generator = torch.Generator().manual_seed(3)
    scores = torch.randn(300, 7, generator=generator)
    items, propensities = rule.rank_items(scores, 7, draws(scores, generator), repel)
    modes = torch.tensor([[1 - rule.explore], [rule.explore]]).log().double().expand(2, 300)
    for place, column in enumerate(items.split(1, dim=1)):
        single = [replace(rule, explore=share).log_probabilities(scores) for share in (0.0, 1.0)]
        logs = torch.stack(single).double().gather(2, column.expand(2, -1, 1))[:, :, 0]
        expected = (modes.log_softmax(0) + logs).logsumexp(0).exp()
        torch.testing.assert_close(propensities[:, place], expected, atol=1e-6, rtol=1e-4)
        modes = modes + logs
        scores = (scores + repel(column[:, 0])).scatter(1, column, -math.inf)


@pytest.mark.parametrize("explore", [0.0, 0.3])
def test_items_that_are_never_drawn_leave_the_others_as_likely(explore: float) -> None:
    rule = DecisionRule(1.0, temperature=1.0, top_k=3, explore=explore, explore_top=3)
    scores = torch.tensor([[-torch.inf, 3.0, 2.0, 1.0, 0.0]])
    below = rule.log_probabilities(scores, torch.tensor([[4, 0]]))
    torch.testing.assert_close(below.exp(), rule.log_probabilities(scores).exp())


def test_propensities_stay_exact_where_one_item_has_nearly_all_probability() -> None:
    rule, scores = DecisionRule(0.0, temperature=1.0), torch.tensor([[0.0, 40.0, 1.0]])
    items, propensities = rule.rank_items(scores, 3, torch.full((1, 4), 0.5))
    assert items.tolist() == [[1, 2, 0]]
    assert propensities[0].tolist() == pytest.approx([1, math.e / (1 + math.e), 1], rel=1e-6)


@pytest.mark.parametrize("rule", [DecisionRule(0.0), RANDOM[1]], ids=str)
def test_items_left_out_are_ranked_last_and_good_ones_first(rule: DecisionRule) -> None:
    scores = torch.tensor([[1.0, -math.inf, 7.0, 3.0, 2.0, 6.0]]).expand(200, -1)
    uniforms = draws(scores, torch.Generator().manual_seed(0))
    found, propensities = rule.rank_items(scores, 6, uniforms)
    assert (propensities[:, 2:] == 1).all()
    assert (found.sort(1).values == torch.arange(6)).all()
    assert (found[:, :2].sort(1).values == torch.tensor([2, 5])).all()
    assert (found[:, 2:] == torch.tensor([3, 4, 0, 1])).all()
    assert (len(found.unique(dim=0)) > 1) == rule.draws


# Target returns.


def test_a_target_is_of_a_session_or_of_every_step() -> None:
    collected = torch.tensor([0.0, 3.0, 9.0]).double()
    session, step = ReturnToGo(), ReturnToGo("horizon", horizon=2)

    def targets(returns: ReturnToGo, *rule: float) -> Any:
        return DecisionRule(*rule).target_returns(returns, collected).tolist()

    assert targets(session, 5.0) == [5, 2, -4]
    assert targets(session, 5.0, 1.5) == [5, 2, 1.5]
    assert targets(step, 5.0) == targets(step, 5.0, 1.5) == [5, 5, 5]


# The best items.


@pytest.mark.parametrize("k", [1, 10, 300])
@pytest.mark.parametrize(
    ("rows", "n"), [(1, 50), (1, 1000), (3, 70_001), (1, 200_000), (40, 4_099)]
)
def test_the_best_are_found_wherever_they_lie(rows: int, n: int, k: int) -> None:
    generator, k = torch.Generator().manual_seed(n + k), min(k, n)
    for scores in (
        torch.randn(rows, n, generator=generator),
        torch.arange(n).float().repeat(rows, 1),  # all in the last block, and what is left over
        torch.randn(rows, n, generator=generator).masked_fill(torch.arange(n) > k, -torch.inf),
        torch.randint(3, (rows, n), generator=generator).float(),  # most are equal
    ):
        expected = scores.sort(dim=1, descending=True, stable=True).indices[:, :k]
        assert torch.equal(best_items(scores, k), expected)
