"""`ucfrec settings`: list every training setting with its default, range and meaning."""

import inspect
import shutil
import textwrap
from typing import Annotated, Any, Final

from ucfrec.commands.options import Names, Table
from ucfrec.policies.registry import policy_names

_NARROWEST: Final = 40
"""Terminal columns that the meaning needs; with fewer it goes on a line of its own below."""
_WIDEST: Final = 160
"""Most terminal columns of a line."""


class Settings(Table):
    """`ucfrec settings`."""

    policy: Annotated[str, "NAME", Names(policy_names)] = "ucf"
    """Policy whose settings to list."""

    def execute(self) -> None:
        """Print them."""
        print(settings_text(self.policy, shutil.get_terminal_size().columns))


def settings_text(policy: str, width: int) -> str:
    """Every setting of a training of `policy`, one section per table."""
    from ucfrec.runs.config import TABLES, resolve_config
    from ucfrec.settings import describe

    config, width = resolve_config(policy), min(width, _WIDEST)
    rows = {
        name: [
            ((each.key, _format_toml(each.value), each.allowed), each.meaning)
            for each in describe(name, getattr(config, name))
        ]
        for name in TABLES
    }
    columns = zip(*(cells for table in rows.values() for cells, _ in table), strict=True)
    widths = [max(map(len, column)) for column in columns]
    text = textwrap.wrap(
        f"Settings of `ucfrec train --policy {policy}`: --set KEY=VALUE, or a TOML file "
        "(--config FILE) with a table for each section.",
        width,
    )
    for name, table in rows.items():
        summary = inspect.cleandoc(type(getattr(config, name)).__doc__ or "").partition("\n\n")[0]
        text += ["", *textwrap.wrap(f"[{name}]  {summary}", width)]
        for cells, meaning in table:
            padded = (cell.ljust(size) for cell, size in zip(cells, widths, strict=True))
            start = "  " + "  ".join(padded)
            indent = len(start) + 2
            if width - indent < _NARROWEST:
                text.append(start.rstrip())
                start, indent = "", 6
            first, *others = textwrap.wrap(meaning, width - indent) or [""]
            text.append(f"{start}  {first}" if start else " " * indent + first)
            text += [" " * indent + line for line in others]
    return "\n".join(text)


def _format_toml(value: Any) -> str:
    """A value as `--set` takes it; "unset" for None."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_format_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return "unset" if value is None else str(value)
