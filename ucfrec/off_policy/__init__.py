"""Off-policy estimates: the return of a policy, from logs of another policy.

The array functions need no ucfrec run, and do not load torch:

    from ucfrec.off_policy import LoggedSteps, estimate

    steps = LoggedSteps(session, reward, propensity, target, user=user)
    for name, one in estimate(steps, seed=0).items():
        print(name, one.value, one.low, one.high)
"""

from ucfrec.off_policy.answer import Verdict, conclude
from ucfrec.off_policy.estimators import Estimate, estimate
from ucfrec.off_policy.logged_steps import ItemGroups, LoggedSteps, Modelled, merge_lists
from ucfrec.off_policy.selection import select
from ucfrec.off_policy.verdict import diagnose

__all__ = [
    "Estimate",
    "ItemGroups",
    "LoggedSteps",
    "Modelled",
    "Verdict",
    "conclude",
    "diagnose",
    "estimate",
    "merge_lists",
    "select",
]
