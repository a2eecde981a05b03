"""The README's code runs, its commands exist, and it stays short."""

from pathlib import Path

import pytest

from tests.support.markdown import Page, parse, run_python

README = Page("README.md")


def test_the_python_example_runs(tmp_path: Path) -> None:
    (code,) = README.code("python")
    assert len([line for line in code.splitlines() if line.strip()]) == 10
    ran = run_python(code, tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("rank") == 2
    assert (tmp_path / "my-policy" / "run.json").is_file()


@pytest.mark.parametrize("command", README.commands())
def test_the_commands_parse(command: str) -> None:
    parse(command)


def test_the_walk_through_has_its_commands() -> None:
    assert {line.split()[1] for line in README.commands()} >= {
        "prepare",
        "train",
        "recommend",
        "ope",
        "evaluate",
        "report",
    }


def test_it_is_short() -> None:
    assert len(README.text.splitlines()) <= 120
