"""The configuration of a run: defaults, overridden by presets, then a TOML file, then `--set`."""

import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field

from ucfrec.choosing.choice import RuleConfig
from ucfrec.counterfactual.augmentation import AugmentConfig
from ucfrec.counterfactual.generators import CSGConfig
from ucfrec.counterfactual.reward_model import CRMConfig
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_toml
from ucfrec.fitting.loop import LoopConfig
from ucfrec.policies.base import PolicyConfig
from ucfrec.policies.registry import policy_class
from ucfrec.settings import (
    LARGEST_SEED,
    SettingError,
    nearest,
    require_list,
    require_seed,
    settings_table,
    shown,
)

TABLES = ("policy", "train", "crm", "csg", "augment", "rule")
_KINDS: tuple[Any, ...] = (LoopConfig, CRMConfig, CSGConfig, AugmentConfig, RuleConfig)


@settings_table("")
class Config:
    """Everything that determines a run, apart from its data."""

    policy_name: str
    """Name of the policy."""
    policy: PolicyConfig
    """The policy's own settings."""
    train: LoopConfig = field(default_factory=LoopConfig)
    """The training loop of the policy."""
    crm: CRMConfig = field(default_factory=CRMConfig)
    """The causal reward model, fitted if `augment` makes copies."""
    csg: CSGConfig = field(default_factory=CSGConfig)
    """The generator of counterfactual states."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """The copies of training episodes."""
    rule: RuleConfig = field(default_factory=RuleConfig)
    """The choice of the decision rule."""
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 0
    """Seed of every random draw."""


def resolve_config(
    policy_name: str = "ucf",
    file: Path | None = None,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    seed: int = 0,
    presets: Mapping[str, Any] | None = None,
) -> Config:
    """The configuration of a run: `overrides` win over `file`, and `file` over `presets`.

    Args:
        policy_name: one of `ucfrec.policies.registry.policy_names`. The default of `augment.copies`
            is 0 for policies other than `ucf-paper`; `--policy dt --set augment.copies=1` is DT on
            copies of UCF's own generator.
        file: TOML with tables `policy`, `train`, `crm`, `csg`, `augment` and `rule`.
        overrides: texts `table.field=value`, the value in TOML syntax; or a mapping, either nested
            (`{"train": {"steps": 200}}`) or flat (`{"train.steps": 200}`).
        seed: seed of every random draw, 0 to 2³² − 1.
        presets: defaults that a dataset adapter sets for its data; a mapping as in `overrides`.

    Raises:
        InputError: a policy, table or field is unknown, or a value or a combination of values is
            not allowed; the message names the source of the setting.
    """
    of_file = {} if file is None else read_toml(file)
    settings = [*_read_mapping(presets or {}, "presets"), *_read_mapping(of_file, str(file))]
    return _build(policy_name, [*settings, *_read_overrides(overrides)], seed)


def settings_given(overrides: Mapping[str, Any] | Sequence[str]) -> dict[str, Any]:
    """Settings, in any form that `resolve_config` takes, as `{"table.field": value}`."""
    return {f"{table}.{key}": value for table, key, value, _ in _read_overrides(overrides)}


def config_from_dict(values: object) -> Config:
    """Rebuild a configuration from its `asdict`, or itself; errors as of `resolve_config`."""
    if isinstance(values, Config):
        return values
    if not isinstance(values, Mapping) or not {"policy_name", "seed"} <= values.keys():
        raise InputError("the run's configuration has no policy_name or no seed")
    tables = {**values}
    name, seed = tables.pop("policy_name"), tables.pop("seed")
    return _build(str(name), _read_mapping(tables, "the run's configuration"), seed)


_Setting: TypeAlias = tuple[str, str, Any, str]
"""Table, key, value and source."""


def _build(policy_name: str, settings: Iterable[_Setting], seed: int) -> Config:
    """Build each table once, from all its settings, so that values are checked together."""
    policy_type, sources = policy_class(policy_name), {}
    kinds = policy_type.Config, *_KINDS
    tables: dict[str, dict[str, Any]] = {name: {} for name in TABLES}
    if not policy_type.augmented:
        tables["augment"]["copies"] = 0
    for table, key, value, source in (*_read_mapping(policy_type.presets, policy_name), *settings):
        tables[table][key] = value.item() if isinstance(value, np.generic) else value
        sources[f"{table}.{key}"] = source
    try:
        parts = {name: kind(**tables[name]) for name, kind in zip(TABLES, kinds, strict=True)}
        return Config(policy_name, seed=require_seed("seed", seed), **parts)
    except SettingError as error:
        source = ", ".join(dict.fromkeys(sources[key] for key in error.keys if key in sources))
        raise InputError(f"{source}: {error}" if source else str(error)) from None


def _read_overrides(overrides: Mapping[str, Any] | Sequence[str]) -> Iterator[_Setting]:
    if isinstance(overrides, Mapping):
        yield from _read_mapping(overrides, "settings")
        return
    if isinstance(overrides, str) or not isinstance(overrides, Iterable):
        raise InputError(f"settings is {shown(overrides)}; give a list of texts, or a mapping")
    for text in require_list("settings", overrides, "texts table.field=value", str):
        name, separator, value = text.partition("=")
        table, dot, key = name.strip().partition(".")
        source = f"--set {text}"
        if not separator or not dot:
            raise InputError(f"{source}: write table.field=value, as in train.steps=200")
        _require_table(table, source)
        try:
            parsed = tomllib.loads(f"value = {value}")["value"]
        except (ValueError, RecursionError):
            parsed = value.strip()
        yield table, key, parsed, source


def _read_mapping(values: Mapping[str, Any], source: str) -> Iterator[_Setting]:
    for name, value in values.items():
        table, dot, key = str(name).partition(".")
        _require_table(table, source)
        if dot:
            yield table, key, value, source
        elif isinstance(value, Mapping):
            yield from ((table, str(key), entry, source) for key, entry in value.items())
        else:
            raise InputError(
                f"{source}: {table} is a table of settings; give a value for one of its fields"
            )


def _require_table(name: str, source: str) -> None:
    if name not in TABLES:
        raise InputError(f"{source}: no table is called {name!r}; {nearest(name, TABLES)}")
