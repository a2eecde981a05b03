"""One frozen configuration: defaults, a TOML file over them, `--set` over that."""

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from ucfrec.counterfactual.augment import AugmentConfig
from ucfrec.counterfactual.generators import CSGConfig
from ucfrec.counterfactual.reward_model import CRMConfig
from ucfrec.errors import InputError
from ucfrec.fitting.loop import LoopConfig
from ucfrec.policies.base import PolicyConfig
from ucfrec.policies.registry import POLICIES


@dataclass(frozen=True)
class Config:
    """All that decides a run, with its data."""

    policy_name: str
    policy: PolicyConfig
    train: LoopConfig = field(default_factory=LoopConfig)
    crm: CRMConfig = field(default_factory=CRMConfig)
    csg: CSGConfig = field(default_factory=CSGConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    seed: int = 0


def resolve_config(
    policy_name: str = "ucf",
    file: Path | None = None,
    overrides: Sequence[str] = (),
    seed: int = 0,
    presets: Mapping[str, Any] | None = None,
) -> Config:
    """The configuration of a run.

    Args:
        policy_name: a key of `POLICIES`. Learners other than UCF start without counterfactual
            copies (`augment.copies = 0`), so that `--policy dt` is the plain baseline and
            `--policy dt --set augment.copies=1` is the paper's `w/o Arch`.
        file: TOML with tables `policy`, `train`, `crm`, `csg` and `augment`.
        overrides: `table.field=value`, the value as in TOML.
        presets: the same tables, under those of `file`: what an adapter knows of its data.

    Raises:
        InputError: an unknown learner, table or field, or a value of another type.
    """
    if policy_name not in POLICIES:
        raise InputError(f"no policy is called {policy_name!r}; there are {', '.join(POLICIES)}")
    learner = POLICIES[policy_name]
    config = Config(policy_name, learner.Config(), seed=seed)
    if not learner.augmented:
        config = replace(config, augment=replace(config.augment, copies=0))
    config = _update(config, presets or {}, "presets")
    if file is not None:
        config = _update(config, _read_toml(file), str(file))
    for override in overrides:
        name, separator, text = override.partition("=")
        table, dot, key = name.strip().partition(".")
        if not separator or not dot:
            raise InputError(f"--set {override}: write table.field=value, as in train.steps=200")
        config = _update(config, {table: {key: _toml_value(text)}}, f"--set {override}")
    return config


def config_from_dict(values: Mapping[str, Any]) -> Config:
    """What `dataclasses.asdict` made of a configuration, as one again."""
    config = Config(values["policy_name"], POLICIES[values["policy_name"]].Config())
    tables = {name: table for name, table in values.items() if isinstance(table, Mapping)}
    return replace(_update(config, tables, "the run's configuration"), seed=values["seed"])


def _update(config: Config, tables: Mapping[str, Any], where: str) -> Config:
    for name, values in tables.items():
        known = [f.name for f in fields(config) if is_dataclass(getattr(config, f.name))]
        if name not in known or not isinstance(values, Mapping):
            raise InputError(f"{where}: no table is called {name!r}; {_nearest(name, known)}")
        table = getattr(config, name)
        config = replace(config, **{name: _update_table(table, values, f"{where}: {name}")})
    return config


def _update_table(table: Any, values: Mapping[str, Any], where: str) -> Any:
    changes = {}
    for key, value in values.items():
        known = [f.name for f in fields(table)]
        if key not in known:
            raise InputError(f"{where} has no field {key!r}; {_nearest(key, known)}")
        changes[key] = _coerced(value, getattr(table, key), f"{where}.{key}")
    return replace(table, **changes)


def _coerced(value: Any, current: Any, where: str) -> Any:
    if isinstance(current, tuple):
        value = tuple(value) if isinstance(value, (list, tuple)) else value
    elif (current is None or isinstance(current, float)) and isinstance(value, int):
        value = float(value)
    if value is not None and current is not None and type(value) is not type(current):
        wanted, got = type(current).__name__, type(value).__name__
        raise InputError(f"{where} takes a {wanted}, not the {got} {value!r}")
    return value


def _nearest(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{file} does not exist") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not TOML: {error}") from None
