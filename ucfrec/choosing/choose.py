"""Choose the decision rule of a run on its log, never in an environment."""

from ucfrec.choosing.by_ranking import choose_by_ranking
from ucfrec.choosing.by_simulation import choose_by_simulation
from ucfrec.choosing.choice import RuleChoice
from ucfrec.choosing.problem import Problem


def choose_rule(problem: Problem) -> RuleChoice:
    """Choose a policy's rule: in simulated sessions, or where the log has none, by ranking."""
    if problem.scorer.returns.per_session:
        return choose_by_simulation(problem)
    return choose_by_ranking(problem)
