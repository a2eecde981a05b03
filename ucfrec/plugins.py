"""Plugins: simulators, datasets, benchmarks and policies that packages declare as entry points.

A package adds a simulator to the command line by declaring, in the entry-point group
`ucfrec.simulators`, a short name that points to a `Simulator`. Datasets are declared in
`ucfrec.datasets`, benchmarks (`ucfrec.benchmark.suite.Benchmark`) in `ucfrec.benchmarks`, and
policies (classes derived from `ucfrec.policies.base.SequencePolicy`) in `ucfrec.policies`.
"""

from importlib.metadata import entry_points
from typing import Any, Final

from ucfrec.errors import InputError

_ONE_OF: Final = {
    "benchmarks": "benchmark",
    "datasets": "dataset",
    "policies": "policy",
    "simulators": "simulator",
}
"""Singular of each group, for messages."""


def plugin_names(group: str) -> list[str]:
    """Names of the plugins installed in the entry-point group `ucfrec.<group>`, sorted."""
    return sorted(entry_points(group=f"ucfrec.{group}").names)


def load_plugin(group: str, name: str) -> Any:
    """Import the plugin `name` of the entry-point group `ucfrec.<group>`.

    Raises:
        InputError: no plugin of that name is installed, or it cannot be imported.
    """
    installed = entry_points(group=f"ucfrec.{group}")
    if name not in installed.names:
        known = ", ".join(plugin_names(group)) or "none"
        raise InputError(f"no {_ONE_OF[group]} is called {name!r}; installed: {known}")
    entry = installed[name]
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the {_ONE_OF[group]} {name!r} is installed as {entry.value}, which cannot be "
            f"imported ({error}); reinstall its package"
        ) from error
