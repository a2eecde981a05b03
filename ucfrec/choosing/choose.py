"""Choose the decision rule of a run on its log, never in an environment."""

from collections.abc import Mapping

from ucfrec.acting.scorer import Scorer
from ucfrec.choosing.by_ranking import choose_by_ranking
from ucfrec.choosing.by_simulation import choose_by_simulation
from ucfrec.choosing.choice import RuleChoice
from ucfrec.choosing.config import RuleConfig
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.model import UserModel


def choose_rule(
    scorer: Scorer,
    users: UserModel,
    targets: Mapping[float, float],
    train: EpisodeStore,
    validation: EpisodeStore,
    config: RuleConfig,
    seed: int,
) -> RuleChoice:
    """Choose the rule of a policy: in simulated sessions, or where the log has none, by ranking.

    Args:
        scorer: the policy under its default rule, with the reward model of `users`.
        users: the user model.
        targets: return (reward units) of each quantile in `config.quantiles`.
        train: training episodes.
        validation: validation episodes.
        config: candidates and conditions.
        seed: of everything random.
    """
    if scorer.returns.per_session:
        return choose_by_simulation(scorer, users, targets, train, validation, config, seed)
    return choose_by_ranking(scorer, train, validation, config, seed)
