"""`ucfrec settings`: every key, its default, range and meaning; and the way there."""

import re
from dataclasses import asdict

import pytest

from ucfrec.commands.cli import main
from ucfrec.commands.train import settings_text
from ucfrec.policies.registry import BUILT_IN
from ucfrec.runs.config import TABLES, resolve_config


@pytest.mark.parametrize("policy", BUILT_IN)
def test_every_key_stands_in_its_section_and_its_default_is_taken_back(policy: str) -> None:
    config, text = resolve_config(policy), settings_text(policy, 160)
    sections = text.split("\n[")[1:]
    assert [section.partition("]")[0] for section in sections] == list(TABLES)
    overrides = []
    for name, section in zip(TABLES, sections, strict=True):
        rows = [line.split("  ") for line in section.splitlines() if line.startswith(f"  {name}.")]
        cells = [[cell.strip() for cell in row if cell.strip()] for row in rows]
        assert [row[0] for row in cells] == [f"{name}.{key}" for key in asdict(config)[name]]
        assert all(len(row) == 3 for row in cells), cells
        # Below each is what it means, also of those that another class has defined.
        assert len(re.findall(r"\n  \S.*\n {6}\S", section)) == len(rows)
        overrides += [f"{row[0]}={row[1]}" for row in cells if row[1] != "unset"]
    assert resolve_config(policy, None, overrides) == config


def test_the_help_of_train_leads_here(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    assert capsys.readouterr().out.splitlines()[-1].endswith("ucfrec settings --policy NAME")
    assert main(["settings", "--policy", "item-knn"]) == 0
    assert "policy.neighbors" in capsys.readouterr().out
    assert main(["settings", "--policy", "knn"]) == 2
    assert "item-knn" in capsys.readouterr().err
