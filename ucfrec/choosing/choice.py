"""The choice of a decision rule: its settings, the criterion and the result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from ucfrec.acting.decision import DecisionRule, SavedRule
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files import record
from ucfrec.files.record import Entry, Text
from ucfrec.settings import Count, Share, Weight, settings_table
from ucfrec.user_model.model import UserModel
from ucfrec.user_model.session_end import SessionEndReport

_Temperature = Annotated[float, Field(ge=0, le=100)]
_RewardWeight = Annotated[float, Field(ge=0, le=1000)]
_Steps = Annotated[int, Field(ge=0, le=1000)]
_Runs = Annotated[int, Field(ge=0, le=10)]
_SOME = Field(min_length=1)


@settings_table("rule")
class RuleConfig:
    """How the decision rule of a run is chosen.

    Only policies of items with a reward model choose; the rule of others takes the target quantile
    `default_quantile` and the best item.
    """

    choose: bool = True
    """Whether the rule is chosen on validation sessions; otherwise it is the default one."""
    default_quantile: Share = 1.0
    """Quantile of the training returns that is the default rule's target."""
    default_tag_window: _Steps = 0
    """Number of steps whose tags the default rule excludes."""
    quantiles: Annotated[tuple[Share, ...], _SOME] = (0.9, 1.0)
    """Candidates for the target, as quantiles of the training returns; each with and without a
    minimum target at the same value."""
    temperatures: Annotated[tuple[_Temperature, ...], _SOME] = (0.0, 0.5, 1.0)
    """Candidates for the temperature."""
    reward_weights: Annotated[tuple[_RewardWeight, ...], _SOME] = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
    """Candidates for β, the weight of the reward model."""
    lookaheads: Annotated[tuple[Weight, ...], _SOME] = (0.0, 4.0, 16.0)
    """Candidates for the lookahead, in mean rewards, where single items end sessions in the log."""
    lookahead_weights: Annotated[tuple[_RewardWeight, ...], _SOME] = (8.0, 32.0)
    """Candidates for β with a lookahead, where it is the weight of rewards scaled to [0, 1]."""
    policy_weights: Annotated[tuple[Weight, ...], _SOME] = (0.0, 0.5, 1.0)
    """Candidates for the policy's weight with a lookahead."""
    tag_windows: Annotated[tuple[_Steps, ...], _SOME] = (0, 3, 10)
    """Candidates for the number of steps whose tags are excluded, where items have tags."""
    tag_runs: Annotated[tuple[_Runs, ...], _SOME] = (0, 2, 3, 4, 6, 8)
    """Candidates for how often in a row one main tag may be liked, where more causes fatigue."""
    keep_hits: Share = 0.9
    """Without true sessions: least share of the liked items found without the reward model that a
    reward weight must leave."""
    sessions: Count = 100
    """Sessions simulated of each candidate; a quarter of them of those that are far behind then."""
    least_impressions: Count = 10
    """Training impressions from which on the log supports an item."""
    least_support: Share = 0.9
    """Smallest share of a rule's decisions that the log must support."""
    least_items: Annotated[float, Field(ge=1, le=10**9)] = 10.0
    """Smallest effective number of items that a rule must show, the exponential of their entropy: a
    page of them; at most a quarter of the items that the log supports."""
    evidence: Annotated[int, Field(ge=0, le=10**9)] = 200
    """Effective users of the validation sessions that a rule must leave where the log has
    propensities, so that its value can be estimated from logs; 0 for any."""
    tolerance: Annotated[float, Field(ge=0, lt=1)] = 0.02
    """Share of the best estimate by which that of a rule at a higher temperature, or with less
    reward weight, may fall short; the standard error of the sessions is allowed in any case."""


@dataclass(frozen=True)
class Problem:
    """A policy whose decision rule is to be chosen, and all that it is chosen by."""

    scorer: Scorer
    """The policy under its default rule, with the reward model of `users`."""
    users: UserModel
    targets: Mapping[float, float]
    """Return (reward units) of each quantile in `config.quantiles`."""
    train: EpisodeStore
    validation: EpisodeStore
    config: RuleConfig
    seed: int
    start: DecisionRule | None = None
    """A rule near which to look for a better one; None to try all candidates."""


@dataclass(frozen=True)
class RuleEvidence:
    """What validation sessions show of a rule without any model of the users."""

    hits: float
    """Share of liked steps whose item is among the ten best."""
    effective_users: float | None = None
    """Effective sample size in users under importance weights: twice that of the half of the log
    with the smaller one; None without propensities."""
    spread: float = 0.0
    """Variance of the log weights of sessions that are not 0: how heavy the tail is."""
    value: float | None = None
    """Off-policy estimate of the return of a session (SNIPS); None where nothing has weight."""
    error: float | None = None


@dataclass(frozen=True)
class SimulatedRule:
    """A rule and what it did in sessions simulated in the user model."""

    rule: DecisionRule
    value: float
    """Mean return of a session, in reward units."""
    error: float
    support: float
    """Share of decisions on items that the log supports."""
    items: float
    evidence: RuleEvidence | None = None
    """What validation sessions show of it; None if no one looked."""

    @property
    def effective_users(self) -> float:
        """Of `evidence`; 0 without."""
        return self.evidence.effective_users or 0.0 if self.evidence else 0.0


@dataclass(frozen=True)
class ValueEstimate:
    """Return of a session under the chosen rule, in simulated sessions that did not choose it, plus
    what logged steps that promise as much gave more than the user model expects of them."""

    value: float
    error: float
    """Its standard error, over sessions and steps or between the halves, whichever is larger."""
    halves: tuple[float, float]
    correction: tuple[float, float]
    """What logged steps add to the simulated return, and its standard error."""
    doubts: tuple[str, ...]
    """Why it is not printed; empty if it is."""


@dataclass(frozen=True)
class RankedRule:
    """A rule and how it ranks validation rows."""

    rule: DecisionRule
    value: float
    """Mean share of liked impressions, in the validation period, of the items shown, plus by how
    much users like those of them that were logged more than others like these items."""
    hits: float
    """Share of liked validation rows whose item is among those shown."""
    gain: float
    """Difference of `hits` from the most liked items, or from those liked lately if better."""
    gain_error: float
    overlaps: bool
    """Whether it finds liked items better, and has `rule.keep_hits` of the policy's own hits."""


class RuleRecord(Entry):
    """The decision rule that was chosen, and why (see `ucfrec.choosing`)."""

    rule: SavedRule
    chosen_by: Text
    warning: Text = ""
    """What is wrong with the rule; empty if nothing is."""
    tried: record.Count = 0
    """Number of candidates."""
    estimate: ValueEstimate | None = None
    """Its value; None for a rule that was not simulated."""
    session_end: SessionEndReport | None = None


class RankingReport(Entry):
    """How a policy without a chosen rule ranks validation rows."""

    rows: record.Count
    hits: float
    """Share of the rows whose item is among the ten best that the user has not been shown."""
    ndcg: float
    """Mean of 1 / log2(place + 1) of these, 0 for others."""
    baseline_hits: float
    """The same of the items shown most, lately where these are better at it."""
    baseline_ndcg: float


RuleChoice = tuple[RuleRecord, Sequence[SimulatedRule | RankedRule]]
"""The rule that was chosen, and all candidates."""
