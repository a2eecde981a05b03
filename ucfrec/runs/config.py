"""One frozen configuration: defaults, presets over them, a TOML file over those, `--set` on top."""

import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from pydantic import Field

from ucfrec.counterfactual.augment import AugmentConfig
from ucfrec.counterfactual.generators import CSGConfig
from ucfrec.counterfactual.reward_model import CRMConfig
from ucfrec.errors import InputError
from ucfrec.fitting.loop import LoopConfig
from ucfrec.policies.base import PolicyConfig
from ucfrec.policies.registry import policy_class
from ucfrec.settings import SettingError, nearest, settings_table

TABLES: Final = ("policy", "train", "crm", "csg", "augment")


@settings_table("")
class Config:
    """All that decides a run, with its data."""

    policy_name: str
    """The learner."""
    policy: PolicyConfig
    """The learner's own settings."""
    train: LoopConfig = field(default_factory=LoopConfig)
    """The training loop of the policy."""
    crm: CRMConfig = field(default_factory=CRMConfig)
    """The causal reward model, fitted where there are copies."""
    csg: CSGConfig = field(default_factory=CSGConfig)
    """The generator of counterfactual states."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """The edited copies."""
    # scikit-learn takes no larger one.
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    """Of everything random."""


def resolve_config(
    policy_name: str = "ucf",
    file: Path | None = None,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    seed: int = 0,
    presets: Mapping[str, Any] | None = None,
) -> Config:
    """The configuration of a run; later sources win over earlier ones, whichever table they set.

    Args:
        policy_name: one of `ucfrec.policies.registry.policy_names`. Learners other than UCF start
            without counterfactual copies (`augment.copies = 0`), so that `--policy dt` is the plain
            baseline and `--policy dt --set augment.copies=1` is the paper's `w/o Arch`.
        file: TOML with tables `policy`, `train`, `crm`, `csg` and `augment`.
        overrides: texts `table.field=value`, the value as in TOML; or a mapping, by table and
            field (`{"train": {"steps": 200}}`) or by both at once (`{"train.steps": 200}`).
        seed: of everything random.
        presets: as `overrides`, under `file`: what an adapter knows of its data.

    Raises:
        InputError: an unknown learner, table or field, or a value or combination of values that is
            not allowed; says where it was given.
    """
    given = [*_from_mapping(presets or {}, "presets")]
    if file is not None:
        given += _from_mapping(_read_toml(file), str(file))
    if isinstance(overrides, Mapping):
        given += _from_mapping(overrides, "settings")
    else:
        given += _from_texts(overrides)
    return _build(policy_name, given, seed)


def config_from_dict(values: Mapping[str, Any]) -> Config:
    """What `dataclasses.asdict` made of a configuration, as one again.

    Raises:
        InputError: as `resolve_config`.
    """
    tables = {name: values[name] for name in values if isinstance(values[name], Mapping)}
    given = _from_mapping(tables, "the run's configuration")
    return _build(values["policy_name"], given, values["seed"])


class _Given(NamedTuple):
    """One value, and where it was given."""

    table: str
    key: str
    value: Any
    where: str


def _build(policy_name: str, given: Iterable[_Given], seed: int) -> Config:
    """Each table is built once, from all that was given, so that values are judged together."""
    learner = policy_class(policy_name)
    tables: dict[str, dict[str, Any]] = {name: {} for name in TABLES}
    if not learner.augmented:
        tables["augment"]["copies"] = 0
    sources = {}
    for table, key, value, where in given:
        tables[table][key] = value.item() if isinstance(value, np.generic) else value
        sources[f"{table}.{key}"] = where
    try:
        return Config(
            policy_name,
            learner.Config(**tables["policy"]),
            LoopConfig(**tables["train"]),
            CRMConfig(**tables["crm"]),
            CSGConfig(**tables["csg"]),
            AugmentConfig(**tables["augment"]),
            seed,
        )
    except SettingError as error:
        where = ", ".join(dict.fromkeys(sources[key] for key in error.keys if key in sources))
        raise InputError(f"{where}: {error}" if where else str(error)) from None


def _from_texts(texts: Sequence[str]) -> Iterator[_Given]:
    if isinstance(texts, str):
        raise InputError(f"settings are the text {texts!r}; give a list of texts, or a mapping")
    for text in texts:
        name, separator, value = text.partition("=")
        table, dot, key = name.strip().partition(".")
        where = f"--set {text}"
        if not separator or not dot:
            raise InputError(f"{where}: write table.field=value, as in train.steps=200")
        yield _Given(_table(table, where), key, _toml_value(value), where)


def _from_mapping(values: Mapping[str, Any], where: str) -> Iterator[_Given]:
    for name, value in values.items():
        table, dot, key = str(name).partition(".")
        _table(table, where)
        if dot:
            yield _Given(table, key, value, where)
        elif isinstance(value, Mapping):
            yield from (_Given(table, str(key), own, where) for key, own in value.items())
        else:
            raise InputError(
                f"{where}: {table} is a table of settings, not a value; give its field"
            )


def _table(name: str, where: str) -> str:
    if name not in TABLES:
        raise InputError(f"{where}: no table is called {name!r}; {nearest(name, TABLES)}")
    return name


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
