"""Configuration: what overrides what, clear refusals, and no field that nothing reads."""

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ucfrec.commands.train import settings_text
from ucfrec.errors import InputError
from ucfrec.policies.registry import BUILT_IN, policy_class
from ucfrec.runs.config import TABLES, config_from_dict, resolve_config
from ucfrec.settings import allowed_values

SOURCE = Path(__file__).parents[2] / "ucfrec"


def test_set_overrides_the_file_which_overrides_presets(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[train]\nsteps = 7\nbatch_size = 9\n[policy]\nlambda_mask = 0.3\n")
    presets = {"train": {"batch_size": 3, "warmup_steps": 4}}
    config = resolve_config("ucf", file, ["train.steps=200", "policy.dropout=0"], 5, presets)
    assert (config.train.steps, config.train.batch_size, config.seed) == (200, 9, 5)
    assert config.train.warmup_steps == 4
    assert config.policy == policy_class("ucf").Config(lambda_mask=0.3, dropout=0.0)


@pytest.mark.parametrize(
    "given",
    [
        ["train.steps=200", "policy.dim=32", "csg.band=[0, 1]", "train.cosine=true"],
        {"train.steps": 200, "policy.dim": 32, "csg.band": [0, 1], "train.cosine": True},
        {"train": {"steps": 200, "cosine": True}, "policy": {"dim": 32}, "csg.band": (0, 1)},
        {"train": {"steps": np.int64(200), "cosine": np.bool_(True)}, "policy.dim": 32}
        | {"csg.band": (0.0, 1.0)},
    ],
    ids=["texts", "dotted", "nested", "numpy"],
)
def test_texts_mappings_and_files_go_the_same_way(
    given: Mapping[str, Any] | Sequence[str], tmp_path: Path
) -> None:
    file = tmp_path / "run.toml"
    file.write_text("policy.dim = 32\ncsg.band = [0, 1]\n[train]\nsteps = 200\ncosine = true\n")
    expected = resolve_config("ucf", file)
    assert expected.csg.band == (0.0, 1.0)
    assert resolve_config("ucf", None, given) == expected


def test_only_ucf_trains_on_copies_unless_told_to() -> None:
    assert resolve_config("ucf-paper").augment.copies > 0
    assert resolve_config("ucf").augment.copies == resolve_config("dt").augment.copies == 0
    assert resolve_config("dt", None, ["augment.copies=2"]).augment.copies == 2


@pytest.mark.parametrize("policy", BUILT_IN)
def test_a_configuration_survives_its_record(policy: str) -> None:
    config = resolve_config(policy, None, ["train.steps=3", "csg.band=[0.1, 0.4]"], seed=2)
    assert config_from_dict(asdict(config)) == config


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("train.stepz=1", "train has no field 'stepz'; did you mean 'steps'?"),
        ("trian.steps=1", "no table is called 'trian'; did you mean 'train'?"),
        ("train.steps", "write table.field=value, as in train.steps=200"),
        ("train.steps=many", "train.steps is 'many'; it must be a whole number from 1 to 1e12"),
        ("train.learning_rate=nan", "is nan; it must be a number above 0 and at most 10"),
        ("policy.heads=3", "policy.heads is 3; it must divide policy.dim, which is 128"),
        (f"policy.dim={10**30}", f"is {10**30}; it must be a whole number from 1 to 16,384"),
        ("csg.kind=nonsense", "'nonsense'; it must be 'tangent', 'faithful' or 'noise'"),
        ("csg.band=[0.5, 0.2]", "is [0.5, 0.2]; the first length must not exceed the second"),
        ("csg.band=[-1, 0.2]", "is [-1, 0.2]; it must be 2 values, each a number from 0 to"),
        ("augment.epsilon_r=abc", "'abc'; it must be a number from 0 to 1e15, or unset"),
        ("augment.reward_quantile=1", "it must be a number at least 0 and below 1"),
    ],
)
def test_a_wrong_value_is_refused_in_one_line_wherever_it_is_given(
    override: str, says: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=re.escape(says)) as caught:
        resolve_config("ucf", None, [override])
    assert str(caught.value).startswith(f"--set {override}: ")
    assert "\n" not in str(caught.value)
    name, _, text = override.partition("=")
    if not text or "." not in name:
        return
    table, _, key = name.partition(".")
    file = tmp_path / "run.toml"
    quoted = f'"{text}"' if text in ("many", "nonsense", "abc") else text
    file.write_text(f"[{table}]\n{key} = {quoted}\n")
    with pytest.raises(InputError, match=re.escape(says)) as caught:
        resolve_config("ucf", file)
    assert str(caught.value).startswith(f"{file}: ")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"train": 3}, "train is a table of settings; give a value for one of its fields"),
        ({"steps": 3}, "settings: no table is called 'steps'"),
        ({"train.steps": "200"}, "settings: train.steps is '200'; it must be a whole number"),
        ("train.steps=200", "give a list of texts, or a mapping"),
    ],
)
def test_wrong_settings_from_python_are_refused(given: Any, says: str) -> None:
    with pytest.raises(InputError, match=re.escape(says)):
        resolve_config("ucf", None, given)


def test_a_wrong_file_policy_or_seed_is_named(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("steps = = 3")
    with pytest.raises(InputError, match=r"run\.toml is not TOML"):
        resolve_config("ucf", file)
    with pytest.raises(InputError, match=r"none\.toml does not exist"):
        resolve_config("ucf", tmp_path / "none.toml")
    with pytest.raises(InputError, match="no policy is called 'ufc'"):
        resolve_config("ufc")
    for seed in (-1, 2**32):
        says = f"^seed is {seed}; give a whole number from 0 to 4,294,967,295"
        with pytest.raises(InputError, match=says):
            resolve_config("ucf", seed=seed)


@pytest.fixture(scope="module")
def read() -> set[str]:
    """The attributes that some source file reads."""
    return {
        node.attr
        for file in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }


@pytest.mark.parametrize("policy", BUILT_IN)
def test_every_field_means_something_and_is_read(policy: str, read: set[str]) -> None:
    """A field that nothing reads has no effect."""
    config = resolve_config(policy)
    tables = [(name, getattr(config, name)) for name in TABLES]
    for name, table in tables:
        for field in asdict(table):
            assert field in read, f"{name}.{field}"
            allowed = allowed_values(table, field)
            bounded = re.search(r"\d|'|true", allowed)
            assert bounded, f"{name}.{field} takes any value: {allowed}"
    text = settings_text(policy, 100)
    for setting in (f"{name}.{field}" for name, table in tables for field in asdict(table)):
        meaning = text.partition(f"  {setting} ")[2].split("\n")[1]
        assert meaning.startswith("      "), setting
