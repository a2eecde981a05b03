"""Configuration: what overrides what, clear refusals, and no field that nothing reads."""

import ast
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path

import pytest

from ucfrec.errors import InputError
from ucfrec.policies.registry import POLICIES
from ucfrec.runs.config import Config, config_from_dict, resolve_config

SOURCE = Path(__file__).parents[2] / "ucfrec"


def test_set_overrides_the_file_which_overrides_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[train]\nsteps = 7\nbatch_size = 9\n[policy]\nlambda_mask = 0.3\n")
    config = resolve_config("ucf", file, ["train.steps=200", "policy.dropout=0"], seed=5)
    assert (config.train.steps, config.train.batch_size, config.seed) == (200, 9, 5)
    assert asdict(config.policy) == asdict(POLICIES["ucf"].Config()) | {
        "lambda_mask": 0.3,
        "dropout": 0.0,
    }


def test_only_ucf_trains_on_copies_unless_told_to() -> None:
    assert resolve_config("ucf").augment.copies > 0
    assert resolve_config("dt").augment.copies == 0
    assert resolve_config("dt", None, ["augment.copies=2"]).augment.copies == 2


@pytest.mark.parametrize("policy", POLICIES)
def test_a_configuration_survives_its_record(policy: str) -> None:
    config = resolve_config(policy, None, ["train.steps=3", "csg.band=[0.1, 0.4]"], seed=2)
    assert config_from_dict(asdict(config)) == config


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("train.stepz=1", "did you mean 'steps'"),
        ("trian.steps=1", "did you mean 'train'"),
        ("train.steps=many", "takes a int, not the str 'many'"),
        ("train.steps=1.5", "takes a int"),
        ("train.steps", "table.field=value"),
        ("seed=3", "table.field=value"),
    ],
)
def test_a_wrong_override_says_what_is_right(override: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        resolve_config("ucf", None, [override])


def test_a_wrong_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("steps = = 3")
    with pytest.raises(InputError, match=r"run\.toml is not TOML"):
        resolve_config("ucf", file)
    with pytest.raises(InputError, match=r"none\.toml does not exist"):
        resolve_config("ucf", tmp_path / "none.toml")
    with pytest.raises(InputError, match="no policy is called 'ufc'"):
        resolve_config("ufc")


def test_every_field_is_read() -> None:
    """A field that nothing reads is a promise that nothing keeps."""
    read = {
        node.attr
        for file in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    config = resolve_config("ucf")
    tables = [getattr(config, f.name) for f in fields(Config)]
    names = [f.name for table in tables if is_dataclass(table) for f in fields(table)]
    names += [f.name for policy in POLICIES.values() for f in fields(policy.Config)]
    assert set(names) <= read
