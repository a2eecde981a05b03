"""Choose the decision rule of a run on the validation sessions of its log, never in an environment.

The candidates are played in a model of the users: rewards from the run's reward model, calibrated
on validation rows, or for new users from the tastes of training users, which the policy does not
know (`ucfrec.user_model.training_users`); ends of sessions from a logistic regression on the
training rows. What a model says of a policy holds only where the log supports it, so a candidate
must keep to items that the training log shows often enough, and to more than a handful of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Float64Array, IntArray
from ucfrec.choosing.config import RuleConfig
from ucfrec.choosing.many_rules import ManyRules
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.main_tags import MainTags
from ucfrec.episodes.store import EpisodeStore
from ucfrec.processes import require_blas_memory
from ucfrec.progress import progress
from ucfrec.schema import USER_IDS
from ucfrec.user_model.fatigue import Fatigue, LoggedRuns, fit_fatigue
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_report import fit_line, scores_of
from ucfrec.user_model.reward_rows import RewardRows
from ucfrec.user_model.simulator import LoggedEnds, SessionEnd, UserSimulator
from ucfrec.user_model.training_users import TrainingUsers, sessions_of

_MOST_STEPS = 100_000
"""Logged steps that the models of the users are fitted to at most."""
_FINALISTS, _TIMES = 8, 4
"""Rules that are played again where users differ in their tastes, and in how many times the
sessions: few sessions there say as much of the users as of the rules."""


@dataclass(frozen=True)
class Candidate:
    """A rule and what it did in the model of the users."""

    rule: DecisionRule
    value: float
    """Mean return of a session, in reward units."""
    error: float
    """Its standard error over the sessions."""
    length: float
    """Mean number of steps of a session."""
    support: float
    """Share of decisions on items that the log supports."""
    items: float
    """Effective number of items shown."""

    def as_dict(self) -> dict[str, Any]:
        """As a JSON object; the rule's fields are those of `DecisionRule.as_dict`."""
        return {**asdict(self), "rule": self.rule.as_dict()}


@dataclass(frozen=True)
class Choice:
    """The rule that was chosen, and all candidates."""

    rule: DecisionRule
    candidates: Sequence[Candidate]
    calibration: tuple[float, float]
    """Slope and intercept of the scores that rewards were drawn from, on held-out rows."""
    users: TrainingUsers | None
    """Whose tastes rewards were drawn from; None for the run's reward model."""
    fatigue: Fatigue | None
    """What tires the users in their model; None for nothing."""
    least_items: float
    """Smallest effective number of items that was asked for."""
    supported: bool
    """Whether the log supports what the rule does; if not, no candidate's was."""

    def as_dict(self) -> dict[str, Any]:
        """As a JSON object, with what chose the rule in words."""
        return {
            "rule": self.rule.as_dict(),
            "chosen_by": self._chosen_by(),
            "warning": ""
            if self.supported
            else "; WARNING: the log supports no candidate, this one "
            "shows the most different items",
            "calibration": list(self.calibration),
            "users": None if self.users is None else self.users.report(),
            "fatigue": None if self.fatigue is None else asdict(self.fatigue),
            "least_items": self.least_items,
            "candidates": [candidate.as_dict() for candidate in self.candidates],
        }

    def _chosen_by(self) -> str:
        if self.users is None:
            return (
                "mean return of validation users' sessions in the run's reward model, calibrated "
                "on validation rows; no propensities are used"
            )
        weighted = "weighted by their propensities" if self.users.weighted else "without weights"
        return (
            "mean return of sessions of new users, who have the tastes of training users; these "
            f"are fitted to {self.users.steps:,} training rows {weighted}"
        )


class RuleSearch:
    """Plays decision rules of one policy in a model of the users."""

    def __init__(
        self,
        scorer: Scorer,
        train: EpisodeStore,
        validation: EpisodeStore,
        config: RuleConfig,
        seed: int,
        users: TrainingUsers | None = None,
    ) -> None:
        """
        Args:
            scorer: the policy under its default rule, with a reward model.
            train: training episodes, to which the model of the ends is fitted.
            validation: sessions to begin, and to calibrate the reward model on.
            config: candidates and conditions.
            seed: of the sessions and the draws.
            users: whose training sessions are begun instead, and whose tastes give the rewards;
                None for the reward model's word.
        """
        assert scorer.reward_model is not None
        self._scorer, self._config, self._seed = scorer, config, seed
        model = scorer.reward_model
        require_blas_memory()
        states = validation.item_states
        likeness, tags = Likeness.of(states), MainTags.of(states)
        logged = (LoggedRuns.of(v, tags, model.lags, _MOST_STEPS) for v in (train, validation))
        self.fatigue = fit_fatigue(*logged) if model.binary else None
        end = SessionEnd(likeness, LoggedEnds.of(train, model.lags, _MOST_STEPS, seed))
        self._longest, self.end = int(train.lengths.max()), end
        if users is None:
            rows = RewardRows.of(validation, model.reach, _MOST_STEPS, seed)
            self._store, self._model = validation, model
            self.calibration = calibrate(model, rows)
        else:
            self._store, self._model = sessions_of(train, seed), users.model
            self.calibration = users.calibration
        self._supported = train.item_counts() >= config.least_impressions
        self.least_items = min(config.least_items, self._supported.sum() / 4)

    def play(self, rules: Sequence[DecisionRule], times: int = 1) -> list[Candidate]:
        """Play sessions by each of the rules, side by side, all with the same draws.

        Args:
            rules: to play.
            times: how many times the sessions of the configuration.
        """
        n, count = times * self._config.sessions, len(rules)
        if not count:
            return []
        environment = UserSimulator(
            *(self._store, self._model, self.calibration, self.end, n, self._longest, count),
            self.fatigue,
        )
        scorers = [self._scorer.under(rule) for rule in rules]
        users = np.arange(len(self._store.item_states.user_features))
        states = self._store.item_states
        actor = ManyRules(scorers, n, self._store.observation_size, states, users, seed=self._seed)
        returns, lengths, shown = _played(environment, actor, self._seed)
        numbers = np.arange(count * n).reshape(count, n)
        return [
            self._candidate(rule, returns[of_rule], lengths[of_rule], shown[shown[:, 0] // n == i])
            for i, (rule, of_rule) in enumerate(zip(rules, numbers, strict=True))
        ]

    def _candidate(
        self, rule: DecisionRule, returns: Float64Array, lengths: IntArray, shown: IntArray
    ) -> Candidate:
        """What `rule` did in n sessions, (n,) each; `shown` (M, 2) are sessions and items."""
        n, items = len(returns), shown[:, 1]
        shares = np.bincount(items) / len(items)
        shares = shares[shares > 0]
        return Candidate(
            rule=rule,
            value=float(returns.mean()),
            error=float(returns.std(ddof=1) / n**0.5) if n > 1 else 0.0,
            length=float(lengths.mean()),
            support=float(self._supported[items].mean()),
            items=float(np.exp(-(shares * np.log(shares)).sum())),
        )

    def allowed(self, candidate: Candidate) -> bool:
        """Whether the log supports what the candidate did."""
        enough = candidate.items >= self.least_items
        return enough and candidate.support >= self._config.least_support

    def play_finalists(self, played: Sequence[Candidate], best: Candidate) -> list[Candidate]:
        """The best and the most promising of the allowed candidates, played in more sessions."""
        allowed = [each for each in played if self.allowed(each)]
        promising = sorted(allowed, key=lambda each: each.value, reverse=True)
        rules = dict.fromkeys(each.rule for each in (best, *promising))
        return self.play([*rules][:_FINALISTS], _TIMES)

    def best(self, candidates: Sequence[Candidate]) -> Candidate:
        """The first of the allowed candidates within an error, or the tolerance, of the best.

        If none is allowed, the one with the most effective items.
        """
        allowed = [candidate for candidate in candidates if self.allowed(candidate)]
        if not allowed:
            return max(candidates, key=lambda candidate: candidate.items)
        top = max(allowed, key=lambda candidate: candidate.value)
        enough = top.value - max(top.error, self._config.tolerance * abs(top.value))
        return next(candidate for candidate in allowed if candidate.value >= enough)


def _played(
    environment: UserSimulator, actor: ManyRules, seed: int
) -> tuple[Float64Array, IntArray, IntArray]:
    """Play one session in each of the N environments.

    Returns:
        Returns (N,), lengths (N,), and the environment and item of every step, (M, 2).
    """
    observations, info = environment.reset(seed)
    live = np.arange(environment.num_envs)
    returns, lengths = np.zeros(len(live)), np.zeros(len(live), dtype=np.int64)
    shown = list[IntArray]()
    with progress(len(live), "choose the rule", "sessions") as bar:
        while len(live):
            actor.inform(info)
            items, _ = actor.act(observations, np.ones(len(live), dtype=bool))
            observations, rewards, terminated, truncated, info = environment.step(items)
            actor.observe(items, rewards)
            returns[live] += rewards
            lengths[live] += 1
            shown.append(np.stack([live, items], axis=1))
            going = np.flatnonzero(~(terminated | truncated))
            bar.update(len(live) - len(going))
            if len(going) < len(live):
                live = live[going]
                environment.keep(going)
                actor.keep(going)
                observations, info = observations[going], {USER_IDS: info[USER_IDS][going]}
    return returns, lengths, np.concatenate(shown)


def choose_rule(
    scorer: Scorer,
    targets: Mapping[float, float],
    train: EpisodeStore,
    validation: EpisodeStore,
    config: RuleConfig,
    seed: int,
    users: TrainingUsers | None = None,
) -> Choice:
    """Choose target, minimum target and temperature, then the reward weight.

    Where items have tags, tag window and temperature follow, and the reward weight with the
    window; where the log shows fatigue, the tag run, and temperature and reward weight with it.
    With `users`, the most promising rules are then played in more sessions. Of rules that the
    model cannot tell apart, the one at the highest temperature is taken, which stays nearest to
    the log.

    Args:
        scorer: the policy under its default rule, with a reward model.
        targets: return (reward units) of each quantile in `config.quantiles`.
        train: training episodes.
        validation: validation episodes.
        config: candidates and conditions.
        seed: of the sessions and the draws.
        users: see `RuleSearch`.
    """
    search = RuleSearch(scorer, train, validation, config, seed, users)
    learned = scorer.policy.values is not None and scorer.policy.config.max_return
    played = search.play([*_unweighted(config, targets, learned)])
    first = search.best(played)
    played.extend(search.play([*_weighted(config, first.rule)]))
    second = search.best(_simplest_first(played))
    if validation.item_states.tags.shape[1]:
        if filtered := search.play([*_filtered(config, second.rule, scorer.known)]):
            third = search.best(_simplest_first(filtered)).rule
            windows = {each.rule.tag_window for each in filtered}
            others = (replace(third, tag_window=window) for window in sorted(windows))
            weighted = search.play([rule for other in others for rule in _weighted(config, other)])
            played.extend([*filtered, *weighted])
        # Without a tag window, which may only have served to tire nobody.
        runs = [] if search.fatigue is None else [*_limited(config, second.rule)]
        if limited := search.play(runs):
            third = search.best(_simplest_first(limited)).rule
            played.extend([*limited, *search.play([*_drawn(config, third)])])
    best = search.best(_simplest_first(played))
    if users is not None:
        finalists = search.play_finalists(played, best)
        best = search.best(_simplest_first(finalists))
        rules = {each.rule for each in finalists}
        played = [*(each for each in played if each.rule not in rules), *finalists]
    supported, least_items = search.allowed(best), float(search.least_items)
    return Choice(
        *(best.rule, played, search.calibration, users, search.fatigue, least_items, supported)
    )


def _simplest_first(candidates: Sequence[Candidate]) -> list[Candidate]:
    return sorted(candidates, key=_simplicity)


def _simplicity(candidate: Candidate) -> tuple[float, ...]:
    rule = candidate.rule
    return (
        rule.tag_run > 0,
        rule.tag_window > 0,
        -rule.temperature,
        rule.reward_weight,
        -rule.tag_run,
    )


def _filtered(config: RuleConfig, rule: DecisionRule, known: int) -> Iterator[DecisionRule]:
    """Rules with a tag window of items that are `known`.

    At all temperatures: at a low one, the log may support what the policy shows only once some
    items are left out.
    """
    for temperature, window in product(config.temperatures, config.tag_windows):
        if 0 < window <= known:
            yield replace(rule, temperature=temperature, tag_window=window)


def _limited(config: RuleConfig, rule: DecisionRule) -> Iterator[DecisionRule]:
    """Rules with a tag run."""
    for run in config.tag_runs:
        if run:
            yield replace(rule, tag_run=run)


def _drawn(config: RuleConfig, rule: DecisionRule) -> Iterator[DecisionRule]:
    """The rule at every other pair of temperature and reward weight."""
    for temperature, reward_weight in product(config.temperatures, config.reward_weights):
        if (temperature, reward_weight) != (rule.temperature, rule.reward_weight):
            yield replace(rule, temperature=temperature, reward_weight=reward_weight)


def _unweighted(
    config: RuleConfig, targets: Mapping[float, float], learned: bool
) -> Iterator[DecisionRule]:
    for temperature in sorted(config.temperatures, reverse=True):
        for target in dict.fromkeys(targets[quantile] for quantile in config.quantiles):
            yield DecisionRule(target, temperature=temperature)
            yield DecisionRule(target, minimum_target=target, temperature=temperature)
        if learned:
            yield DecisionRule(None, temperature=temperature)


def _weighted(config: RuleConfig, rule: DecisionRule) -> Iterator[DecisionRule]:
    for reward_weight in config.reward_weights:
        if reward_weight != rule.reward_weight:
            yield replace(rule, reward_weight=reward_weight)


def calibrate(model: ItemRewardModel, rows: RewardRows) -> tuple[float, float]:
    """Slope and intercept of the model's scores that fit logged rewards best.

    By logistic regression for rewards of two values, by least squares otherwise.
    """
    return fit_line(scores_of(model, rows)[0], model.target(rows.rewards), bool(model.binary))
