"""Choose the decision rule in sessions simulated in the user model.

Simulated users have the fixed tastes of training users, which the policy does not know
(`ucfrec.user_model.training_users`): rewards of the model that acts, which learns from the session,
would pay a policy for its own guesses. What a model says of a policy holds only where the log
supports it, so a candidate must keep to items that the training log shows often enough, and to more
than a handful of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final

import numpy as np

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.choosing.choice import RuleChoice, SimulatedRule
from ucfrec.choosing.config import RuleConfig
from ucfrec.choosing.many_rules import roll_out
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.model import UserModel
from ucfrec.user_model.simulator import UserSimulator
from ucfrec.user_model.training_users import sessions_of

_FINALISTS: Final = 8
"""Rules that are simulated again where users differ in their tastes, …"""
_TIMES: Final = 4
"""… in so many times the sessions: few sessions there say as much of the users as of the rules."""


class RuleSearch:
    """Simulates decision rules of one policy in a user model."""

    def __init__(
        self,
        scorer: Scorer,
        users: UserModel,
        train: EpisodeStore,
        validation: EpisodeStore,
        config: RuleConfig,
        seed: int,
    ) -> None:
        """
        Args:
            scorer: the policy under its default rule, with the reward model of `users`.
            users: the user model; where users are new, training sessions are begun, otherwise
                validation sessions.
            train: training episodes.
            validation: validation episodes.
            config: candidates and conditions.
            seed: of the sessions and the draws.
        """
        self.users, self._config, self._seed = users, config, seed
        self._scorer = scorer
        new = users.reward_report.new_users
        self._store = sessions_of(train, seed) if new else validation
        self._longest = int(train.lengths.max())
        self._supported = train.item_counts() >= config.least_impressions
        self.least_items = float(min(config.least_items, self._supported.sum() / 4))

    def simulate(self, rules: Sequence[DecisionRule], times: int = 1) -> list[SimulatedRule]:
        """Roll out each of the rules, side by side, all with the same draws.

        Args:
            rules: to roll out.
            times: how many times the sessions of the configuration.
        """
        n = times * self._config.sessions
        if not rules:
            return []
        simulator = UserSimulator(
            self.users, self._store, n, self._longest, self._seed, times=len(rules)
        )
        scorers = [self._scorer.under(rule) for rule in rules]
        states, size = self._store.item_states, self._store.observation_size
        returns, lengths, shown = roll_out(simulator, scorers, n, states, size, self._seed)
        numbers = np.arange(len(returns)).reshape(len(rules), n)
        return [
            self._simulated(rule, returns[own], lengths[own], shown[shown[:, 0] // n == i, 1])
            for i, (rule, own) in enumerate(zip(rules, numbers, strict=True))
        ]

    def _simulated(
        self, rule: DecisionRule, returns: Float64Array, lengths: IntArray, items: IntArray
    ) -> SimulatedRule:
        """What `rule` did in n sessions, (n,) each, by showing `items` (M,)."""
        n, shares = len(returns), np.bincount(items) / len(items)
        shares = shares[shares > 0]
        return SimulatedRule(
            rule=rule,
            value=float(returns.mean()),
            error=float(returns.std(ddof=1) / n**0.5) if n > 1 else 0.0,
            length=float(lengths.mean()),
            support=float(self._supported[items].mean()),
            items=float(np.exp(-(shares * np.log(shares)).sum())),
        )

    def allowed(self, candidate: SimulatedRule) -> bool:
        """Whether the log supports what the candidate did."""
        enough = candidate.items >= self.least_items
        return enough and candidate.support >= self._config.least_support

    def finalists(
        self, candidates: Sequence[SimulatedRule], best: SimulatedRule
    ) -> list[SimulatedRule]:
        """The best and those of the highest value among the allowed, in more sessions."""
        allowed = [each for each in candidates if self.allowed(each)]
        highest = sorted(allowed, key=lambda each: each.value, reverse=True)
        rules = dict.fromkeys(each.rule for each in (best, *highest))
        return self.simulate([*rules][:_FINALISTS], _TIMES)

    def best(self, candidates: Sequence[SimulatedRule]) -> SimulatedRule:
        """The simplest of the allowed candidates within an error, or the tolerance, of the best.

        If none is allowed, the one with the most effective items.
        """
        allowed = [each for each in candidates if self.allowed(each)]
        if not allowed:
            return max(candidates, key=lambda each: each.items)
        top = max(allowed, key=lambda each: each.value)
        enough = top.value - max(top.error, self._config.tolerance * abs(top.value))
        return min((each for each in allowed if each.value >= enough), key=_simplicity)


def choose_by_simulation(
    scorer: Scorer,
    users: UserModel,
    targets: Mapping[float, float],
    train: EpisodeStore,
    validation: EpisodeStore,
    config: RuleConfig,
    seed: int,
) -> RuleChoice:
    """Choose target, minimum target and temperature, then the reward weight.

    Where items have tags, tag window and temperature follow, and the reward weight with the
    window; where the log shows fatigue, the tag run, and temperature and reward weight with it.
    For new users, the rules of the highest value are then simulated in more sessions. Of rules that
    the model cannot distinguish, the one at the highest temperature is taken, which stays nearest
    to the log. The arguments are those of `choose_rule`.
    """
    search = RuleSearch(scorer, users, train, validation, config, seed)
    learned = scorer.policy.values is not None and bool(scorer.policy.config.max_return)
    tried = search.simulate([*_unweighted(config, targets, learned)])
    first = search.best(tried).rule
    tried += search.simulate([*_variants(first, reward_weight=config.reward_weights)])
    second = search.best(tried).rule
    tried += _with_lookahead(search, second, config, train)
    if validation.item_states.tags.shape[1]:
        tried += _with_tag_window(search, second, config, scorer.known)
        # Without a tag window, which may only have served to cause no fatigue.
        tried += _with_tag_run(search, second, config)
    best = search.best(tried)
    if users.reward_report.new_users:
        finalists = search.finalists(tried, best)
        best, rules = search.best(finalists), {each.rule for each in finalists}
        tried = [*(each for each in tried if each.rule not in rules), *finalists]
    return RuleChoice(
        rule=best.rule,
        chosen_by=_chosen_by(users),
        candidates=tried,
        warning=""
        if search.allowed(best)
        else "; WARNING: the log supports no candidate, this one shows the most different items",
        details={**users.report(), "least_items": search.least_items},
    )


def _with_lookahead(
    search: RuleSearch, rule: DecisionRule, config: RuleConfig, train: EpisodeStore
) -> list[SimulatedRule]:
    """The rule with a lookahead, if more than randomness ends sessions."""
    mean = float(train.returns.sum(dtype=np.float64)) / train.n_steps
    lookaheads = [each * mean for each in config.lookaheads if each * mean > 0]
    if search.users.session_end_report.kept == "constant":
        return []
    weights = {"reward_weight": config.lookahead_weights, "policy_weight": config.policy_weights}
    return search.simulate([*_variants(rule, lookahead=lookaheads, **weights)])


def _with_tag_window(
    search: RuleSearch, rule: DecisionRule, config: RuleConfig, known: int
) -> list[SimulatedRule]:
    """The rule with a tag window of items that are `known`, then with other reward weights.

    At all temperatures: at a low one, the log may support what the policy shows only once some
    items are excluded.
    """
    windows = [window for window in config.tag_windows if 0 < window <= known]
    tried = search.simulate([*_variants(rule, temperature=config.temperatures, tag_window=windows)])
    if not tried:
        return []
    best = search.best(tried).rule
    weights = [weight for weight in config.reward_weights if weight != best.reward_weight]
    others = _variants(best, tag_window=sorted({*windows}), reward_weight=weights)
    return [*tried, *search.simulate([*others])]


def _with_tag_run(
    search: RuleSearch, rule: DecisionRule, config: RuleConfig
) -> list[SimulatedRule]:
    """The rule with a tag run, if users have fatigue, then at other temperatures and reward
    weights."""
    runs = [run for run in config.tag_runs if run] if search.users.fatigue else []
    tried = search.simulate([*_variants(rule, tag_run=runs)])
    if not tried:
        return []
    best = search.best(tried).rule
    weights = {"temperature": config.temperatures, "reward_weight": config.reward_weights}
    return [*tried, *search.simulate([*_variants(best, **weights)])]


def _unweighted(
    config: RuleConfig, targets: Mapping[float, float], learned: bool
) -> Iterator[DecisionRule]:
    for temperature in sorted(config.temperatures, reverse=True):
        for target in dict.fromkeys(targets[quantile] for quantile in config.quantiles):
            yield DecisionRule(target, temperature=temperature)
            yield DecisionRule(target, minimum_target=target, temperature=temperature)
        if learned:
            yield DecisionRule(None, temperature=temperature)


def _variants(rule: DecisionRule, **values: Sequence[Any]) -> Iterator[DecisionRule]:
    """The rule with every combination of other values of its fields."""
    for combination in product(*values.values()):
        other = replace(rule, **dict(zip(values, combination, strict=True)))
        if other != rule:
            yield other


def _simplicity(candidate: SimulatedRule) -> tuple[float, ...]:
    rule = candidate.rule
    return (
        *(rule.tag_run > 0, rule.tag_window > 0, rule.lookahead > 0, -rule.temperature),
        *(rule.reward_weight, rule.lookahead, -rule.policy_weight, -rule.tag_run),
    )


def _chosen_by(users: UserModel) -> str:
    if users.training_users is None:
        return (
            "mean return of sessions in the run's reward model, calibrated on validation rows; no "
            "propensities are used"
        )
    report = users.training_users.report
    whose = "new users" if users.reward_report.new_users else "validation users"
    weighted = "weighted by their propensities" if report.weighted else "without weights"
    return (
        f"mean return of sessions of {whose}, who have the fixed tastes of training users; these "
        f"are fitted to {report.steps:,} training rows {weighted}"
    )
