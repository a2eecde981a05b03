"""Settings of the control adapter: each means something, is read, and has a range."""

import ast
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="needs ucfrec[control]")

from ucfrec.errors import InputError
from ucfrec.settings import describe
from ucfrec_control.training.rl_baselines import RLConfig

SOURCE = [Path(__file__).parents[2] / name for name in ("control", "ucfrec")]
RL = {"algorithm": "iql", "steps": 100, "task": "hopper", "kind": "medium"}


def test_every_field_means_something_and_is_read() -> None:
    read = {
        node.attr
        for folder in SOURCE
        for file in folder.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    for setting in describe("t", RLConfig(**RL)):
        assert setting.meaning.endswith("."), setting.key
        assert setting.key.partition(".")[2] in read, setting.key


@pytest.mark.parametrize(
    ("kind", "wrong", "says"),
    [
        (RLConfig, RL | {"algorithm": "sac"}, r"'sac'; it must be 'iql' or 'cql'"),
        (RLConfig, RL | {"steps": 0}, r"rl\.steps is 0; it must be a whole number from 1"),
    ],
)
def test_a_wrong_value_is_refused_when_built(kind: Any, wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        kind(**wrong)
