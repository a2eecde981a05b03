"""Markdown pages of the project: their code blocks, command lines and links."""

import argparse
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ucfrec.commands.cli import UCFREC, Program, parse_command
from ucfrec_control.cli import CONTROL

ROOT = Path(__file__).parents[2]
PROGRAMS = {program.name: program for program in (UCFREC, CONTROL)}
_BLOCK = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^ *```$", flags=re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Page:
    """A Markdown file, by its path from the repository's root."""

    name: str

    @property
    def text(self) -> str:
        return (ROOT / self.name).read_text(encoding="utf-8")

    def code(self, language: str) -> list[str]:
        """Code blocks of a language, without the indentation of the list they stand in."""
        blocks = [(i, code) for i, kind, code in _BLOCK.findall(self.text) if kind == language]
        return ["\n".join(n.removeprefix(i) for n in code.splitlines()) for i, code in blocks]

    def commands(self) -> list[str]:
        """Command lines of `ucfrec` and `ucfrec-control`, continued lines joined."""
        shell = "\n".join(self.code("sh")).replace("\\\n", " ")
        return [
            line.split("  #")[0] for line in shell.splitlines() if line.split(" ")[0] in PROGRAMS
        ]

    def links(self) -> Iterator[str]:
        """Targets of links and pictures that lie in the repository."""
        prose = _BLOCK.sub("", self.text)
        for target in _LINK.findall(prose):
            if not target.startswith(("http://", "https://", "mailto:")):
                yield target


def parse(command: str) -> argparse.Namespace:
    """Read a command line as the program would; exits if it would refuse it."""
    name, *words = shlex.split(command)
    program: Program = PROGRAMS[name]
    return parse_command(program, words)[1]


def run_python(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run code in a process and folder of its own, on one thread."""
    env, command = {**os.environ, "OMP_NUM_THREADS": "1"}, [sys.executable, "-c", code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=env)


def anchors(text: str) -> set[str]:
    """Fragments that headings of a page have, as GitHub and MkDocs make them, and its ids."""
    prose = _BLOCK.sub("", text)
    headings = re.findall(r"^#+ (.+)$", prose, flags=re.MULTILINE)
    ids = set(re.findall(r'<a id="([\w-]+)"></a>', prose))
    return ids | {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
