"""A hash of the source code that a measurement depends on."""

import ast
import hashlib
from collections.abc import Collection, Iterator
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from ucfrec.errors import InputError

_FIRST_PARTY = ("ucfrec", "ucfrec_datasets", "ucfrec_simulators", "ucfrec_control")
_EXCLUDED = ("ucfrec.policies.registry", "ucfrec.provenance", "ucfrec.reporting", "ucfrec.errors")
"""Modules that change no result: the registry imports every learner although a measurement uses
one; the others record results, report them and define the error class."""


def code_version(*roots: str | Path, exclude: Collection[str] = ()) -> str:
    """Hash the source files of `roots` and of every ucfrec module that they import, transitively.

    Import statements are parsed from the source, also those inside functions; nothing is executed.
    Each file is read once per process, so a file that is edited while the process runs does not
    change the hash.

    Args:
        roots: module names, or paths of scripts. Modules loaded by name at run time (a learner, a
            simulator) do not appear in import statements and have to be listed here.
        exclude: further modules or packages to leave out, together with modules that only they
            import. The registry of learners and the modules that record and report results are
            always left out.

    Returns:
        The first 12 hexadecimal digits of a SHA-256.

    Raises:
        InputError: a root has no Python source file.
    """
    tops = {*_FIRST_PARTY, *(root.partition(".")[0] for root in roots if isinstance(root, str))}
    excluded = (*_EXCLUDED, *exclude)
    pending = [(root if isinstance(root, str) else root.name, _require(root)) for root in roots]
    digests: dict[str, str] = {}
    while pending:
        name, file = pending.pop()
        if name in digests or any(f"{name}.".startswith(f"{other}.") for other in excluded):
            continue
        digests[name], imported = _read(file)
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        for level, module, names in imported:
            base = _absolute(package, level, module)
            if base.partition(".")[0] in tops:
                pending += _modules(base, names)
    lines = "\n".join(f"{name} {digest}" for name, digest in sorted(digests.items()))
    return hashlib.sha256(lines.encode()).hexdigest()[:12]


def plugin_module(group: str, name: str) -> str:
    """The name of the module that defines plugin `name`, without importing it.

    Args:
        group: the part of the entry-point group after `ucfrec.`, e.g. "simulators".
        name: of the plugin.

    Returns:
        A root for `code_version`.

    Raises:
        InputError: no plugin of that name is installed.
    """
    installed = entry_points(group=f"ucfrec.{group}")
    if name not in installed.names:
        known = ", ".join(sorted(installed.names)) or "none"
        raise InputError(f"no {group[:-1]} is called {name!r}; installed: {known}")
    return installed[name].module


_Import = tuple[int, str, tuple[str, ...]]
"""Number of leading dots, module, names imported from it."""


@cache
def _read(file: Path) -> tuple[str, tuple[_Import, ...]]:
    """SHA-256 and import statements of a source file."""
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
    """The absolute name of a module that a file of `package` imports with `level` leading dots."""
    if level == 0:
        return module
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - level + 1], *([module] if module else [])])


def _modules(base: str, names: tuple[str, ...]) -> list[tuple[str, Path]]:
    """The modules that `from base import names` loads.

    `base` itself counts only if some of `names` are not its submodules.
    """
    files = {name: _source(f"{base}.{name}") for name in names}
    modules = [(f"{base}.{name}", file) for name, file in files.items() if file]
    base_file = _source(base)
    if base_file and len(modules) < max(1, len(names)):
        modules.append((base, base_file))
    return modules


def _require(root: str | Path) -> Path:
    file = root if isinstance(root, Path) else _source(root)
    if file is None or not file.is_file():
        raise InputError(
            f"{root} has no Python source file to compute the code version from; install ucfrec "
            "with its sources"
        )
    return file


@cache
def _source(module: str) -> Path | None:
    """The source file of a module, located without importing it or its parent packages."""
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
