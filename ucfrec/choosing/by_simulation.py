"""Choose the decision rule in sessions simulated in the user model.

Simulated users have the fixed tastes of training users, which the policy does not know
(`ucfrec.user_model.training_users`): rewards of the model that acts, which learns from the session,
would pay a policy for its own guesses. What a model says of a policy holds only where the log
supports it, so a candidate must keep to items that the training log shows often enough, and to more
than a handful of them; where the log has propensities, it must also leave enough effective users to
evaluate it off-policy.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final

import numpy as np

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.choosing.choice import Problem, RuleChoice, SimulatedRule, ValueEstimate
from ucfrec.choosing.logged import Evidence, LoggedEvidence
from ucfrec.choosing.many_rules import roll_out
from ucfrec.choosing.nearby import near
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.model import UserModel
from ucfrec.user_model.simulator import UserSimulator, longest_session
from ucfrec.user_model.training_users import half_of, sessions_of

_LOGGED_STEPS: Final = 10_000, 1000
"""Logged steps that evidence is from: where it decides what is allowed, and elsewhere."""
_FINALISTS: Final = 8
"""Rules that are simulated again where users differ in their tastes, …"""
_TIMES: Final = 4
"""… in so many times the sessions: few sessions there say as much of the users as of the rules."""
_FEWEST: Final = 10
"""Sessions of a half of the users that can disagree."""
_FAR_OFF: Final = 0.1
"""Share of the estimated value by which it may be off and still be trusted."""
_WIDEST: Final = 0.4
"""Largest variance of log weights: above it, `ope` often finds the tail of the weights too heavy
(Pareto k above 0.5 in 30% to 40% of logs at 0.6 to 0.8)."""
_NEAR_THE_LOG: Final = (
    {"temperature": (1.0, 1.5, 2.0, 4.0, 8.0), "reward_weight": (0.0, 0.25, 0.5, 1.0)},
    {"temperature": (1.0,), "reward_weight": (0.125, 0.25, 0.5, 1.0), "policy_weight": (0.0,)},
)
"""Candidates where a rule must leave effective users of a log with propensities."""


class RuleSearch:
    """Simulates decision rules of one policy in a user model."""

    def __init__(self, problem: Problem) -> None:
        """Args:
        problem: the policy, the user model and the log; where users are new, training sessions are
            begun, otherwise validation sessions.
        """
        self.problem, self.users, self._config = problem, problem.users, problem.config
        train, seed = problem.train, problem.seed
        new = self.users.reward_report.new_users
        self._store = sessions_of(train, seed) if new else problem.validation
        self._longest = longest_session(train.lengths)
        self._supported = train.item_counts() >= self._config.least_impressions
        self.least_items = float(min(self._config.least_items, self._supported.sum() / 4))
        logged = problem.scorer, problem.validation
        self._many, self._few = (LoggedEvidence(*logged, most, seed) for most in _LOGGED_STEPS)
        wanted = self._config.evidence if self._many.has_propensities else 0
        self.least_users = float(wanted)
        """Effective users that a rule must leave; 0 without propensities."""
        self._returns: dict[DecisionRule, Float64Array] = {}

    def simulate(self, rules: Sequence[DecisionRule], times: int = 1) -> list[SimulatedRule]:
        """Roll out each of the rules, side by side, all with the same draws.

        Args:
            times: how many times the sessions of the configuration.
        """
        if not rules:
            return []
        n = times * self._config.sessions
        found = self._rolled(rules, self.users, self._store, n, self.problem.seed)
        if 0 < self.least_users < self._many.users:
            found = [replace(one, evidence=each) for one, each in self._with_evidence(found)]
        return found

    def _with_evidence(
        self, found: Sequence[SimulatedRule]
    ) -> list[tuple[SimulatedRule, Evidence]]:
        """The rules with their evidence: of many sessions, where it decides what is allowed and no
        lookahead makes it slow."""
        slow = [each for each in found if each.rule.looks_ahead or not self.least_users]
        fast = [each for each in found if each not in slow]
        return [
            pair
            for logged, some in ((self._many, fast), (self._few, slow))
            if some
            for pair in zip(some, logged.of([each.rule for each in some]), strict=True)
        ]

    def _rolled(
        self,
        rules: Sequence[DecisionRule],
        users: UserModel,
        store: EpisodeStore,
        n: int,
        seed: int,
    ) -> list[SimulatedRule]:
        simulator = UserSimulator(users, store, n, self._longest, seed, times=len(rules))
        scorers = [self.problem.scorer.under(rule) for rule in rules]
        states, size = store.item_states, store.observation_size
        returns, lengths, shown = roll_out(simulator, scorers, n, states, size, seed)
        numbers = np.arange(len(returns)).reshape(len(rules), n)
        self._returns |= {rule: returns[own] for rule, own in zip(rules, numbers, strict=True)}
        return [
            self._simulated(rule, returns[own], lengths[own], shown[shown[:, 0] // n == i, 1])
            for i, (rule, own) in enumerate(zip(rules, numbers, strict=True))
        ]

    def _simulated(
        self, rule: DecisionRule, returns: Float64Array, lengths: IntArray, items: IntArray
    ) -> SimulatedRule:
        """What `rule` did in some sessions by showing `items` (M,)."""
        shares = np.bincount(items) / len(items)
        shares = shares[shares > 0]
        return SimulatedRule(
            rule=rule,
            value=float(returns.mean()),
            error=_standard_error(returns),
            length=float(lengths.mean()),
            support=float(self._supported[items].mean()),
            items=float(np.exp(-(shares * np.log(shares)).sum())),
        )

    def supported(self, candidate: SimulatedRule) -> bool:
        """Whether the log shows what the candidate did."""
        enough = candidate.items >= self.least_items
        return enough and candidate.support >= self._config.least_support

    def allowed(self, candidate: SimulatedRule) -> bool:
        """Whether the log supports what the candidate did, and can evaluate it."""
        evidence = candidate.evidence
        if not self.least_users or evidence is None:
            return self.supported(candidate) and not self.least_users
        enough = candidate.effective_users >= self.least_users and evidence.spread <= _WIDEST
        return self.supported(candidate) and enough

    def finalists(
        self, candidates: Sequence[SimulatedRule], best: SimulatedRule
    ) -> list[SimulatedRule]:
        """The best and those of the highest value among the allowed, in more sessions."""
        allowed = [each for each in candidates if self.allowed(each)]
        highest = sorted(allowed, key=lambda each: each.value, reverse=True)
        rules = dict.fromkeys(each.rule for each in (best, *highest))
        return self.simulate([*rules][:_FINALISTS], _TIMES)

    def level(self, candidates: Sequence[SimulatedRule]) -> list[SimulatedRule]:
        """The allowed candidates that cannot be told apart from the best: within the standard error
        of the difference over pairs of sessions, or the tolerance.

        If the log can evaluate none, all that it supports are allowed; if it supports none, the one
        with the most effective items.
        """
        allowed = [each for each in candidates if self.allowed(each)]
        allowed = allowed or [each for each in candidates if self.supported(each)]
        if not allowed:
            return [max(candidates, key=lambda each: each.items)]
        top = max(allowed, key=lambda each: each.value)
        least = self._config.tolerance * abs(top.value)
        return [
            each for each in allowed if top.value - each.value <= max(least, self._error(top, each))
        ]

    def _error(self, one: SimulatedRule, other: SimulatedRule) -> float:
        """Standard error of the difference of their values; sessions draw the same numbers."""
        returns, others = self._returns[one.rule], self._returns[other.rule]
        if len(returns) != len(others):
            return one.error
        return _standard_error(returns - others)

    def best(self, candidates: Sequence[SimulatedRule]) -> SimulatedRule:
        """The simplest of those that cannot be told apart from the best."""
        return min(self.level(candidates), key=_simplicity)

    def most_evident(self, candidates: Sequence[SimulatedRule]) -> SimulatedRule:
        """Of those that cannot be told apart from the best, the rule that the choice starts from,
        or the one with the most support in the log: effective users, or without propensities the
        likelihood; then the most hits."""
        level = self.level(candidates)
        level = [each for each in level if each.rule == self.problem.start] or level
        known = [each for each in level if each.evidence is not None]
        lacking = [each for each in level if each.evidence is None]
        known += [replace(one, evidence=each) for one, each in self._with_evidence(lacking)]
        return min(known, key=_least_evident)

    def halves_agree(
        self, chosen: SimulatedRule, candidates: Sequence[SimulatedRule]
    ) -> tuple[bool, bool]:
        """Whether the chosen rule cannot be told apart from the best allowed one in the sessions of
        either half of the users, as in `level`."""
        own = self._returns[chosen.rule]
        half = half_of(self._store)[np.arange(len(own)) % len(self._store)]
        allowed = {each.rule for each in candidates if self.allowed(each)} | {chosen.rule}
        returns = [self._returns[rule] for rule in allowed if len(self._returns[rule]) == len(own)]
        agree = []
        for mine in (half == 0, half == 1):
            top = max((each[mine] for each in returns), key=_mean)
            if len(top) < _FEWEST:
                agree.append(True)
                continue
            mean = float(top.mean())
            margin = max(_standard_error(top - own[mine]), self._config.tolerance * abs(mean))
            agree.append(bool(own[mine].mean() >= mean - margin))
        return agree[0], agree[1]

    def estimate(self, rule: DecisionRule) -> ValueEstimate:
        """The return of a session under a rule, in sessions that did not choose it.

        Either half of the users is simulated with the calibration of its own rows.
        """
        half, n = half_of(self._store), 2 * self._config.sessions
        checked, found = self.users.calibration_report, list[SimulatedRule]()
        for number in (0, 1):
            own = np.flatnonzero(half == number)
            own = own if len(own) else np.arange(len(half))
            rest = self._store.select(np.roll(own, -(self._config.sessions // 2)))
            users = self.users
            if checked is not None:
                users = replace(users, calibration=checked.halves[number])
            found += self._rolled([rule], users, rest, n, self.problem.seed + 1 + number)
        values = found[0].value, found[1].value
        value, within = sum(values) / 2, sum(each.error**2 for each in found) ** 0.5 / 2
        error = max(within, abs(values[0] - values[1]) / 2)
        optimism = None if checked is None else (checked.optimism, checked.optimism_error)
        doubts = list(_doubts(value, error, self.users))
        length, logged = max(each.length for each in found), self.problem.train.lengths.max()
        if length > logged:
            doubts.append(f"its sessions have {length:.0f} steps, the longest in the log {logged}")
        return ValueEstimate(value, error, values, optimism, tuple(doubts))


def choose_by_simulation(problem: Problem) -> RuleChoice:
    """Choose target, minimum target and temperature, then the reward weight.

    Where items have tags, tag window and temperature follow, and the reward weight with the
    window; where the log shows fatigue, the tag run, and temperature and reward weight with it.
    Where the log has propensities, rules that stay near it follow. For new users, the rules of the
    highest value are then simulated in more sessions. Of rules that the model cannot distinguish,
    the one with the most support in the log is taken.

    With a rule to start from, the candidates are that rule and its neighbours instead, and it stays
    unless one of them is better.
    """
    search = RuleSearch(problem)
    tried = _all(search) if problem.start is None else _near(search, problem.start)
    finalists = tried
    if search.users.reward_report.new_users:
        finalists = search.finalists(tried, search.best(tried))
        again = {each.rule for each in finalists}
        tried = [*(each for each in tried if each.rule not in again), *finalists]
    best = search.most_evident(finalists)
    agree, estimate = search.halves_agree(best, finalists), search.estimate(best.rule)
    where = "" if problem.start is None else "; only rules near that of an earlier run"
    return RuleChoice(
        rule=best.rule,
        chosen_by=_chosen_by(search.users) + where,
        candidates=[best if each.rule == best.rule else each for each in tried],
        warning=_warning(search, best),
        estimate=estimate,
        details={
            **search.users.report(),
            "least_items": search.least_items,
            "least_users": search.least_users,
            "halves_agree": list(agree),
        },
    )


def _near(search: RuleSearch, start: DecisionRule) -> list[SimulatedRule]:
    """The rule `start` and its neighbours."""
    more = _NEAR_THE_LOG if search.least_users else ()
    return search.simulate([*dict.fromkeys(near(start, search.problem, more))])


def _all(search: RuleSearch) -> list[SimulatedRule]:
    """All candidates of the configuration that the best of the earlier ones leads to."""
    problem = search.problem
    tried = search.simulate([*_unweighted(problem)])
    first = search.best(tried).rule
    tried += search.simulate([*_variants(first, reward_weight=problem.config.reward_weights)])
    second = search.best(tried).rule
    tried += _with_lookahead(search, second)
    if problem.validation.item_states.tags.shape[1]:
        tried += _with_tag_window(search, second)
        # Without a tag window, which may only have served to cause no fatigue.
        tried += _with_tag_run(search, second)
    if search.least_users:
        done = {each.rule for each in tried}
        others = (replace(first, **parts) for grid in _NEAR_THE_LOG for parts in _grid(**grid))
        tried += search.simulate([rule for rule in others if rule not in done])
    return tried


def _warning(search: RuleSearch, best: SimulatedRule) -> str:
    said = []
    if not search.supported(best):
        said.append("the log supports no candidate, this one shows the most different items")
    elif not search.allowed(best):
        said.append(
            f"no candidate leaves {search.least_users:g} effective users of the log with weights "
            f"of little spread; this one leaves {best.effective_users:.0f}: the log is too small "
            "to evaluate it"
        )
    return "".join(f"; WARNING: {each}" for each in said)


def _doubts(value: float, error: float, users: UserModel) -> tuple[str, ...]:
    """Why the estimated value may be off by more than a tenth."""
    said, checked, training = [], users.calibration_report, users.training_users
    if error > _FAR_OFF * abs(value):
        said.append(f"its error, {error:.2g}, is more than {_FAR_OFF:.0%} of it")
    if checked is not None and abs(checked.optimism) > max(_FAR_OFF, checked.optimism_error):
        said.append(f"the user model is off by {checked.optimism:+.0%} on held-out rows")
    weighted = training is not None and training.report.weighted
    if not (weighted if checked is None else checked.weighted):
        said.append("the log has no propensities: its policy may have known more of the users")
    return tuple(said)


def _with_lookahead(search: RuleSearch, rule: DecisionRule) -> list[SimulatedRule]:
    """The rule with a lookahead, if more than randomness ends sessions."""
    config, train = search.problem.config, search.problem.train
    mean = float(train.returns.sum(dtype=np.float64)) / train.n_steps
    lookaheads = [each * mean for each in config.lookaheads if each * mean > 0]
    if search.users.session_end_report.kept == "constant":
        return []
    weights = {"reward_weight": config.lookahead_weights, "policy_weight": config.policy_weights}
    return search.simulate([*_variants(rule, lookahead=lookaheads, **weights)])


def _with_tag_window(search: RuleSearch, rule: DecisionRule) -> list[SimulatedRule]:
    """The rule with a tag window of items that are `known`, then with other reward weights.

    At all temperatures: at a low one, the log may support what the policy shows only once some
    items are excluded.
    """
    config, known = search.problem.config, search.problem.scorer.known
    windows = [window for window in config.tag_windows if 0 < window <= known]
    tried = search.simulate([*_variants(rule, temperature=config.temperatures, tag_window=windows)])
    if not tried:
        return []
    best = search.best(tried).rule
    weights = [weight for weight in config.reward_weights if weight != best.reward_weight]
    others = _variants(best, tag_window=sorted({*windows}), reward_weight=weights)
    return [*tried, *search.simulate([*others])]


def _with_tag_run(search: RuleSearch, rule: DecisionRule) -> list[SimulatedRule]:
    """The rule with a tag run, if users have fatigue, then at other temperatures and reward
    weights."""
    config = search.problem.config
    runs = [run for run in config.tag_runs if run] if search.users.fatigue else []
    tried = search.simulate([*_variants(rule, tag_run=runs)])
    if not tried:
        return []
    best = search.best(tried).rule
    weights = {"temperature": config.temperatures, "reward_weight": config.reward_weights}
    return [*tried, *search.simulate([*_variants(best, **weights)])]


def _unweighted(problem: Problem) -> Iterator[DecisionRule]:
    config, targets, policy = problem.config, problem.targets, problem.scorer.policy
    learned = policy.values is not None and bool(policy.config.max_return)
    for temperature in sorted(config.temperatures, reverse=True):
        for target in dict.fromkeys(targets[quantile] for quantile in config.quantiles):
            yield DecisionRule(target, temperature=temperature)
            yield DecisionRule(target, minimum_target=target, temperature=temperature)
        if learned:
            yield DecisionRule(None, temperature=temperature)


def _variants(rule: DecisionRule, **values: Sequence[Any]) -> Iterator[DecisionRule]:
    """The rule with every combination of other values of its fields."""
    others = (replace(rule, **parts) for parts in _grid(**values))
    return (other for other in others if other != rule)


def _grid(**values: Sequence[Any]) -> Iterator[dict[str, Any]]:
    """Every combination of the values."""
    return (dict(zip(values, each, strict=True)) for each in product(*values.values()))


def _simplicity(candidate: SimulatedRule) -> tuple[float, ...]:
    rule = candidate.rule
    return (
        *(rule.tag_run > 0, rule.tag_window > 0, rule.lookahead > 0, -rule.temperature),
        *(rule.reward_weight, rule.lookahead, -rule.policy_weight, -rule.tag_run),
    )


def _mean(values: Float64Array) -> float:
    return float(values.mean()) if len(values) else 0.0


def _standard_error(values: Float64Array) -> float:
    """Of the mean."""
    return float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 1 else 0.0


def _least_evident(candidate: SimulatedRule) -> tuple[float, ...]:
    """Orders rules by evidence, the most first; equal ones by `_simplicity`."""
    evidence = candidate.evidence
    assert evidence is not None
    support = evidence.effective_users or evidence.likelihood
    return (-support, -evidence.hits, *_simplicity(candidate))


def _chosen_by(users: UserModel) -> str:
    if users.training_users is None:
        return (
            "mean return of sessions in the run's reward model, calibrated on validation rows; no "
            "propensities are used"
        )
    report = users.training_users.report
    whose = "new users" if users.reward_report.new_users else "validation users"
    weighted = "weighted by their propensities" if report.weighted else "without weights"
    checked = users.calibration_report
    if checked is not None and checked.weighted:
        weighted += ", and calibrated by propensities"
    return (
        f"mean return of sessions of {whose}, who have the fixed tastes of training users; these "
        f"are fitted to {report.steps:,} training rows {weighted}"
    )
