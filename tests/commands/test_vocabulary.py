"""Documentation, help and messages use the words of the field. `PHRASES` lists words that readers
outside the project stumble over, each with what to write. A page may have a few hits, because a
word can be right in one sentence and odd in another."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.markdown import PROGRAMS, ROOT
from ucfrec.commands.cli import Program, parse_command

PHRASES = {
    r"\btilt(s|ed|ing)?\b": "reward weight",
    r"\bworlds?\b": "environment, simulator",
    r"\bplay(s|ed|ing)?\b": "roll out, simulate, evaluate in",
    r"\bearn(s|ed|ings?)?\b": "return, reward, value",
    r"\bpromis(e|es|ed)\b": "estimated value, predicts",
    r"\blearners?\b": "method, policy",
    r"\b(edited|action) cop(y|ies)\b": "counterfactual augmentation, augmented trajectories",
    r"\badditions\b": "shared components",
    r"\bstrangers?\b": "untrusted input",
    r"\b(nobody|somebody)\b": "no one, or say who",
    r"\b(mend|mended|mends)\b": "fix",
    r"\bbore(s|d)?\b|\bboredom\b|\btires?\b": "satiation",
    r"\bat hand\b": "available",
    r"\bof before\b|\buntil lately\b": "a page states what holds today",
    r"\bon end\b": "in a row",
    r"\banew\b": "again",
    r"\bbeforehand\b": "first",
    r"\b(tells?|told|telling)\b": "shows, reports",
    r"\bjudg(e|es|ed|ing)\b": "evaluate",
    r"\bless UCF\b|, less (the|cloning|UCF)\b": "relative to UCF",
    r"\bfloors?\b": "minimum, baseline",
    r"\bleaves? out\b|\bleft out\b": "excludes",
    r"\bknows? (nothing|of)\b": "does not use",
    r"\b(one|clicks|steps|users|rows) a (session|step|user|row|page|core|second)\b": "per",
    r"\bthe (logs|log) (tell|say|know)s?\b": "the log shows, supports",
}
"""Pattern to what to write instead."""
SAYING = {"InputError", "InputNote", "SettingError", "print", "warn"}
"""Functions and errors whose texts users read."""
MOST = {"SECURITY.md": 0, "README.md": 0, "CONTRIBUTING.md": 0}
"""Hits that a text may have; `MOST_HITS` for others."""
MOST_HITS = 2
GENERATED = {"docs/tables.md", "docs/log.md", "docs/changelog.md", "docs/contributing.md"}


def _texts() -> Iterator[tuple[str, str]]:
    """Name and prose of every documentation page and notebook."""
    pages = [
        ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
    ]
    pages += [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs" / "assets").glob("*.svg")]
    for path in sorted(pages):
        name = str(path.relative_to(ROOT))
        if name not in GENERATED:
            yield name, _prose(path)
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        yield (str(path.relative_to(ROOT)), "\n".join("".join(cell["source"]) for cell in cells))


def _prose(path: Path) -> str:
    """A page without links' targets, and without code that names functions."""
    text = re.sub(r"\]\([^)]*\)", "]", path.read_text(encoding="utf-8"))
    return re.sub(r"```python\n.*?```|^::: .*$", "", text, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize(("name", "text"), list(_texts()), ids=lambda value: value[:40])
def test_the_words_are_those_of_the_field(name: str, text: str) -> None:
    hits = _hits(text)
    assert len(hits) <= MOST.get(name, MOST_HITS), "\n".join(hits)


def _hits(text: str) -> list[str]:
    return [
        f"{found[0]!r} in {_line(text, found.start())!r}: write {better}"
        for pattern, better in PHRASES.items()
        for found in re.finditer(pattern, text, flags=re.IGNORECASE)
    ]


def _line(text: str, at: int) -> str:
    start = text.rfind("\n", 0, at) + 1
    return text[start : start + 90].splitlines()[0]


@pytest.mark.parametrize(
    ("program", "command"),
    [(program, name) for program in PROGRAMS.values() for name in program.commands],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_help_uses_them(program: Program, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse_command(program, [command, "--help-all"])
    assert _hits(" ".join(capsys.readouterr().out.split())) == []


def _messages(file: Path) -> Iterator[str]:
    """Texts of the errors and notes that a file raises, and of all that it prints."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in SAYING:
            said = [each for argument in node.args for each in ast.walk(argument)]
            texts = [each.value for each in said if isinstance(each, ast.Constant)]
            yield "".join(text for text in texts if isinstance(text, str))


@pytest.mark.parametrize("package", ["ucfrec", "datasets", "simulators", "control"])
def test_messages_use_them(package: str) -> None:
    messages = [each for file in (ROOT / package).rglob("*.py") for each in _messages(file)]
    assert messages
    assert [hit for message in messages for hit in _hits(message)] == []


def test_a_hit_is_found() -> None:
    """The list is worth nothing if its patterns do not match."""
    sentence = (
        "What judges tells that the tilt of a learner earns 3 clicks a session in this world."
    )
    found = [p for p in PHRASES if re.search(p, sentence, flags=re.IGNORECASE)]
    assert len(found) == 7
