"""Settings and target returns per task, kind of dataset and method: `presets.toml`."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any


@dataclass(frozen=True)
class Preset:
    """The combination of all rules that match a run."""

    tables: Mapping[str, Mapping[str, Any]]
    """Configuration by table, as in TOML."""
    targets: tuple[float, ...]
    """Target returns; empty if no rule matches the task."""


def find_preset(task: str, kind: str, policy: str) -> Preset:
    """The preset of a method on one kind of dataset of a task.

    Args:
        task: name of a `ucfrec_control.environments.scores.Task`; "" for none.
        kind: as `ucfrec_control.environments.scores.find_kind` returns it.
        policy: one of `ucfrec.policies.registry.policy_names`.
    """
    run = {"task": task, "kind": kind, "policy": policy}
    tables: dict[str, dict[str, Any]] = {}
    targets: list[float] = []
    text = files("ucfrec_control.training").joinpath("presets.toml").read_text(encoding="utf-8")
    for rule in tomllib.loads(text)["rule"]:
        if not all(_names(rule.get(key, value), value) for key, value in run.items()):
            continue
        for table, values in rule.get("set", {}).items():
            tables[table] = tables.get(table, {}) | values
        targets = rule.get("targets", targets)
    return Preset(tables, tuple(targets))


def _names(given: str | list[str], value: str) -> bool:
    """Whether a rule's `given` is `value`, or names it among others."""
    return value in ([given] if isinstance(given, str) else given)
