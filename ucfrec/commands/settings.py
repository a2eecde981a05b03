"""`ucfrec settings`: list every training setting with its default, range and meaning."""

import argparse
import inspect
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

from ucfrec.commands.options import option
from ucfrec.policies.registry import policy_names

if TYPE_CHECKING:
    from ucfrec.settings import Setting

_NARROWEST: Final = 40
"""Terminal columns that the meaning needs; with fewer it goes on a line of its own below."""
_BENEATH: Final = " " * 6
_WIDEST: Final = 160
"""Most terminal columns of a line."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec settings`."""
    text = f"policy whose settings to list: {', '.join(policy_names())}"
    option(parser, "--policy", str, f"{text} (default: ucf)", "NAME", default="ucf")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec settings`."""
    print(settings_text(options.policy, shutil.get_terminal_size().columns))


def settings_text(policy: str, width: int) -> str:
    """Every setting of a training of `policy`, one section per table.

    Raises:
        InputError: no policy has this name.
    """
    from ucfrec.runs.config import TABLES, resolve_config
    from ucfrec.settings import describe

    config, width = resolve_config(policy), min(width, _WIDEST)
    tables = {name: list(describe(name, getattr(config, name))) for name in TABLES}
    cells = [_cells(setting) for settings in tables.values() for setting in settings]
    widths = [max(len(row[i]) for row in cells) for i in range(3)]
    text = textwrap.wrap(
        f"Settings of `ucfrec train --policy {policy}`: --set KEY=VALUE, or a TOML file "
        "(--config FILE) with a table for each section.",
        width,
    )
    for name, settings in tables.items():
        text += ["", *textwrap.wrap(f"[{name}]  {_summary(getattr(config, name))}", width)]
        for setting in settings:
            text += _lines(_cells(setting), widths, width)
    return "\n".join(text)


def _summary(table: Any) -> str:
    """First paragraph of the docstring of the table's class."""
    return inspect.cleandoc(type(table).__doc__ or "").partition("\n\n")[0]


def _cells(setting: "Setting") -> tuple[str, str, str, str]:
    return setting.key, _as_toml(setting.value), setting.allowed, setting.meaning


def _as_toml(value: Any) -> str:
    """A value as `--set` takes it; "unset" for None."""
    if value is None:
        return "unset"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_as_toml, value))}]"
    return str(value)


def _lines(cells: Sequence[str], widths: Sequence[int], width: int) -> Iterator[str]:
    *columns, meaning = cells
    start = "  " + "  ".join(cell.ljust(size) for cell, size in zip(columns, widths, strict=True))
    beside = len(start) + 2
    if width - beside < _NARROWEST:
        yield start.rstrip()
        yield from (_BENEATH + line for line in textwrap.wrap(meaning, width - len(_BENEATH)))
        return
    first, *rest = textwrap.wrap(meaning, width - beside) or [""]
    yield f"{start}  {first}"
    yield from (" " * beside + line for line in rest)
