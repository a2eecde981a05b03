"""Result rows: where they came from, and how they are shown."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("ucfrec", "torch", "numpy", "gymnasium")
_SHOWN = ("world", "policy", "R_cum", "R_avg_pooled", "R_avg_episode", "length", "episodes", "seed")


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
    """The command of this process, without the folder that it is installed in."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


def config_hash(config: Mapping[str, Any]) -> str:
    """A short name for a configuration."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:12]


def _commit() -> str | None:
    """Commit of the checkout that ucfrec is imported from; None for an installed wheel."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    asked = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return asked.stdout.strip() or None


def format_rows(rows: Sequence[Mapping[str, Any]], shown: Sequence[str] = _SHOWN) -> str:
    """The columns `shown` of result rows as an aligned table, R_cum with its interval."""
    body = [[_cell(row, name) for name in shown] for row in rows]
    table = [list(shown), *body]
    widths = [max(len(line[i]) for line in table) for i in range(len(shown))]
    lines = []
    for line in table:
        cells = [line[i].ljust(w) if i < 2 else line[i].rjust(w) for i, w in enumerate(widths)]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def _cell(row: Mapping[str, Any], name: str) -> str:
    value = row[name]
    if name == "R_cum":
        return f"{_number(value)} [{_number(row['R_cum_low'])}, {_number(row['R_cum_high'])}]"
    return _number(value) if isinstance(value, float) else str(value)


def _number(value: float | None) -> str:
    """Three decimals, or, of click rates and the like, three digits; a dash for nothing."""
    if value is None:
        return "–"
    return f"{value:.3f}" if value == 0 or abs(value) >= 0.1 else f"{value:#.3g}"
