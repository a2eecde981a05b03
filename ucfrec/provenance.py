"""Where a result comes from: command, commit, versions, configuration, memory."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

_PACKAGES = ("ucfrec", "torch", "numpy", "gymnasium")


def versions(packages: Sequence[str] = ()) -> dict[str, str]:
    """Versions of what decides numbers, and of an adapter's own `packages`.

    Packages that are not installed are left out.
    """
    found = {"python": sys.version.split()[0]}
    for name in (*_PACKAGES, *packages):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def provenance(packages: Sequence[str] = ()) -> dict[str, Any]:
    """What every result row records of the process that made it; `packages` as in `versions`."""
    return {"command": command_line(), "commit": _commit(), "versions": versions(packages)}


def command_line() -> str:
    """The command of this process, with absolute paths cut to their last name.

    So no row says where on one machine something lies.
    """
    return " ".join([Path(sys.argv[0]).name, *map(without_folders, sys.argv[1:])])


def without_folders(argument: str) -> str:
    """An argument of a command, an absolute path in it (also after `=`) cut to its last name."""
    option, equals, value = "", "", argument
    if not _is_absolute(argument):
        option, equals, value = argument.rpartition("=")
    name = PureWindowsPath(value).name
    return f"{option}{equals}{name}" if name and _is_absolute(value) else argument


def _is_absolute(path: str) -> bool:
    """Whether it names one place on one machine, under whichever system."""
    rooted = PurePosixPath(path).is_absolute() or PureWindowsPath(path).is_absolute()
    return rooted or path.startswith("~")


def config_hash(config: Mapping[str, Any]) -> str:
    """A short name for a configuration: 12 hexadecimal digits of the SHA-256 of its JSON."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:12]


def reset_peak_memory() -> None:
    """Let `peak_memory_mib` start again from what is in use now; only Linux can."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_memory_mib() -> float:
    """Most resident memory of this process since `reset_peak_memory`, in MiB.

    Where that cannot be reset (not on Linux): since the process began.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def _commit() -> str | None:
    """Commit of the checkout that ucfrec is imported from; None for an installed wheel."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    answer = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return answer.stdout.strip() or None
