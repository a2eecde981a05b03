"""The README's code runs, and its commands exist."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from ucfrec.commands.cli import UCFREC, build_parser

README = Path(__file__).parent.parent / "README.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


def commands() -> list[str]:
    shell = "\n".join(code for kind, code in BLOCKS if kind == "sh").replace("\\\n", " ")
    return [line.split("  #")[0] for line in shell.splitlines() if line.startswith("ucfrec ")]


def test_the_python_example_runs(tmp_path: Path) -> None:
    (code,) = (code for kind, code in BLOCKS if kind == "python")
    assert len([line for line in code.splitlines() if line.strip()]) == 10
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert "rank" in ran.stdout


@pytest.mark.parametrize("command", commands())
def test_the_commands_parse(command: str) -> None:
    words = shlex.split(command)[1:]
    build_parser(UCFREC, words).parse_args(words)


def test_the_walk_through_has_its_commands() -> None:
    assert {line.split()[1] for line in commands()} >= {
        "prepare",
        "train",
        "recommend",
        "score",
        "ope",
        "evaluate",
    }
