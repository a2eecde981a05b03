"""A short name for the source code that a measurement runs through."""

import ast
import hashlib
from collections.abc import Collection, Iterator
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from ucfrec.errors import InputError

_FIRST_PARTY = ("ucfrec", "ucfrec_datasets", "ucfrec_simulators", "ucfrec_control")
_APART = ("ucfrec.policies.registry", "ucfrec.provenance", "ucfrec.reporting", "ucfrec.errors")
"""Modules that make no number: the list of all learners, of which a measurement uses one, and what
keeps, shows and refuses things."""


def code_version(*roots: str | Path, apart: Collection[str] = ()) -> str:
    """A hash of the source files of `roots` and of all that they import of ucfrec's packages.

    Imports are read from the source, inside functions too, and nothing is imported. Documentation,
    tests and modules that are not imported have no part in it. Read once a process: what runs is
    what was on disk when it began.

    Args:
        roots: modules by name, or scripts by path. What is loaded by name at run time (a learner, a
            simulator) is not found by reading imports and has to be given here.
        apart: modules or packages to leave out, with what only they import, beside those that store
            and show results and the registry of learners.

    Returns:
        12 hexadecimal digits.

    Raises:
        InputError: a root has no Python source here.
    """
    tops = {*_FIRST_PARTY, *(root.partition(".")[0] for root in roots if isinstance(root, str))}
    left_out = (*_APART, *apart)
    waiting = [(root if isinstance(root, str) else root.name, _require(root)) for root in roots]
    digests: dict[str, str] = {}
    while waiting:
        name, file = waiting.pop()
        if name in digests or any(f"{name}.".startswith(f"{other}.") for other in left_out):
            continue
        digests[name], imported = _read(file)
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        for level, module, names in imported:
            base = _absolute(package, level, module)
            if base.partition(".")[0] in tops:
                waiting += _modules(base, names)
    lines = "\n".join(f"{name} {digest}" for name, digest in sorted(digests.items()))
    return hashlib.sha256(lines.encode()).hexdigest()[:12]


def plugin_module(group: str, name: str) -> str:
    """The module that `name` of the entry-point group `ucfrec.<group>` lies in, as a root.

    Raises:
        InputError: nothing of that name is installed.
    """
    found = entry_points(group=f"ucfrec.{group}")
    if name not in found.names:
        known = ", ".join(sorted(found.names)) or "none"
        raise InputError(f"no {group[:-1]} is called {name!r}; installed: {known}")
    return found[name].module


_Import = tuple[int, str, tuple[str, ...]]
"""Dots before the module, module, names imported from it."""


@cache
def _read(file: Path) -> tuple[str, tuple[_Import, ...]]:
    """Digest and imports of a source file."""
    source = file.read_bytes()
    return hashlib.sha256(source).hexdigest(), tuple(_imports(ast.parse(source)))


def _imports(tree: ast.Module) -> Iterator[_Import]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((0, alias.name, ()) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = tuple(alias.name for alias in node.names)
            yield node.level, node.module or "", names


def _absolute(package: str, level: int, module: str) -> str:
    """The full name of a module that a file of `package` imports with `level` dots."""
    if level == 0:
        return module
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - level + 1], *([module] if module else [])])


def _modules(base: str, names: tuple[str, ...]) -> list[tuple[str, Path]]:
    """The modules that `from base import names` reads: submodules, else `base` itself."""
    inside = {name: _source(f"{base}.{name}") for name in names}
    found = [(f"{base}.{name}", file) for name, file in inside.items() if file]
    itself = _source(base)
    if itself and len(found) < max(1, len(names)):
        found.append((base, itself))
    return found


def _require(root: str | Path) -> Path:
    file = root if isinstance(root, Path) else _source(root)
    if file is None or not file.is_file():
        raise InputError(f"{root} has no Python source here to name the version of a result by")
    return file


@cache
def _source(module: str) -> Path | None:
    """The source file of a module, found without importing it or its packages."""
    top, *rest = module.split(".")
    spec = find_spec(top)
    if spec is None:
        return None
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    if not folders:
        return Path(spec.origin) if spec.origin and not rest else None
    for base in (folder.joinpath(*rest) for folder in folders):
        if (base / "__init__.py").is_file():
            return base / "__init__.py"
        if rest and base.with_name(f"{base.name}.py").is_file():
            return base.with_name(f"{base.name}.py")
    return None
