"""Plugins: simulators, datasets, benchmarks and policies that packages declare as entry points.

A package adds a simulator to the command line by declaring, in the entry-point group
`ucfrec.simulators`, a short name that points to a `Simulator`; the other groups are alike.
"""

from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ucfrec.errors import InputError

_ONE_OF = {
    "benchmarks": ("benchmark", "ucfrec.benchmark.suite", "Benchmark"),
    "datasets": ("dataset", "ucfrec.logs.mapping", "Dataset"),
    "policies": ("policy", "builtins", "object"),
    "simulators": ("simulator", "ucfrec.evaluation.simulator", "Simulator"),
}
"""Of each group: its singular, for messages, and module and class of what is declared in it."""


def plugin_names(group: str) -> list[str]:
    """Names of the plugins installed in the entry-point group `ucfrec.<group>`, sorted."""
    return sorted(entry_points(group=f"ucfrec.{group}").names)


def load_plugin(group: str, name: str) -> Any:
    """Import the plugin `name` of the entry-point group `ucfrec.<group>`. InputError if no such
    plugin is installed, or several, or it is broken or of another type."""
    entry = _entry(group, name)
    kind, module, title = _ONE_OF[group]
    try:
        plugin = entry.load()
    except Exception as error:  # the module of a plug-in may raise anything
        raise InputError(
            f"the {kind} {name!r} is installed as {entry.value}, which cannot be imported "
            f"({type(error).__name__}: {error}); correct or reinstall its package"
        ) from error
    if not isinstance(plugin, getattr(import_module(module), title)):
        raise InputError(
            f"the {kind} {name!r} is installed as {entry.value}, which is of type "
            f"{type(plugin).__name__}; it must be a {module}.{title}"
        )
    return plugin


def plugin_package(group: str, name: str) -> str:
    """Name of the distribution that the plugin `name` is installed from; empty if it is unknown."""
    return _package(_entry(group, name))


def _entry(group: str, name: str) -> EntryPoint:
    entries = list(entry_points(group=f"ucfrec.{group}", name=name))
    kind, *_ = _ONE_OF[group]
    if not entries:
        installed = ", ".join(plugin_names(group)) or "none"
        raise InputError(f"no {kind} is called {name!r}; installed: {installed}")
    if len({entry.value for entry in entries}) > 1:
        packages = " and ".join(sorted(map(_package, entries)))
        raise InputError(f"the packages {packages} both have a {kind} {name!r}; uninstall one")
    return entries[0]


def _package(entry: EntryPoint) -> str:
    return "" if entry.dist is None else entry.dist.name
