"""Off-policy estimates: the return of a policy, from logs of another policy.

The array functions need no ucfrec run:

    from ucfrec.off_policy import LoggedSteps, estimate

    steps = LoggedSteps(session, reward, propensity, target, user=user)
    for name, one in estimate(steps, seed=0).items():
        print(name, one.value, one.low, one.high)
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Estimate": "estimators",
    "ItemGroups": "logged_steps",
    "LoggedSteps": "logged_steps",
    "Modelled": "logged_steps",
    "Verdict": "verdict",
    "as_pages": "pages",
    "diagnose": "diagnostics",
    "estimate": "estimators",
    "conclude": "verdict",
    "select": "selection",
}
"""Public name to the module that defines it."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    # Neither `ucfrec --help` nor users of the array functions wait for torch.
    if name not in _HOMES:
        raise AttributeError(f"module 'ucfrec.off_policy' has no attribute {name!r}")
    return getattr(import_module(f"ucfrec.off_policy.{_HOMES[name]}"), name)
