"""Choose the decision rule in sessions simulated in the user model.

Simulated users have the fixed tastes of training users, which the policy does not know. What a
model says holds only where the log supports it: a candidate must keep to items that the training
log shows often enough, and to more than a handful of them; where the log has propensities, it must
also leave enough effective users to evaluate it off-policy.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, product
from operator import attrgetter
from statistics import median_high
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.choosing.by_ranking import LoggedEvidence
from ucfrec.choosing.choice import Problem, RuleChoice, RuleRecord, SimulatedRule, ValueEstimate
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions, Windows
from ucfrec.processes import progress
from ucfrec.results.statistics import effective_number
from ucfrec.user_model.model import UserSimulator, longest_session
from ucfrec.user_model.reward_fit import draw_sessions
from ucfrec.user_model.reward_report import number_users, read_propensities

_LOGGED_STEPS = 10_000, 1000
"""Logged steps that evidence is from: where it decides what is allowed, and elsewhere."""
_FINALISTS = 8
"""Rules that are simulated again, …"""
_TIMES = 4
"""… in so many times the sessions, as a half of an estimate: few show users more than rules."""
_FEWEST = 10
"""Sessions of a half of the users that can disagree, and that can rule a candidate out."""
_FIRST_PART, _ERRORS_BEHIND = 4, 3.0
"""One in so many of the sessions are simulated before candidates so many standard errors behind the
best are ruled out."""
_SEED_OF_REST = 3
"""Added to the seed for the other sessions; 1 and 2 are for the halves of an estimate."""
_LARGEST_ERROR, _FAR_OFF = 0.08, 0.2
"""Largest standard error and largest correction of an estimate that is printed, as shares of it. Of
normal errors of 8%, four in five are below 10%."""
_FEWEST_STEPS = 50
"""Effective logged steps of half of the users that correct an estimate."""
_RAREST = 3.0
"""Inverse propensities count at most as so many times the number of items."""
_WIDEST = 0.4
"""Largest variance of log weights: above it, `ope` often finds the weights' tail too heavy."""
_ROWS_AT_ONCE = 256
"""Rows of a forward pass, whose logits then stay in the processor's cache."""
_SCORES_AT_ONCE = 2**24
"""Most scores of a forward pass, rows × items: 64 MiB."""
_NEAR_THE_LOG = (
    {"temperature": (1.0, 1.5, 2.0, 4.0, 8.0), "reward_weight": (0.0, 0.25, 0.5, 1.0)},
    {"temperature": (1.0,), "reward_weight": (0.125, 0.25, 0.5, 1.0), "policy_weight": (0.0,)},
)
"""Candidates where a rule must leave effective users of a log with propensities."""
_value = attrgetter("value")


class LoggedGains(NamedTuple):
    """M logged steps and what the user model, which has not seen them, expects of them."""

    expected: Float64Array
    """(M,) expected rewards."""
    gains: Float64Array
    """(M,) rewards less expected rewards."""
    weights: Float64Array
    """(M,) inverse propensities, or ones."""


class Correction(NamedTuple):
    """What a session gains beyond its simulated return."""

    gain: float
    error: float
    """Standard error of the gain."""
    steps: float
    """Effective number of the logged steps that it follows from."""


class Outcomes(NamedTuple):
    """What happened in n simulated sessions of one rule."""

    returns: Float64Array
    lengths: IntArray
    items: IntArray
    """(M,), all that were shown."""
    expected: Float64Array
    """(M,) expected rewards of these."""


class _ManyRules(PolicyActor):
    """Acts by the rule of each session: n sessions by each of several scorers of one policy, each
    with a generator of its own, so that it draws what it would draw alone. A decision is a list,
    whose items are the actions of so many steps; a session goes on to the end of its list."""

    def __init__(
        self,
        scorers: Sequence[Scorer],
        n: int,
        store: EpisodeStore,
        seed: int,
        length: int,
    ) -> None:
        states, rows = store.item_states, len(scorers) * n
        users = np.arange(len(states.user_features))
        super().__init__(scorers[0], rows, store.observation_size, states, None, users, seed)
        self._scorers = scorers
        self._targets = [(each.rule.target, each.rule.minimum_target) for each in scorers]
        self._generators = [torch.Generator().manual_seed(seed) for _ in scorers]
        self._rule = np.repeat(np.arange(len(scorers)), n)
        self._lists, self._chances = torch.zeros(2, 0, 0)
        self._place, self._length = 0, length
        if length > 1:
            # As `recommend` and `serve` do unless they are told to keep what was seen.
            self._shown = torch.zeros(rows, self._n_items, dtype=torch.bool)

    def keep(self, rows: IntArray) -> None:
        super().keep(rows)
        self._rule = self._rule[rows]

    def _decide(
        self,
        rows: Tensor,
        sessions: Sessions,
        excluded: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        place, self._place = self._place, (self._place + 1) % self._length
        if not place:
            lists = self._choose_lists(rows, sessions, excluded)
            self._lists, self._chances = (torch.cat(parts) for parts in zip(*lists, strict=True))
        return self._lists[:, place], self._chances[:, place]

    def _choose_lists(
        self,
        rows: Tensor,
        sessions: Sessions,
        excluded: Tensor | None,
    ) -> list[tuple[Tensor, Tensor]]:
        """Items and their probabilities, (M', length) each, of the `rows` part by part."""
        if excluded is not None:  # a list that would have no item left excludes none
            left = ~excluded if sessions.offer is None else sessions.offer.mask() & ~excluded
            excluded = excluded & left.any(1, keepdim=True)
        decisions = []
        most = max(1, _SCORES_AT_ONCE // self._n_items)
        for batch in _batch_rules(self._rule[rows.numpy()], most):
            begin, windows = batch[0][1].start, list[Windows]()
            # Windows depend on the rule's targets alone.
            for _, rules in groupby(batch, lambda entry: self._targets[entry[0]]):
                (number, part), *others = rules
                end = others[-1][1].stop if others else part.stop
                windows.append(self._scorers[number].windows(sessions.at(slice(part.start, end))))
            weighted = any(self._scorers[number].rule.reward_weight for number, _ in batch)
            together = sessions.at(slice(begin, batch[-1][1].stop))
            query = self._scorer.query(together, Windows.joined(windows), weighted)
            for number, part in batch:
                scorer = self._scorers[number]
                of_rule = query.at(slice(part.start - begin, part.stop - begin))
                left_out = None if excluded is None else excluded[part]
                scores = scorer.scores_of(of_rule, excluded=left_out)
                decisions.append(self._choose(scorer, scores, self._generators[number]))
        return decisions

    def _choose(
        self,
        scorer: Scorer,
        scores: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        rule, k = scorer.rule, min(self._length, self._n_items)
        if self._length == 1:
            items, chances = rule.choose(scores, generator)
            return items.unsqueeze(1), chances.unsqueeze(1)
        draws = torch.rand(len(scores), self._n_items + 1, generator=generator)
        items, chances = rule.rank_items(scores, k, draws, scorer.list_term)
        return items, chances.float()


def _batch_rules(rules: IntArray, most: int) -> list[list[tuple[int, slice]]]:
    """Rules, in parts of at most `most` rows, and where they are among the sorted rules (M,), in
    batches of about `_ROWS_AT_ONCE` rows, or as many as one part."""
    numbers, first = np.unique(rules, return_index=True)
    batches, size = [list[tuple[int, slice]]()], 0
    ends = np.append(first[1:], len(rules))
    for rule, begin, end in zip(numbers, first, ends, strict=True):
        for start in range(int(begin), int(end), most):
            stop = min(start + most, int(end))
            if size and size + stop - start > min(_ROWS_AT_ONCE, most):
                batches.append([])
                size = 0
            batches[-1].append((int(rule), slice(start, stop)))
            size += stop - start
    return batches


class RuleSearch:
    """Simulates decision rules of one policy in a user model."""

    def __init__(self, problem: Problem) -> None:
        """Where users are new, training sessions are begun, otherwise validation sessions."""
        self.problem, self.users, self._config = problem, problem.users, problem.config
        train, seed = problem.train, problem.seed
        new = self.users.reward_report.new_users
        self._store = draw_sessions(train, seed) if new else problem.validation
        self._longest = longest_session(train.lengths)
        self.list_size = train.usual_list()
        counts = train.item_counts()
        if problem.validation.has_offers:
            # What is new in the validation sessions is not in the training ones.
            counts = counts + problem.validation.item_counts()
        self._supported = counts >= self._config.least_impressions
        self.least_items = float(min(self._config.least_items, self._supported.sum() / 4))
        self._many, self._few = (
            LoggedEvidence(problem.scorer, problem.validation, most, seed) for most in _LOGGED_STEPS
        )
        self.least_users = 0.0 if self._many.propensities is None else float(self._config.evidence)
        """Effective users that a rule must leave; 0 without propensities."""
        self._sessions: dict[DecisionRule, Outcomes] = {}

    def simulate(self, rules: Sequence[DecisionRule], times: int = 1) -> list[SimulatedRule]:
        """Roll out the rules, side by side with the same draws, in `times` the configured sessions;
        those far behind the best one after a part of the sessions not in the rest."""
        if not rules:
            return []
        n = times * self._config.sessions
        first = n // _FIRST_PART if n >= _FIRST_PART * _FEWEST else n
        self._sessions |= self._roll_out(rules, self._store, first, self.problem.seed)
        candidates = [self._summarise(rule) for rule in rules]
        if 0 < self.least_users < self._many.n_users:
            candidates = self._add_evidence(candidates)
        return candidates if first == n else self._simulate_rest(candidates, n - first)

    def _simulate_rest(self, candidates: Sequence[SimulatedRule], n: int) -> list[SimulatedRule]:
        """The rules in `n` more sessions, where they are not far behind the best one."""
        allowed = self._select_allowed(candidates)
        top = max(allowed or candidates, key=_value)
        near, least = list[DecisionRule](), self._config.tolerance * abs(top.value)
        for candidate in candidates:
            behind = max(_ERRORS_BEHIND * self._error(top, candidate), least)
            if not allowed or top.value - candidate.value <= behind:
                near.append(candidate.rule)
        first = len(self._sessions[top.rule].returns)
        store = self._store.select(np.roll(np.arange(self._store.n_episodes), -first))
        more = self._roll_out(near, store, n, self.problem.seed + _SEED_OF_REST)
        for rule, outcomes in more.items():
            parts = zip(self._sessions[rule], outcomes, strict=True)
            self._sessions[rule] = Outcomes._make(map(np.concatenate, parts))
        best, results = self._summarise(top.rule), list[SimulatedRule]()
        for candidate in candidates:
            if candidate.rule in more:
                result = self._summarise(candidate.rule)
                results.append(replace(result, evidence=candidate.evidence))
                continue
            error = math.hypot(best.error, self._error(top, candidate))
            value = best.value - (top.value - candidate.value)
            results.append(replace(candidate, value=value, error=error))
        return results

    def _add_evidence(self, candidates: Sequence[SimulatedRule]) -> list[SimulatedRule]:
        """The rules with evidence: of many sessions where it decides, and no lookahead is slow;
        effective users of few sessions count as if there were as many."""
        slow = [item for item in candidates if item.rule.looks_ahead or not self.least_users]
        fast = [item for item in candidates if self.least_users and not item.rule.looks_ahead]
        results = list[SimulatedRule]()
        for logged, part in ((self._many, fast), (self._few, slow)):
            times = self._many.n_users / max(logged.n_users, 1)
            evidence = logged.evaluate([item.rule for item in part]) if part else []
            for item, of_item in zip(part, evidence, strict=True):
                if of_item.effective_users is not None:
                    of_item = replace(of_item, effective_users=times * of_item.effective_users)
                results.append(replace(item, evidence=of_item))
        return results

    def _roll_out(
        self,
        rules: Sequence[DecisionRule],
        store: EpisodeStore,
        n: int,
        seed: int,
    ) -> dict[DecisionRule, Outcomes]:
        """Simulate `n` sessions of each rule that begin as a store's, with draws of its own."""
        scorers, longest = [self.problem.scorer.under(rule) for rule in rules], self._longest
        simulator = UserSimulator(self.users, store, n, longest, seed, len(rules), self.list_size)
        actor = _ManyRules(scorers, n, store, seed, self.list_size)
        live = np.arange(len(rules) * n)
        returns, lengths = np.zeros(len(live)), np.zeros(len(live), dtype=np.int64)
        decisions = list[Float64Array]()
        with progress(len(live), "choose the rule", "sessions") as bar:
            while len(live):
                actor.inform({schema.USER_IDS: simulator.users, schema.OFFER: simulator.offer})
                items, _ = actor.act(simulator.observations(), np.ones(len(live), dtype=bool))
                rewards, going = simulator.step(items)
                actor.observe(items, rewards)
                returns[live] += rewards
                lengths[live] += 1
                decisions.append(np.stack([live, items, simulator.expected]))
                bar.update(len(live) - len(going))
                if len(going) < len(live):
                    live = live[going]
                    actor.keep(going)
        numbers, items, expected = np.concatenate(decisions, axis=1)
        outcomes = {}
        for number, rule in enumerate(rules):
            sessions, steps = slice(number * n, number * n + n), numbers // n == number
            integers = items[steps].astype(np.int64)
            parts = returns[sessions], lengths[sessions], integers, expected[steps]
            outcomes[rule] = Outcomes._make(parts)
        return outcomes

    def _summarise(self, rule: DecisionRule) -> SimulatedRule:
        sessions = self._sessions[rule]
        shares = np.bincount(sessions.items) / len(sessions.items)
        shares = shares[shares > 0]
        return SimulatedRule(
            rule=rule,
            value=float(sessions.returns.mean()),
            error=_standard_error(sessions.returns),
            support=float(self._supported[sessions.items].mean()),
            items=float(np.exp(-(shares * np.log(shares)).sum())),
        )

    def is_supported(self, candidate: SimulatedRule) -> bool:
        """Whether the log shows what the candidate did."""
        enough = candidate.items >= self.least_items
        return enough and candidate.support >= self._config.least_support

    def is_allowed(self, candidate: SimulatedRule) -> bool:
        """Whether the log supports what the candidate did, and can evaluate it."""
        if not self.least_users or not self.is_supported(candidate):
            return self.is_supported(candidate)
        is_narrow = candidate.evidence is not None and candidate.evidence.spread <= _WIDEST
        return is_narrow and candidate.effective_users >= self.least_users

    def _select_allowed(self, candidates: Sequence[SimulatedRule]) -> list[SimulatedRule]:
        allowed = [*filter(self.is_allowed, candidates)]
        return allowed or [*filter(self.is_supported, candidates)]

    def finalists(self, candidates: Sequence[SimulatedRule]) -> list[SimulatedRule]:
        """The best, the start, and allowed ones of the highest value, in more sessions."""
        allowed = sorted(filter(self.is_allowed, candidates), key=_value, reverse=True)
        ranked = (self.best(candidates), *self._find_start(candidates), *allowed)
        rules = dict.fromkeys(candidate.rule for candidate in ranked)
        return self.simulate([*rules][:_FINALISTS], _TIMES)

    def level(self, candidates: Sequence[SimulatedRule]) -> list[SimulatedRule]:
        """The allowed candidates within the standard error of the difference from the best, over
        pairs of sessions, or the tolerance. If the log supports none, the rule that the choice
        starts from, or the one with the most effective items."""
        allowed = self._select_allowed(candidates)
        if not allowed:
            return self._find_start(candidates) or [max(candidates, key=attrgetter("items"))]
        top = max(allowed, key=_value)
        least = self._config.tolerance * abs(top.value)
        return [
            item for item in allowed if top.value - item.value <= max(least, self._error(top, item))
        ]

    def _find_start(self, candidates: Sequence[SimulatedRule]) -> list[SimulatedRule]:
        return [candidate for candidate in candidates if candidate.rule == self.problem.start]

    def _error(self, first: SimulatedRule, second: SimulatedRule) -> float:
        """Standard error of the difference of their values; sessions draw the same numbers."""
        returns, other_returns = (self._sessions[x.rule].returns for x in (first, second))
        n = min(len(returns), len(other_returns))
        return _standard_error(returns[:n] - other_returns[:n])

    def best(self, candidates: Sequence[SimulatedRule]) -> SimulatedRule:
        """The simplest of those that cannot be told apart from the best."""
        return min(self.level(candidates), key=_simplicity)

    def most_evident(self, candidates: Sequence[SimulatedRule]) -> SimulatedRule:
        """Of level rules, the one that the choice starts from, or the one that the log prefers: by
        value less its error, if the log can evaluate it; else by effective users, if more than a
        handful; then by hits, in whole percents; then the simplest."""
        level = self.level(candidates)
        level = self._find_start(level) or level
        unknown = [candidate for candidate in level if not candidate.evidence]
        complete = [candidate for candidate in level if candidate.evidence]

        def rank(candidate: SimulatedRule) -> tuple[float, ...]:
            evidence, users = candidate.evidence, candidate.effective_users
            assert evidence is not None
            support = users if users >= _FEWEST else 0.0
            if self.least_users and self.is_allowed(candidate):
                support = (evidence.value or 0.0) - (evidence.error or 0.0)
            return (-support, -round(evidence.hits, 2), *_simplicity(candidate))

        return min([*complete, *self._add_evidence(unknown)], key=rank)

    def estimate(self, rule: DecisionRule) -> ValueEstimate:
        """The mean return of a session under a rule, in simulated sessions that did not choose it,
        for either half of the users, corrected by logged steps of that half: validation steps say
        how far the user model is off, as item vectors have seen the training rewards. They are too
        few for weights. Training steps say how much weights would change: the log's policies may
        have known more of users than the log shows."""
        halves = [self._roll_half(rule, number) for number in (0, 1)]
        seed, users, corrections = self.problem.seed, self.users, []
        train = draw_sessions(self.problem.train, seed)
        held_out = draw_sessions(self.problem.validation, seed)
        trained_on = self._read_gains(train, users.expect_unseen(train))
        validated_on = self._read_gains(held_out, users.expect_held_out(held_out))
        for half, seen, unseen in zip(halves, trained_on, validated_on, strict=True):
            level = _correct(half, unseen, weighted=False)
            plain, weighted = _correct(half, seen, weighted=False), _correct(half, seen)
            gain = level.gain + weighted.gain - plain.gain
            error = math.hypot(level.error, weighted.error)
            corrections.append((gain, error, min(level.steps, weighted.steps)))
        gains, gain_errors, counts = np.transpose(corrections)
        values = gains + [half.returns.mean() for half in halves]
        value, gain = values.mean(), gains.mean()
        gain_error = math.hypot(*gain_errors) / 2
        errors = [_standard_error(half.returns) for half in halves]
        error = max(math.hypot(*errors, *gain_errors), np.ptp(values)) / 2
        doubts = []
        if error > _LARGEST_ERROR * abs(value):
            doubts.append(f"its error, {error:.2g}, is more than {_LARGEST_ERROR:.0%} of it")
        if abs(gain) > max(_FAR_OFF * abs(value - gain), 2 * gain_error):
            doubts.append(f"the user model is off by {-gain:+.2g} at logged steps like its own")
        episodes, steps = train.all_steps()
        if read_propensities(train, episodes, steps) is None:
            doubts.append("the log has rows without propensities, whose policy may have known more")
        elif counts.min() < _FEWEST_STEPS:
            doubts.append(f"only {counts.min():.0f} effective logged steps are like its own")
        if self.users.reward_report.new_users:
            doubts.append("its users are new, and the log shows only some of what others like")
        length = max(float(half.lengths.mean()) for half in halves)
        if length > (longest := self.problem.train.lengths.max()):
            doubts.append(f"its sessions have {length:.0f} steps, the longest in the log {longest}")
        first, second = values
        return ValueEstimate(value, error, (first, second), (gain, gain_error), tuple(doubts))

    def _read_gains(self, sessions: EpisodeStore, expected: Float64Array) -> list[LoggedGains]:
        """All steps of logged sessions, with `expected` rewards, of either half of the users."""
        episodes, steps = sessions.all_steps()
        propensities = read_propensities(sessions, episodes, steps)
        weights = np.ones(len(steps))
        if propensities is not None:
            weights = np.minimum(1 / propensities, _RAREST * len(self.users.rewarding.item))
        gains = sessions.step_values(schema.REWARD, episodes, steps) - expected
        odd = number_users(sessions)[episodes] % 2 == 1
        return [LoggedGains(expected[half], gains[half], weights[half]) for half in (~odd, odd)]

    def _roll_half(self, rule: DecisionRule, number: int) -> Outcomes:
        """Sessions of one half of the users, with those last that begin as the search's do."""
        users, n = number_users(self._store), self._config.sessions
        episodes = np.flatnonzero(users % 2 == number)
        episodes = episodes if len(episodes) else np.arange(len(users))
        store = self._store.select(np.roll(episodes, -(n // 2)))
        return self._roll_out([rule], store, _TIMES * n, self.problem.seed + 1 + number)[rule]


def _correct(simulated: Outcomes, logged: LoggedGains, weighted: bool = True) -> Correction:
    """The correction of simulated sessions by a line through the gains of logged steps that promise
    as much as some simulated one, at the mean expected reward of simulated steps."""
    rows = logged.expected >= simulated.expected.min()
    expected, gains, weights = (values[rows] for values in logged)
    if not len(gains):
        return Correction(0.0, 0.0, 0.0)
    shares = weights / weights.sum() if weighted else np.full(len(gains), 1 / len(gains))
    beyond = expected - shares @ expected
    slopes = shares * beyond / (shares @ np.square(beyond) or 1.0)
    # The line's value there is a weighted sum of the gains.
    weights = shares + (simulated.expected.mean() - shares @ expected) * slopes
    errors = gains - shares @ gains - (slopes @ gains) * beyond
    steps = len(simulated.expected) / len(simulated.returns)
    error = float(np.linalg.norm(weights * errors))
    return Correction(steps * float(weights @ gains), steps * error, effective_number(weights))


def choose_by_simulation(problem: Problem) -> RuleChoice:
    """Choose target, minimum target and temperature, then the reward weight, and what
    `_search_all` tries next; or, with a rule to start from, among that rule and its neighbours.
    The best rules are then simulated in more sessions; between equal ones, the log decides."""
    search, where = RuleSearch(problem), ""
    if (start := problem.start) is None:
        candidates = _search_all(search)
    else:
        where = "; only rules near that of an earlier run"
        more = _NEAR_THE_LOG if search.least_users else ()
        candidates = search.simulate([*dict.fromkeys(find_neighbours(start, problem, more))])
    finalists = search.finalists(candidates)
    candidates = [*{item.rule: item for item in [*candidates, *finalists]}.values()]
    best = search.most_evident(finalists)
    estimate = search.estimate(best.rule)
    chosen = RuleRecord(
        rule=best.rule,
        chosen_by=f"mean return of simulated sessions{where}",
        warning=_warning(search, best, estimate),
        tried=len(candidates),
        estimate=estimate,
        session_end=search.users.session_end_report,
    )
    return chosen, [best if item.rule == best.rule else item for item in candidates]


def _search_all(search: RuleSearch) -> list[SimulatedRule]:
    """Simulate candidates part by part of the rule, varying the best rule found so far."""
    problem, config = search.problem, search.problem.config
    hottest_first = sorted(config.temperatures, reverse=True)
    plain = [DecisionRule(0.0, temperature=temperature) for temperature in hottest_first]
    candidates = search.simulate([rule for of in plain for rule in _vary_target(of, problem)])
    first = search.best(candidates).rule
    # Rules of lists show many items at a low temperature, too: no list repeats an item.
    grid = {"temperature": config.temperatures} if search.list_size > 1 else {}
    candidates += search.simulate(_vary(first, reward_weight=config.reward_weights, **grid))
    second = search.best(candidates).rule
    if search.list_size == 1 and search.users.session_end_report.kept != "constant":
        # More than randomness ends sessions, and a step is a whole decision.
        grid = {"reward_weight": config.lookahead_weights, "policy_weight": config.policy_weights}
        candidates += search.simulate(_vary(second, lookahead=_lookaheads(problem), **grid))
    if _knows_lists(problem):
        by_gain = replace(second, by_marginal_gain=True, reward_weight=0.0)
        candidates += search.simulate(_vary(by_gain, reward_weight=config.reward_weights))
    if problem.validation.item_states.tags.shape[1]:
        longest, temperatures = problem.scorer.known, config.temperatures
        windows = [window for window in config.tag_windows if 0 < window <= longest]
        # At all temperatures: at a low one, the log may support what the policy shows only once
        # some items are excluded.
        if rules := search.simulate(_vary(second, temperature=temperatures, tag_window=windows)):
            best = search.best(rules).rule
            weights = [weight for weight in config.reward_weights if weight != best.reward_weight]
            more = _vary(best, tag_window=sorted({*windows}), reward_weight=weights)
            candidates += rules + search.simulate(more)
        # Without a tag window, which may only have served to cause no fatigue.
        runs = [run for run in config.tag_runs if run] if search.users.fatigue else []
        if rules := search.simulate(_vary(second, tag_run=runs)):
            best = search.best(rules).rule
            more = _vary(best, temperature=temperatures, reward_weight=config.reward_weights)
            candidates += rules + search.simulate(more)
    if search.least_users:
        done = {candidate.rule for candidate in candidates}
        near = [rule for grid in _NEAR_THE_LOG for rule in _vary(first, **grid)]
        candidates += search.simulate([rule for rule in near if rule not in done])
    return candidates


def _warning(search: RuleSearch, best: SimulatedRule, estimate: ValueEstimate) -> str:
    warnings, mean_return = [], float(search.problem.train.returns.mean())
    if not search.is_supported(best):
        why = "this one shows the most different items"
        if best.rule == search.problem.start:
            why = "so the rule of the earlier run stays"
        warnings.append(f"the log supports no candidate, {why}")
    elif not search.is_allowed(best):
        warnings.append(
            f"no candidate leaves {search.least_users:g} effective users of the log with weights "
            f"of little spread; this one leaves {best.effective_users:.0f}: the log is too small "
            "to evaluate it"
        )
    if estimate.value + 2 * estimate.error < mean_return:
        warnings.append(f"logged sessions have {mean_return:.4g}, which is more; do not launch it")
    return "".join(f"; WARNING: {warning}" for warning in warnings)


def _vary_target(rule: DecisionRule, problem: Problem) -> Iterator[DecisionRule]:
    """The rule with each target, with and without that minimum."""
    for target in dict.fromkeys(problem.targets.values()):
        yield replace(rule, target=target, minimum_target=None)
        yield replace(rule, target=target, minimum_target=target)


def _vary(rule: DecisionRule, **values: Sequence[Any]) -> list[DecisionRule]:
    """The rule's variants with every combination of some values of its parts."""
    variants = [rule]
    for name, candidates in values.items():
        variants = [replace(of, **{name: value}) for of in variants for value in candidates]
    return [variant for variant in variants if variant != rule]


def _lookaheads(problem: Problem) -> list[float]:
    """Values of going on, in reward units; those that are not positive are left out."""
    mean = float(problem.train.returns.sum(dtype="float64")) / problem.train.n_steps
    return [value for factor in problem.config.lookaheads if (value := factor * mean) > 0]


def _knows_lists(problem: Problem) -> bool:
    """Whether decisions are lists, whose items count less, or more, below others like them."""
    return problem.train.usual_list() > 1 and bool(problem.users.reward.above.any())


def find_neighbours(
    rule: DecisionRule, problem: Problem, more: Sequence[Mapping[str, Sequence[float]]] = ()
) -> Iterator[DecisionRule]:
    """The rule, those of `_vary_target`, and those with another of its numbers one candidate up or
    down, of the configuration and `more`. A rule without lookahead also gets one, with the middle
    weight of the policy; one with it loses it, with the middle reward weight. One without it also
    builds lists the other way, if the log shows what that is worth."""
    config = problem.config
    yield rule
    yield from _vary_target(rule, problem)
    grid: dict[str, list[float]] = {
        "temperature": [*config.temperatures],
        "reward_weight": [*config.reward_weights],
    }
    for part in more:
        for name, values in grid.items():
            values += part[name]
    if rule.looks_ahead:
        grid |= {"lookahead": _lookaheads(problem), "policy_weight": [*config.policy_weights]}
        grid["reward_weight"] = [*config.lookahead_weights]
        weight = median_high(config.reward_weights)
        yield replace(rule, reward_weight=weight, lookahead=0.0, policy_weight=1.0)
    elif problem.train.usual_list() == 1 and problem.users.session_end_report.kept != "constant":
        middle = median_high(config.policy_weights)
        for ahead, weight in product(_lookaheads(problem), config.lookahead_weights):
            plain = replace(rule, by_marginal_gain=False, policy_weight=middle)
            yield replace(plain, lookahead=ahead, reward_weight=weight)
    if not rule.looks_ahead and _knows_lists(problem):
        grid["by_marginal_gain"] = [False, True]
    if problem.validation.item_states.tags.shape[1]:
        longest = problem.scorer.known
        grid["tag_window"] = [0, *(steps for steps in config.tag_windows if steps <= longest)]
        grid["tag_run"] = [0, *config.tag_runs] if problem.users.fatigue else [0]
    for name, values in grid.items():
        value = getattr(rule, name)
        smaller = sorted(candidate for candidate in values if candidate < value)
        larger = sorted(candidate for candidate in values if candidate > value)
        yield from _vary(rule, **{name: [*smaller[-1:], *larger[:1]]})


def _simplicity(candidate: SimulatedRule) -> tuple[float, ...]:
    rule = candidate.rule
    return (
        *(rule.by_marginal_gain, rule.lookahead > 0, rule.tag_run > 0, rule.tag_window > 0),
        -rule.temperature,
        *(rule.reward_weight, rule.lookahead, -rule.policy_weight, -rule.tag_run),
    )


def _standard_error(values: Float64Array) -> float:
    return float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 1 else 0.0
