"""Imports point one way, through the rooms of each package, and tests lie where the source does."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "ucfrec": ROOT / "ucfrec",
    "ucfrec_datasets": ROOT / "datasets" / "ucfrec_datasets",
    "ucfrec_simulators": ROOT / "simulators" / "ucfrec_simulators",
    "ucfrec_control": ROOT / "control" / "ucfrec_control",
}
ORDER = (
    {"arrays", "schema", "errors", "processes", "provenance"},
    {"files", "plugins", "settings"},
    {"results", "fitting"},
    {"episodes"},
    {"logs", "user_model"},
    {"counterfactual"},
    {"policies"},
    {"acting"},
    {"choosing"},
    {"runs"},
    {"evaluation", "recommending"},
    {"off_policy"},
    {"updating"},
    {"reporting"},
    {"benchmark", "tuning"},
    {"python_api"},
    {"exploring"},
    {"commands"},
    {"__init__", "__main__"},
)
"""Rooms and single modules of the core: each imports from earlier sets only."""
TESTED_HERE = {
    "tests/benchmark/test_launches.py",
    "tests/control/test_authors_networks.py",
    "tests/control/test_paper.py",
    "tests/logs/test_fuzzed_logs.py",
    "tests/logs/test_refusals.py",
    "tests/off_policy/test_lists.py",
    "tests/policies/test_known_answers.py",
    "tests/recommending/test_own_policy.py",
    "tests/reporting/test_page_items.py",
    "tests/runs/test_precision.py",
    "tests/test_docs.py",
    "tests/test_examples.py",
    "tests/test_layering.py",
    "tests/test_packaging.py",
    "tests/test_readme.py",
    "tests/commands/test_start.py",
    "tests/commands/test_vocabulary.py",
    "tests/simulators/benchmark/test_benchmark.py",
    "tests/simulators/test_synthetic_environments.py",
}
"""Tests of several modules of the room that they lie in, or of the project as a whole."""


def imports(file: Path, typing: bool = False) -> Iterator[str]:
    """Dotted names of what a file imports, inside functions too, and for `typing` only or not."""
    waiting: list[ast.AST] = [ast.parse(file.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if not typing and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        waiting += ast.iter_child_nodes(node)


def modules(package: str) -> dict[str, Path]:
    """Files of a package by dotted name; a folder stands for its `__init__.py`."""
    folder = PACKAGES[package]
    found = {}
    for file in sorted(folder.rglob("*.py")):
        parts = file.relative_to(folder).with_suffix("").parts
        found[".".join((package, *(part for part in parts if part != "__init__")))] = file
    return found


@cache
def modules_imported(package: str) -> dict[str, set[str]]:
    """Module to the other modules of its package that it imports."""
    known = modules(package)
    graph: dict[str, set[str]] = {}
    for name, file in known.items():
        graph[name] = set()
        for imported in imports(file):
            module = imported if imported in known else imported.rpartition(".")[0]
            if module in known and module != name:
                graph[name].add(module)
    return graph


def room(module: str) -> str:
    """`ucfrec.logs.rows` lies in `logs`; the package itself is `__init__`."""
    return ([*module.split("."), "__init__"])[1]


def rooms_imported(package: str) -> dict[str, set[str]]:
    """Room (or single module beside the rooms) to the others that it imports."""
    graph: dict[str, set[str]] = {}
    for name, others in modules_imported(package).items():
        graph.setdefault(room(name), set()).update({room(other) for other in others} - {room(name)})
    return graph


def test_rooms_of_the_core_import_only_from_rooms_before_them() -> None:
    place = {name: number for number, names in enumerate(ORDER) for name in names}
    for name, others in modules_imported("ucfrec").items():
        here = room(name)
        assert here in place, f"{name} lies in a room that ORDER does not know"
        for other in others:
            there = room(other)
            # `from ucfrec import __version__` is of the package itself, which imports lazily.
            assert there in (here, "__init__") or place[there] < place[here], f"{name} → {other}"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_circle_between_rooms_or_modules(package: str) -> None:
    for graph in (rooms_imported(package), modules_imported(package)):
        # The core's `__init__.py` imports lazily what its users name.
        rooms = {name: graph[name] for name in graph.keys() - {package, "__init__"}}
        try:
            TopologicalSorter(rooms).prepare()
        except CycleError as error:
            pytest.fail(f"circle: {' ← '.join(error.args[1])}")


@pytest.mark.parametrize("package", PACKAGES)
def test_the_core_imports_no_sibling_and_siblings_not_each_other(package: str) -> None:
    files = modules(package).values()
    assert files
    for file in files:
        named = {imported.split(".")[0] for imported in imports(file, typing=True)}
        others = named & (PACKAGES.keys() - {package, "ucfrec"})
        assert not others, f"{file.relative_to(ROOT)} imports {others}"


def test_every_test_lies_where_its_source_does() -> None:
    places = {
        "tests/control": PACKAGES["ucfrec_control"],
        "tests/datasets": PACKAGES["ucfrec_datasets"],
        "tests/simulators": PACKAGES["ucfrec_simulators"],
        "tests": PACKAGES["ucfrec"],
    }
    assert all((ROOT / path).is_file() for path in TESTED_HERE)
    for file in sorted((ROOT / "tests").rglob("test_*.py")):
        path = file.relative_to(ROOT)
        mirrored = next(place for place in places if path.is_relative_to(place))
        folder = places[mirrored] / path.parent.relative_to(mirrored)
        assert folder.is_dir(), f"{path}: there is no {folder.relative_to(ROOT)}"
        if path.as_posix() in TESTED_HERE:
            continue
        module = folder / file.name.removeprefix("test_")
        assert module.is_file(), f"{path}: there is no {module.relative_to(ROOT)}"
