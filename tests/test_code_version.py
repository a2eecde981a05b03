"""The code version of a measurement changes with the modules that it imports, and only those."""

import importlib
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from ucfrec import code_version as module
from ucfrec.code_version import code_version, plugin_module
from ucfrec.errors import InputError

FILES = {
    "__init__.py": "",
    "root.py": "from toolbox import used\nimport toolbox.deep.inner\n",
    "used.py": "def f():\n    from toolbox.lazy import x\n    from .near import y\n",
    "lazy.py": "x = 1\n",
    "near.py": "y = 1\n",
    "unrelated.py": "z = 1\n",
    "deep/__init__.py": "",
    "deep/inner.py": "from ..far import w\n",
    "far.py": "import numpy\n",
}


def _write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / "toolbox" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def _forget() -> None:
    module._read.cache_clear()
    module._source.cache_clear()
    importlib.invalidate_caches()


@pytest.fixture
def toolbox(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    _write(tmp_path, FILES)
    monkeypatch.syspath_prepend(str(tmp_path))
    _forget()
    return tmp_path


@pytest.mark.parametrize(
    ("name", "has_part"),
    [
        *((name, True) for name in ("root.py", "used.py", "lazy.py", "near.py", "far.py")),
        ("deep/inner.py", True),
        ("unrelated.py", False),
    ],
)
def test_what_is_imported_has_a_part_in_it(toolbox: Path, name: str, has_part: bool) -> None:
    before = code_version("toolbox.root")
    _forget()
    assert code_version("toolbox.root") == before
    _write(toolbox, {name: FILES[name] + "more = 1\n"})
    _forget()
    assert (code_version("toolbox.root") != before) == has_part
    assert "toolbox" not in sys.modules, "imports are read, not run"


def test_what_is_left_out_is_left_out_with_what_only_it_imports(toolbox: Path) -> None:
    before = code_version("toolbox.root", exclude=["toolbox.used"])
    _write(toolbox, {"lazy.py": "x = 2\n", "used.py": FILES["used.py"] + "more = 1\n"})
    _forget()
    assert code_version("toolbox.root", exclude=["toolbox.used"]) == before
    _write(toolbox, {"far.py": "w = 3\n"})
    _forget()
    assert code_version("toolbox.root", exclude=["toolbox.used"]) != before


def test_a_script_is_named_by_its_path(toolbox: Path) -> None:
    script = toolbox / "script.py"
    script.write_text("from ucfrec import schema\n")
    before = code_version(script)
    assert before != code_version("ucfrec.schema")
    script.write_text("from ucfrec import schema, errors\nprint()\n")
    _forget()
    assert code_version(script) != before


def test_learners_do_not_depend_on_one_another() -> None:
    _forget()
    ucf = code_version("ucfrec.runs.run", "ucfrec.policies.ucf")
    assert ucf != code_version("ucfrec.runs.run", "ucfrec.policies.dt")
    read = {Path(file).name for file in _files_of("ucfrec.runs.run", "ucfrec.policies.ucf")}
    assert {"run.py", "ucf.py", "store.py", "loop.py", "augment.py"} <= read
    assert not {"dt.py", "cql.py", "registry.py", "page.py", "grid.py", "cli.py"} & read


def _files_of(*roots: str) -> list[str]:
    """Files that `roots` make it read."""
    _forget()
    read: list[str] = []
    whole = module._read.__wrapped__

    def noted(file: Path) -> object:
        read.append(str(file))
        return whole(file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_read", noted)
        code_version(*roots)
    return read


def test_roots_without_source_are_refused() -> None:
    with pytest.raises(InputError, match=r"ucfrec\.nowhere has no Python source"):
        code_version("ucfrec.nowhere")
    with pytest.raises(InputError, match="no simulator is called 'nowhere'"):
        plugin_module("simulators", "nowhere")


def test_plugins_are_found_without_loading_them() -> None:
    assert plugin_module("simulators", "synthetic-catalog") == "ucfrec_simulators.synthetic_catalog"


def test_it_is_the_same_from_an_installed_wheel(tmp_path: Path) -> None:
    root = Path(__file__).parents[1]
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=root, check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    roots = ("ucfrec.runs.run", "ucfrec.policies.ucf", "ucfrec_simulators.benchmark.cells")
    script = (
        "import ucfrec; from ucfrec.code_version import code_version; "
        f"print(ucfrec.__file__, code_version(*{roots}))"
    )
    answer = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "installed")},
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    assert answer[0].startswith(str(tmp_path / "installed"))
    _forget()
    assert answer[1] == code_version(*roots)
