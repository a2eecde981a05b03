"""Learners by the name that `--policy` takes; each is imported once it is asked for.

Anyone's own learner joins them through the entry-point group `ucfrec.policies`, as a short name
that points at a class derived from `ucfrec.policies.base.SequencePolicy`::

    [project.entry-points."ucfrec.policies"]
    mine = "my_package.policy:MyPolicy"
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

from ucfrec.errors import InputError
from ucfrec.plugins import load_plugin, plugin_names

if TYPE_CHECKING:
    from ucfrec.policies.base import SequencePolicy

BUILT_IN: Final = {
    "ucf": "ucf:UCFPolicy",
    "dt": "dt:DTPolicy",
    "dc": "dc:DCPolicy",
    "lsdt": "lsdt:LSDTPolicy",
    "dt4rec": "dt4rec:DT4RecPolicy",
    "cdt4rec": "cdt4rec:CDT4RecPolicy",
    "edt4rec": "edt4rec:EDT4RecPolicy",
    "sasrec": "sasrec:SASRecPolicy",
    "bc": "bc:BCPolicy",
    "popular": "popular:PopularPolicy",
    "item-knn": "item_knn:ItemKNNPolicy",
    "crm-greedy": "crm_greedy:CRMGreedyPolicy",
}
"""Module of `ucfrec.policies`, and class, by name."""


def policy_names() -> tuple[str, ...]:
    """Every learner: those of ucfrec, then those that are installed beside it."""
    return (*BUILT_IN, *(name for name in plugin_names("policies") if name not in BUILT_IN))


def policy_class(name: str) -> "type[SequencePolicy]":
    """The learner called `name`. An installed one does not replace ucfrec's of the same name.

    Raises:
        InputError: there is none, it cannot be imported, or it is no `SequencePolicy` whose
            `Config` is a table of settings.
    """
    if name not in policy_names():
        raise InputError(f"no policy is called {name!r}; there are {', '.join(policy_names())}")
    if name in BUILT_IN:
        module, _, title = BUILT_IN[name].partition(":")
        built_in: type[SequencePolicy] = getattr(import_module(f"ucfrec.policies.{module}"), title)
        return built_in
    return _checked(name, load_plugin("policies", name))


def _checked(name: str, found: object) -> "type[SequencePolicy]":
    from ucfrec.policies.base import PolicyConfig, SequencePolicy
    from ucfrec.settings import is_table

    if not (isinstance(found, type) and issubclass(found, SequencePolicy)):
        raise InputError(
            f"the policy {name!r} is installed as {found!r}, which is no class derived from "
            "ucfrec.policies.base.SequencePolicy"
        )
    if not (issubclass(found.Config, PolicyConfig) and is_table(found.Config)):
        raise InputError(
            f"the policy {name!r} is configured by {found.Config!r}, which is not derived from "
            "ucfrec.policies.base.PolicyConfig under @ucfrec.settings.settings_table"
        )
    return found
