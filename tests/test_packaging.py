"""What is installed: four packages, entry points that load."""

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from tests.test_layering import PACKAGES, ROOT, imports

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
GROUPS = {"console_scripts": PROJECT["scripts"], **PROJECT["entry-points"]}
ENTRY_POINTS = [EntryPoint(name, at, key) for key in GROUPS for name, at in GROUPS[key].items()]

DISTRIBUTIONS = {
    "annotated_types": "pydantic",
    "faiss": "faiss-cpu",
    "py4j": "pyspark",
    "sklearn": "scikit-learn",
    "starlette": "fastapi",
    "structlog": "d3rlpy",
    "threadpoolctl": "scikit-learn",
    "typing_extensions": "pydantic",
}
"""Imported name to the requirement that brings it, where the two differ."""


def required(requirements: list[str]) -> set[str]:
    """Names of the distributions, extras that name the project itself resolved."""
    names = {re.split(r"[\[<>=; ]", each)[0].lower() for each in requirements}
    for extra in re.findall(r"ucfrec\[(\w+)\]", " ".join(requirements)):
        names |= required(PROJECT["optional-dependencies"][extra])
    return names - {"ucfrec"}


def test_what_is_imported_is_required_or_of_an_extra_that_a_message_names() -> None:
    sources = {file: file.read_text() for each in PACKAGES.values() for file in each.rglob("*.py")}
    named = set(re.findall(r"ucfrec\[(\w+)\]", "".join(sources.values())))
    extras = {name: required(of) for name, of in PROJECT["optional-dependencies"].items()}
    assert named <= extras.keys() - {"dev", "docs"}
    offered = set().union(*(extras[name] for name in named))
    known = {*sys.stdlib_module_names, *PACKAGES}
    for file in sources:
        for name in {name.split(".")[0] for name in imports(file)} - known:
            distribution = DISTRIBUTIONS.get(name, name.replace("_", "-")).lower()
            here = file.relative_to(ROOT)
            assert distribution in required(PROJECT["dependencies"]) | offered, f"{here}: {name}"


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_importable_and_typed(package: str) -> None:
    # `datasets` and `control` would shadow Hugging Face's and python-control's packages.
    assert not (PACKAGES[package].parent / "__init__.py").exists()
    assert (PACKAGES[package] / "py.typed").is_file()
    assert (PACKAGES[package] / "__init__.py").is_file()
    module = import_module(package)
    assert Path(str(module.__file__)).parent == PACKAGES[package]


@pytest.mark.parametrize("entry", ENTRY_POINTS, ids=lambda e: f"{e.group}:{e.name}")
def test_entry_points_load(entry: EntryPoint) -> None:
    loaded = entry.load()
    assert callable(loaded) or entry.group != "console_scripts"


def test_the_wheel_holds_four_packages_and_nothing_else(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, timeout=120, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == PACKAGES.keys()
    for package, folder in PACKAGES.items():
        assert f"{package}/py.typed" in names
        for file in folder.rglob("*.py"):
            assert f"{package}/{file.relative_to(folder).as_posix()}" in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_every_pin_is_one_that_any_index_may_have() -> None:
    """Local versions (torch==2.13.0+cpu) are not on PyPI; a plain version admits them."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in pins), pins
    names = [line.partition("==")[0].lower() for line in pins]
    assert len(names) == len(set(names)), "a package has one version"
