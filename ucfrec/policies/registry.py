"""Policies by their `--policy` names; a policy is imported when it is first used.

Other packages add policies through the entry-point group `ucfrec.policies`, which maps a name to
a class derived from `ucfrec.policies.base.SequencePolicy`::

    [project.entry-points."ucfrec.policies"]
    mine = "my_package.policy:MyPolicy"
"""

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

from ucfrec.errors import InputError, warn_user
from ucfrec.plugins import load_plugin, plugin_names, plugin_package

if TYPE_CHECKING:
    from ucfrec.policies.base import SequencePolicy

BUILT_IN = {
    "ucf": "ucf:UCFPolicy",
    "ucf-paper": "ucf:UCFPaperPolicy",
    "dt": "dt:DTPolicy",
    "dc": "convformers:DCPolicy",
    "lsdt": "convformers:LSDTPolicy",
    "dt4rec": "dt:DT4RecPolicy",
    "cdt4rec": "dt:CDT4RecPolicy",
    "edt4rec": "edt4rec:EDT4RecPolicy",
    "sasrec": "sasrec:SASRecPolicy",
    "gsasrec": "sasrec:GSASRecPolicy",
    "bc": "baselines:BCPolicy",
    "popular": "baselines:PopularPolicy",
    "item-rate": "baselines:ItemRatePolicy",
    "recent-clicks": "baselines:RecentClicksPolicy",
    "recent-rate": "baselines:RecentRatePolicy",
    "boosted": "baselines:BoostedPolicy",
    "item-knn": "baselines:ItemKNNPolicy",
    "crm-greedy": "crm_greedy:CRMGreedyPolicy",
}
"""Module in `ucfrec.policies` and class of each built-in policy, by name."""


def policy_names() -> tuple[str, ...]:
    """Names of all policies: the built-in ones, then those of installed plugins."""
    return (*BUILT_IN, *(name for name in plugin_names("policies") if name not in BUILT_IN))


def policy_class(name: str) -> "type[SequencePolicy]":
    """The class of the policy `name`; built-in policies take precedence over plugins.

    Raises:
        InputError: no policy has this name, it cannot be imported, or it is not a `SequencePolicy`
            whose `Config` is a table of settings.
    """
    # Imported here so that listing the names does not need torch.
    from ucfrec.policies.base import PolicyConfig, SequencePolicy
    from ucfrec.settings import is_table

    if isinstance(name, str) and name in BUILT_IN:
        module, _, title = BUILT_IN[name].partition(":")
        built_in: type[SequencePolicy] = getattr(import_module(f"ucfrec.policies.{module}"), title)
        return built_in
    if name not in policy_names():
        raise InputError(f"no policy is called {name!r}; choose from {', '.join(policy_names())}")
    policy_type: object = load_plugin("policies", name)
    if not (isinstance(policy_type, type) and issubclass(policy_type, SequencePolicy)):
        raise InputError(
            f"the policy {name!r} is installed as {policy_type!r}, which is not a class derived "
            "from ucfrec.policies.base.SequencePolicy"
        )
    if not (issubclass(policy_type.Config, PolicyConfig) and is_table(policy_type.Config)):
        raise InputError(
            f"the policy {name!r} is configured by {policy_type.Config!r}, which is not derived "
            "from ucfrec.policies.base.PolicyConfig under @ucfrec.settings.settings_table"
        )
    return policy_type


def policy_package(name: str) -> str:
    """Name of the distribution that the policy `name` is installed from; empty if built in."""
    return "" if name in BUILT_IN else plugin_package("policies", name)


@cache
def note_ignored(name: str) -> None:
    """Warn, once, if a plugin has the name of the built-in policy `name`."""
    if name in BUILT_IN and name in plugin_names("policies"):
        warn_user(
            f"the policy {name!r} of package {plugin_package('policies', name)} is ignored, because"
            " a built-in policy has its name; give it another name"
        )
