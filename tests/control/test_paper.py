"""The page on the paper names code that exists, and the preset has the values it prints."""

import ast
import re
from pkgutil import resolve_name
from typing import Any

import pytest

from tests.support.markdown import Page
from ucfrec.policies.ucf import UCFPaperPolicy
from ucfrec.runs.config import resolve_config
from ucfrec_control.commands.reproduce import PARTS
from ucfrec_control.training.train import find_preset

PAGE = Page("docs/paper.md").text
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("| ")
]
NAMES = sorted({name for row in ROWS for name in re.findall(r"`(\w+(?:\.\w+){2,})`", str(row))})
SETTINGS = [row for row in ROWS if re.fullmatch(r"`(policy|train|crm|csg|augment)\.\w+`", row[0])]
TASKS = (("halfcheetah", "medium"), ("hopper", "medium"), ("antmaze", ""))


def test_the_page_has_every_part_of_the_paper() -> None:
    first = " ".join(row[0] for row in ROWS)
    for part in (*(f"Algorithm {n}" for n in range(1, 7)), *(f"Eq. {n}" for n in range(1, 7))):
        assert part in first, part
    for part in PARTS:  # table-1, …
        kind, number = part.split("-")
        assert re.search(rf"{kind.title()}s? [\d, ]*\b{number}\b", first), part
    assert len(NAMES) > 25


@pytest.mark.parametrize("name", NAMES)
def test_what_the_page_names_exists(name: str) -> None:
    path = name if name.startswith("ucfrec") else f"ucfrec.{name}"
    assert resolve_name(path) is not None


@pytest.mark.parametrize("row", SETTINGS, ids=lambda row: row[0])
def test_the_preset_has_the_printed_value(row: list[str]) -> None:
    key, printed, *values, reason = row
    table, field = key.strip("`").split(".")
    tables = [find_preset(task, kind, "ucf-paper").tables for task, kind in TASKS]
    configs = [resolve_config("ucf-paper", presets=each) for each in tables]
    actual = [getattr(getattr(config, table), field) for config in configs]
    stated = [parse(value) for value in values]
    assert actual == stated
    if printed == "–":
        assert reason, f"{key}: the page does not say why"
    else:
        several = printed.split(", ") if "[" not in printed else [printed]
        assert [parse(value) for value in (several * 3)[:3]] == stated


def parse(text: str) -> Any:
    value = ast.literal_eval({"false": "False", "true": "True"}.get(text, text))
    return tuple(value) if isinstance(value, list) else value


def test_every_setting_of_a_table_of_the_paper_is_on_the_page() -> None:
    settings = {row[0].strip("`") for row in SETTINGS}
    assert len(settings) == len(SETTINGS) > 30
    assert UCFPaperPolicy.presets.keys() - settings == {"rule.choose"}, "not of a policy of vectors"
