"""What the choice of a decision rule is given."""

from collections.abc import Mapping
from dataclasses import dataclass

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.choosing.config import RuleConfig
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.model import UserModel


@dataclass(frozen=True)
class Problem:
    """A policy whose decision rule is to be chosen, and all that it is chosen by."""

    scorer: Scorer
    """The policy under its default rule, with the reward model of `users`."""
    users: UserModel
    """The user model."""
    targets: Mapping[float, float]
    """Return (reward units) of each quantile in `config.quantiles`."""
    train: EpisodeStore
    """Training episodes."""
    validation: EpisodeStore
    """Validation episodes."""
    config: RuleConfig
    """Candidates and conditions."""
    seed: int
    """Of everything random."""
    start: DecisionRule | None = None
    """A rule near which to look for a better one; None to try all candidates."""
