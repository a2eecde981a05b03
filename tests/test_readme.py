"""The README: its code runs and prints what it shows, its badges are true, and it stays short."""

import re
import tomllib
from pathlib import Path

import pytest

from tests.support.markdown import ROOT, Page, run_python

README = Page("README.md")


@pytest.mark.slow
def test_the_python_example_prints_what_is_shown(tmp_path: Path) -> None:
    (code,) = README.code("python")
    assert len([line for line in code.splitlines() if line.strip()]) == 10
    ran = run_python(code, tmp_path)
    assert ran.returncode == 0, ran.stderr
    (shown,) = README.code("text")
    assert ran.stdout.split()[:6] == shown.split()[:6]
    assert ran.stdout.split()[:4] == ["user_id", "rank", "item_id", "score"]
    recommended = [tuple(map(int, row.split()[:3])) for row in ran.stdout.splitlines()[1:]]
    assert [row[:2] for row in recommended] == [(0, 1), (0, 2), (1, 1), (1, 2)]
    assert all(user % 2 == item % 2 for user, _, item in recommended)  # the planted pattern
    assert (tmp_path / "my-policy" / "run.json").is_file()


def test_the_walk_through_has_its_commands() -> None:
    named = {line.split()[1] for line in README.commands()}
    assert named >= {"prepare", "train", "recommend", "ope", "serve", "report"}


def test_every_built_in_method_is_in_the_table() -> None:
    from ucfrec.policies.registry import BUILT_IN

    rows = "\n".join(line for line in README.text.splitlines() if line.startswith("| `"))
    assert set(BUILT_IN) <= set(re.findall(r"`([\w-]+)`", rows))


def test_the_badges_are_true() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assets = ROOT / "docs" / "assets"
    license_badge = (assets / "badge-license.svg").read_text(encoding="utf-8")
    assert f"license: {project['project']['license']}" in license_badge
    lowest = project["project"]["requires-python"].removeprefix(">=").split(",")[0]
    assert f"python: {lowest}+" in (assets / "badge-python.svg").read_text(encoding="utf-8")
    assert project["tool"]["mypy"]["strict"]
    gate = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "make test" in gate  # the badge says that tests are required to merge
    assert "make types" in gate


def test_it_is_short() -> None:
    assert len(README.text.splitlines()) <= 160
