"""Provenance of a result: command, commit, package versions, hash of the settings, peak memory."""

import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("ucfrec", "torch", "numpy", "gymnasium")
_FOLDERS = re.compile(r"(?:^|(?<==))(?=[/~\\]|\w:[/\\]).*[/\\](?=[^/\\])")
"""Those of a path that is absolute on POSIX or Windows, or relative to a home folder."""


def versions(packages: Sequence[str] = ()) -> dict[str, str]:
    """Installed versions of Python, of what results depend on, and of more `packages`."""
    installed = {"python": sys.version.split()[0]}
    for name in (*_PACKAGES, *packages):
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def provenance(packages: Sequence[str] = ()) -> dict[str, Any]:
    """Command, commit (None for an installed wheel) and `versions`, as result rows record them."""
    root, commit = Path(__file__).resolve().parent.parent, None
    if (root / ".git").exists():
        command = ["git", "-C", str(root), "rev-parse", "HEAD"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        commit = result.stdout.strip() or None
    return {"command": command_line(), "commit": commit, "versions": versions(packages)}


def command_line() -> str:
    """The command of this process, without the folders of the machine: result rows are public."""
    program, *words = sys.argv
    return " ".join([Path(program).name, *map(shorten_paths, words)])


def shorten_paths(argument: str) -> str:
    """Shorten an absolute path in a command's argument (also after `=`) to its last component."""
    return _FOLDERS.sub("", argument)


def config_hash(config: Mapping[str, Any]) -> str:
    """The first 12 hexadecimal digits of the SHA-256 of a configuration as JSON, keys sorted."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:12]


def reset_peak_memory() -> None:
    """Make `peak_memory_mib` measure from now on; has no effect on systems other than Linux."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mib() -> float:
    """Peak resident MiB since `reset_peak_memory`; on other systems than Linux, since the start."""
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
