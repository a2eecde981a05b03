"""Settings of the control adapter: each means something, is read, and has a range."""

import ast
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="needs ucfrec[control]")

from ucfrec.errors import InputError
from ucfrec.settings import describe
from ucfrec_control.data.collect import CollectConfig
from ucfrec_control.data.sac import SacConfig
from ucfrec_control.training.rl_baselines import RLConfig

SOURCE = [Path(__file__).parents[2] / name for name in ("control", "ucfrec")]
RL = RLConfig("iql", 100, "hopper", "medium")


@pytest.mark.parametrize("table", [RL, CollectConfig(), SacConfig()])
def test_every_field_means_something_and_is_read(table: Any) -> None:
    read = {
        node.attr
        for folder in SOURCE
        for file in folder.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    listed = list(describe("t", table))
    assert [setting.key for setting in listed] == [f"t.{name}" for name in asdict(table)]
    for setting in listed:
        assert setting.meaning.endswith("."), setting.key
        assert setting.key.partition(".")[2] in read, setting.key


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (
            lambda: replace(RL, algorithm="sac"),
            r"rl\.algorithm is 'sac'; it must be 'iql' or 'cql'",
        ),
        (lambda: replace(RL, steps=0), r"rl\.steps is 0; it must be a whole number from 1"),
        (lambda: CollectConfig(size=0), "size is 0; it must be a whole number from 1"),
        (lambda: CollectConfig(steps=10_000), "learning starts after 10000"),
        (lambda: SacConfig(target_rate=0), r"sac\.target_rate is 0; it must be a number above 0"),
    ],
)
def test_a_wrong_value_is_refused_when_built(build: Callable[[], Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        build()
