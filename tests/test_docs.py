"""What the pages say holds: commands parse, code runs, links lead somewhere, the site builds."""

import dataclasses
import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.markdown import ROOT, Page, anchors, parse, run_python
from ucfrec.runs.config import resolve_config

SITE = [Page(str(path.relative_to(ROOT))) for path in sorted((ROOT / "docs").rglob("*.md"))]
REPOSITORY = [
    Page(name)
    for name in (
        "README.md",
        "CONTRIBUTING.md",
        "datasets/README.md",
        "simulators/README.md",
        "control/README.md",
    )
]
PAGES = [*REPOSITORY, *SITE]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NAV = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1].split("\n\n")[0]


@pytest.mark.parametrize(
    ("page", "command"),
    [(page.name, command) for page in PAGES[1:] for command in page.commands()],
)
def test_the_commands_parse(page: str, command: str) -> None:
    parse(command)


@pytest.mark.parametrize(
    ("page", "code"), [(page.name, code) for page in PAGES[1:] for code in page.code("python")]
)
def test_the_python_code_runs(page: str, code: str, tmp_path: Path) -> None:
    if code.startswith("--8<--"):
        pytest.skip("an example; test_examples.py runs it")
    ran = run_python(code, tmp_path)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_its_links_lead_somewhere(page: Page) -> None:
    for link in page.links():
        path, _, fragment = link.partition("#")
        target = (ROOT / page.name).parent / path if path else ROOT / page.name
        assert target.exists(), link
        if fragment:
            assert fragment in anchors(_whole(target)), link


def _whole(path: Path) -> str:
    """A page with the files that it includes."""
    text = path.read_text(encoding="utf-8")
    for included in re.findall(r'^--8<-- "(.+)"$', text, flags=re.MULTILINE):
        text += "\n" + (ROOT / included).read_text(encoding="utf-8")
    return text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_lines_are_short(page: Page) -> None:
    """But for rows of tables, which cannot be broken."""
    lines = enumerate(page.text.splitlines(), 1)
    assert [n for n, line in lines if len(line) > 100 and not line.startswith("|")] == []


def test_every_page_is_in_the_navigation() -> None:
    for page in SITE:
        assert f" {page.name.removeprefix('docs/')}\n" in NAV + "\n", page.name


def test_the_settings_page_has_every_table() -> None:
    config = resolve_config("ucf")
    tables = [f.name for f in dataclasses.fields(config)]
    tables = [name for name in tables if dataclasses.is_dataclass(getattr(config, name))]
    assert len(tables) == 6
    assert anchors(Page("docs/settings.md").text) >= set(tables)


def test_every_known_dataset_has_its_section() -> None:
    known = set(PROJECT["entry-points"]["ucfrec.datasets"])
    assert anchors(Page("docs/datasets.md").text) >= known


def test_every_known_simulator_is_named() -> None:
    text = Page("docs/simulators.md").text
    for name in PROJECT["entry-points"]["ucfrec.simulators"]:
        assert f"`{name.removesuffix('-on')}`" in text, name


def test_extras_that_the_pages_name_exist() -> None:
    named = re.findall(r"\.\[([\w,]+)\]", "".join(page.text for page in PAGES))
    extras = {extra for group in named for extra in group.split(",")}
    assert extras
    assert extras <= set(PROJECT["optional-dependencies"])


def test_the_page_of_tables_is_what_the_rows_say() -> None:
    script = ROOT / "benchmarks" / "results_page.py"
    ran = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_the_page_of_tables_rounds_to_three_digits() -> None:
    page = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
    cells = " ".join(line for line in page.splitlines() if line.startswith("|"))
    numbers = re.findall(r"(?<![\w.])\d+\.\d+(?:e[-+]\d+)?", cells)
    assert len(numbers) > 1000
    assert [each for each in numbers if len(re.sub(r"^[0.]+|\.", "", each)) > 3] == []


@pytest.mark.skipif(find_spec("mkdocs") is None, reason="mkdocs is not installed; make docs")
def test_the_site_builds_and_asks_nothing_of_the_network(tmp_path: Path) -> None:
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) >= len(SITE)
    loads = re.compile(
        r"<(?:script|img|iframe)[^>]+src=\"?https?:|<link[^>]+stylesheet[^>]+https?:"
    )
    for page in pages:
        assert not loads.search(page.read_text(encoding="utf-8")), page.name
