"""What the pages say holds: commands parse, code runs, links lead somewhere, the site builds."""

import ast
import re
import runpy
import subprocess
import sys
import tomllib
from configparser import RawConfigParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.support.markdown import ROOT, Page, anchors, parse
from ucfrec.evaluation.ranking import MEASURES
from ucfrec.runs.config import TABLES

SITE = [Page(str(path.relative_to(ROOT))) for path in sorted((ROOT / "docs").rglob("*.md"))]
REPOSITORY = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
SIBLINGS = ("datasets/README.md", "simulators/README.md", "control/README.md")
PAGES = [*map(Page, (*REPOSITORY, *SIBLINGS)), *SITE]
GENERATED = {"docs/tables.md", "docs/log.md"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NAV = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1].split("\n\n")[0]
BUILT = ROOT / "build" / "docs"
NOTEBOOKS = re.compile(r"^docs/tutorials/(\w+)\.md$")


@pytest.mark.parametrize(
    ("page", "command"), [(page.name, command) for page in PAGES for command in page.commands()]
)
def test_the_commands_parse(page: str, command: str) -> None:
    parse(command)


@pytest.mark.parametrize(
    ("page", "code"),
    [
        # Code that trains is the whole job, end to end.
        pytest.param(page.name, code, marks=[pytest.mark.slow] if ".fit(" in code else [])
        for page in PAGES[1:]
        for code in page.code("python")
        if not code.startswith("--8<--")  # a file with tests of its own
    ],
)
def test_the_python_code_runs(
    page: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(code, page, "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("code", [code for page in PAGES for code in page.code("toml")])
def test_the_toml_is_toml(code: str) -> None:
    assert tomllib.loads(code)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_its_links_and_pictures_exist(page: Page) -> None:
    for link in page.links():
        path, _, fragment = link.partition("#")
        target = (ROOT / page.name).parent / path if path else ROOT / page.name
        notebook = NOTEBOOKS.match(str(target.resolve().relative_to(ROOT)))
        if notebook:  # `docs/notebooks.py` makes this page
            assert (ROOT / "examples" / f"{notebook[1]}.ipynb").is_file(), link
            continue
        assert target.exists(), link
        if target.suffix == ".svg":
            ElementTree.parse(target)
        if fragment:
            assert fragment in anchors(_whole(target)), link


def _whole(path: Path) -> str:
    """A page with the files that it includes."""
    text = path.read_text(encoding="utf-8")
    for included in re.findall(r'^--8<-- "(.+)"$', text, flags=re.MULTILINE):
        text += "\n" + (ROOT / included).read_text(encoding="utf-8")
    return text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_lines_and_pages_are_short_and_in_the_navigation(page: Page) -> None:
    lines = page.text.splitlines()
    rows = (n for n, line in enumerate(lines, 1) if line.startswith("|"))  # cannot be broken
    assert {n for n, line in enumerate(lines, 1) if len(line) > 100} <= {*rows}
    if page in SITE:
        assert len(lines) <= 150 or page.name in GENERATED
        assert f" {page.name.removeprefix('docs/')}\n" in NAV + "\n"


def test_every_table_of_settings_and_every_dataset_has_its_section() -> None:
    assert anchors(Page("docs/settings-reference.md").text) >= {*TABLES}
    assert anchors(Page("docs/datasets.md").text) >= {*PROJECT["entry-points"]["ucfrec.datasets"]}


def test_every_simulator_extra_and_metric_is_named() -> None:
    simulators = PROJECT["entry-points"]["ucfrec.simulators"]
    expected = {
        "simulators": {re.sub(r"(-on|-n[14](-nx0)?)$", "", name) for name in simulators},
        "quickstart": set(PROJECT["optional-dependencies"]) - {"dev", "docs"},
        "numbers": set(MEASURES),
    }
    for page, names in expected.items():
        text = Page(f"docs/{page}.md").text
        assert [name for name in sorted(names) if f"`{name}`" not in text] == []


def test_extras_that_the_pages_name_exist() -> None:
    named = re.findall(r"\.\[([\w,]+)\]", "".join(page.text for page in PAGES))
    assert {*",".join(named).split(",")} <= set(PROJECT["optional-dependencies"])


def _messages() -> str:
    """Every text of the source, with … for what a format string fills in."""
    texts = []
    for package in ("ucfrec", "datasets", "simulators", "control"):
        for file in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    parts = [v.value if isinstance(v, ast.Constant) else "…" for v in node.values]
                    texts.append("".join(map(str, parts)))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.append(node.value)
    return "\n".join(texts)


def test_the_messages_of_troubleshooting_exist() -> None:
    source = _messages()
    lines = Page("docs/troubleshooting.md").text.splitlines()
    rows = [line for line in lines if line.startswith("| `") or ": `" in line[:20]]
    shown = [re.findall(r"`([^`]+)`", row)[0] for row in rows]
    assert len(shown) > 20
    for message in shown:
        if message.startswith("No matching distribution"):  # pip's
            continue
        parts = [part.strip(" ;,()'") for part in re.split(r"…|'\w*'|\w+_id\b|=\.\.\.", message)]
        for part in parts:
            assert part in source, (message, part)


def test_the_pictures_are_drawn_from_the_tables() -> None:
    charts = runpy.run_path(str(ROOT / "docs" / "charts.py"))
    for name, text in charts["pictures"]().items():
        found = (ROOT / "docs" / "assets" / name).read_text(encoding="utf-8")
        assert found == text, f"{name}: run python docs/charts.py"


def test_the_page_of_tables_is_what_the_rows_say() -> None:
    script = ROOT / "benchmarks" / "results_page.py"
    ran = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_the_dockerfile_is_sound() -> None:
    text = (ROOT / "deploy" / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    steps = [line.strip().split(" ", 1) for line in lines]
    known = {"FROM", "WORKDIR", "COPY", "RUN", "USER", "EXPOSE", "HEALTHCHECK", "ENTRYPOINT", "CMD"}
    assert {name for name, _ in steps} <= known
    final = steps[max(n for n, (name, _) in enumerate(steps) if name == "FROM") :]
    assert [rest for name, rest in final if name == "USER"] == ["ucfrec"]  # not root
    lowest = PROJECT["requires-python"].removeprefix(">=").split(",")[0]
    images = {rest.split()[0] for name, rest in steps if name == "FROM"}
    assert images == {f"python:{lowest}-slim"}
    (command,) = (ast.literal_eval(rest) for name, rest in final if name == "CMD")
    parse(" ".join(["ucfrec", *command]))


def test_the_systemd_units_are_sound() -> None:
    for name, section in {"ucfrec.service": "Service", "ucfrec-retrain.timer": "Timer"}.items():
        unit = RawConfigParser(strict=True)
        unit.optionxform = str  # type: ignore[assignment, method-assign]
        unit.read_string((ROOT / "deploy" / name).read_text(encoding="utf-8"))
        assert unit.has_section(section)
        if section == "Service":
            program, *words = unit["Service"]["ExecStart"].split()
            parse(" ".join([Path(program).name, *words]))
            assert unit["Service"]["NoNewPrivileges"] == "true"
            assert unit["Service"]["User"] != "root"


def test_the_retraining_script_calls_commands_that_exist() -> None:
    script = ROOT / "deploy" / "retrain.sh"
    assert subprocess.run(["bash", "-n", str(script)], check=False).returncode == 0
    text = re.sub(r'"\$\{\w+\[@\]\}"', "a.parquet b.parquet", script.read_text(encoding="utf-8"))
    commands = [line for line in text.splitlines() if line.startswith("ucfrec ")]
    assert len(commands) == 4
    for command in commands:
        parse(command)


@pytest.mark.skipif(not BUILT.is_dir(), reason="the site is not built; make docs")
def test_the_site_asks_nothing_of_the_network() -> None:
    """What `make docs` built, which fails where a page or a link is missing."""
    pages = list(BUILT.rglob("*.html"))
    assert len(pages) >= len(SITE)
    loads = re.compile(r'<(script|img|iframe)[^>]+src="?https?:|<link[^>]+stylesheet[^>]+https?:')
    for page in pages:
        assert not loads.search(page.read_text(encoding="utf-8")), page.name
