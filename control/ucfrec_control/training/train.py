"""Training on a control store, with presets and screening."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting.loop import SILENT, Callbacks
from ucfrec.policies.registry import BUILT_IN, policy_names
from ucfrec.provenance import versions
from ucfrec.runs.config import Config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.screened import train_screened
from ucfrec_control.data.trajectories import PACKAGES, control_source
from ucfrec_control.environments.scores import find_kind, find_task
from ucfrec_control.training.screening import screen_store

_POLICIES: Final = ("ucf", "ucf-paper", "dt", "dc", "lsdt", "bc")
"""Built-in policies whose actions may be vectors."""


def control_policies() -> tuple[str, ...]:
    """Names of the policies to train on control stores: built-in ones, then those of plugins."""
    return (*_POLICIES, *(name for name in policy_names() if name not in BUILT_IN))


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
        names = {key: rule.get(key, value) for key, value in run.items()}
        if any(run[k] not in ([n] if isinstance(n, str) else n) for k, n in names.items()):
            continue
        for table, values in rule.get("set", {}).items():
            tables[table] = tables.get(table, {}) | values
        targets = rule.get("targets", targets)
    return Preset(tables, tuple(targets))


def dataset_of(store: EpisodeStore) -> Mapping[str, Any]:
    """The `source` of a control store: dataset, environment and versions.

    Raises:
        InputError: `store` is not a control store.
    """
    source = store.record.source
    if "env_id" not in source.others:
        raise InputError(
            f"{store.path} is not a control store; write one with `ucfrec-control prepare`"
        )
    return control_source(source, store.path)


def preset_of(dataset: Mapping[str, Any], policy: str) -> Preset:
    """The preset of a method on the dataset that `dataset_of` describes."""
    task = find_task(dataset["env_id"], dataset["dataset"])
    return find_preset(task.name if task else "", find_kind(dataset["dataset"]), policy)


def describe_returns(store: EpisodeStore) -> str:
    """What the logged trajectories returned, which a policy is compared with: two lines of text."""
    dataset, returns = dataset_of(store), np.sort(store.returns)
    task = find_task(dataset["env_id"], dataset["dataset"])
    parts = {"behaviour": returns, "best quarter": returns[-max(1, len(returns) // 4) :]}
    return "\n".join(
        f"{name:13} mean return {values.mean():.4g} of {len(values):,} logged trajectories"
        + (f", score {task.score(values.mean()):.1f}" if task else "")
        for name, values in parts.items()
    )


def train_control(
    store: EpisodeStore,
    out: Path,
    config: Config,
    *,
    screening: str | None = None,
    shared: Path | None = None,
    callbacks: Callbacks = SILENT,
) -> RunRecord:
    """`ucfrec.runs.screened.train_screened` on a control store; `screening` is its `how`.

    Raises:
        InputError: as `train_screened`, or the store is not a control store.
    """
    dataset_of(store)
    entries = {"versions": versions(PACKAGES)}
    return train_screened(
        store, out, config, screening, entries, shared, callbacks, screen=screen_store
    )
