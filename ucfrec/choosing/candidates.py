"""Candidates for the decision rule: grids, and rules near one that an earlier choice ended with."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final

from ucfrec.acting.decision import DecisionRule
from ucfrec.choosing.choice import Problem

NEAR_THE_LOG: Final = (
    {"temperature": (1.0, 1.5, 2.0, 4.0, 8.0), "reward_weight": (0.0, 0.25, 0.5, 1.0)},
    {"temperature": (1.0,), "reward_weight": (0.125, 0.25, 0.5, 1.0), "policy_weight": (0.0,)},
)
"""Candidates where a rule must leave effective users of a log with propensities."""


def unweighted(problem: Problem) -> Iterator[DecisionRule]:
    """Rules of the policy alone, the highest temperature first."""
    config, targets, policy = problem.config, problem.targets, problem.scorer.policy
    learned = policy.values is not None and bool(policy.config.max_return)
    for temperature in sorted(config.temperatures, reverse=True):
        for target in dict.fromkeys(targets[quantile] for quantile in config.quantiles):
            yield DecisionRule(target, temperature=temperature)
            yield DecisionRule(target, minimum_target=target, temperature=temperature)
        if learned:
            yield DecisionRule(None, temperature=temperature)


def variants(rule: DecisionRule, **values: Sequence[Any]) -> Iterator[DecisionRule]:
    """The rule with every combination of other values of its fields."""
    for combination in product(*values.values()):
        variant = replace(rule, **dict(zip(values, combination, strict=True)))
        if variant != rule:
            yield variant


def lookaheads(problem: Problem) -> list[float]:
    """Values of going on, in reward units; those that are not positive are left out."""
    mean = float(problem.train.returns.sum(dtype="float64")) / problem.train.n_steps
    return [value for factor in problem.config.lookaheads if (value := factor * mean) > 0]


def near(
    rule: DecisionRule, problem: Problem, more: Sequence[Mapping[str, Sequence[float]]] = ()
) -> Iterator[DecisionRule]:
    """The rule, rules with another target, and those with another of its numbers one candidate up
    or down.

    A rule without lookahead also gets one, with the middle weight of the policy, and loses it with
    the middle reward weight.

    Args:
        more: further candidates of `temperature` and `reward_weight`.
    """
    config, learned = problem.config, problem.scorer.policy.values is not None
    yield rule
    for target in dict.fromkeys(problem.targets.values()):
        yield replace(rule, target=target, minimum_target=None)
        yield replace(rule, target=target, minimum_target=target)
    if learned and problem.scorer.policy.config.max_return:
        yield replace(rule, target=None, minimum_target=None)
    grid: dict[str, Sequence[float]] = {
        name: [*getattr(config, f"{name}s"), *(value for part in more for value in part[name])]
        for name in ("temperature", "reward_weight")
    }
    middle = _middle(config.policy_weights)
    if rule.looks_ahead:
        grid |= {"lookahead": lookaheads(problem), "policy_weight": config.policy_weights}
        grid["reward_weight"] = config.lookahead_weights
        weight = _middle(config.reward_weights)
        yield replace(rule, reward_weight=weight, lookahead=0.0, policy_weight=1.0)
    elif problem.users.session_end_report.kept != "constant":
        for ahead, weight in product(lookaheads(problem), config.lookahead_weights):
            yield replace(rule, lookahead=ahead, reward_weight=weight, policy_weight=middle)
    if problem.validation.item_states.tags.shape[1]:
        longest = problem.scorer.known
        grid["tag_window"] = [0, *(steps for steps in config.tag_windows if steps <= longest)]
        grid["tag_run"] = [0, *config.tag_runs] if problem.users.fatigue else [0]
    for name, values in grid.items():
        value = getattr(rule, name)
        smaller = [candidate for candidate in values if candidate < value]
        larger = [candidate for candidate in values if candidate > value]
        nearest: list[Any] = [*sorted(smaller)[-1:], *sorted(larger)[:1]]
        yield from (replace(rule, **{name: neighbour}) for neighbour in nearest)


def _middle(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2]
