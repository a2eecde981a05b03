"""Tables of options: the fields of a command's class are its options, their docstrings the help.

A class with a `title` is a group, which `--help` lists by name and `--help-all` describes. A field
without a docstring has that of the field of `described_by`, a settings table, whose module is read
but not imported: help answers at once.
"""

import argparse
import ast
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from functools import cache, partial
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Final,
    Literal,
    Self,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from ucfrec.files.remote import Input, Output, uri_or_path

ARGUMENT: Final = object()
"""Marks a field as positional."""
EXCLUSIVE: Final = object()
"""Marks fields of a class of which a command line may have one."""
POSITIVE: Final = range(1, 2**63)
SEED: Final = range(2**32)
INPUT: Final = uri_or_path(Input, str)
INPUT_FOLDER: Final = uri_or_path(Input, Path)
OUTPUT: Final = uri_or_path(Output, Path)


@dataclass(frozen=True)
class Names:
    """Marks a field that takes names, which its help lists; others too, but where it is closed."""

    find: Callable[[], Sequence[str]]
    closed: bool = False


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Table:
    """Options that a subclass declares as fields, with a default if they need not be given.

    The type may be `Annotated` with what the help calls the value (one that ends in "…" takes
    several words), a function that reads a word, the range of a number, and marks of this module.
    """

    title: ClassVar[str | None] = None
    """Title of the group of the options and, after a semicolon, more of its description."""
    described_by: ClassVar[str] = ""
    """`MODULE:TABLE` of the settings that fields without a docstring stand for."""
    prefix: ClassVar[str] = ""
    """What the names of these fields begin with, before those of the settings."""
    shows_defaults: ClassVar[bool] = True
    """Whether the help has the defaults of these settings."""
    usage: ClassVar[str | None] = None
    epilog: ClassVar[str | None] = None

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def execute(self) -> None:
        """Run the command."""
        raise NotImplementedError

    @classmethod
    def read(cls, options: argparse.Namespace) -> Self:
        """The table with the values of a command line."""
        return cls(**{each.name: getattr(options, each.name) for each in fields(cls)})  # type: ignore[arg-type]


def settings_given(options: Table, table: type[Any], prefix: str = "") -> dict[str, Any]:
    """The fields of a settings table that the command line names."""
    values = {each.name: getattr(options, prefix + each.name, None) for each in fields(table)}
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if value is not None and value is not False
    }


def add_options(parser: argparse.ArgumentParser, table: type[Table]) -> None:
    """Add the options of a command to its parser, with help and groups."""
    groups: dict[Any, Any] = {"": parser}
    for field, kind, marks in _list_fields(table):
        owner = next(cls for cls in table.__mro__ if field.name in inspect.get_annotations(cls))
        title, _, more = (vars(owner).get("title") or "").partition("; ")
        if title not in groups:
            groups[title] = parser.add_argument_group(title, more or None)
        group = groups[title]
        if EXCLUSIVE in marks:
            if owner not in groups:
                groups[owner] = group.add_mutually_exclusive_group()
            group = groups[owner]
        name = field.name if ARGUMENT in marks else _name_option(field.name)
        text = _describe(owner, field, marks).replace("%", "%%")
        group.add_argument(name, help=text, **_read_words(kind, marks, field.default))
    parser.usage, parser.epilog = table.usage, table.epilog


def _list_fields(table: type[Any]) -> list[tuple["Field[Any]", Any, Sequence[Any]]]:
    """The fields, their types without `None`, and their marks."""
    hints = get_type_hints(table, include_extras=True)
    listed: list[tuple[Field[Any], Any, Sequence[Any]]] = []
    for field in fields(table):
        hint = hints[field.name]
        kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if get_origin(kind) in (Union, UnionType):
            kind = get_args(kind)[0]
        listed.append((field, kind, marks))
    return listed


def _name_option(field: str) -> str:
    return f"--{field.replace('_', '-')}"


def _read_words(kind: Any, marks: Sequence[Any], default: Any) -> dict[str, Any]:
    """Arguments of `add_argument` for a field of some type."""
    positional, required, origin = ARGUMENT in marks, default is MISSING, get_origin(kind)
    how: dict[str, Any] = {} if required else {"default": default}
    if kind is bool:
        return how | {"action": "store_true"}
    if origin is Literal:
        return how | {"choices": get_args(kind)}
    metavar = next((mark for mark in marks if isinstance(mark, str)), None)
    if origin is tuple:
        return how | {"type": float, "nargs": 2, "metavar": tuple(str(metavar).split())}
    if several := origin is Sequence:
        kind = get_args(kind)[0]
        how = {} if required else {"default": [*default]}
    if positional:
        if several or not required:
            how["nargs"] = "?" if not several else "+" if required else "*"
    elif several:
        many = metavar is not None and metavar.endswith("…")
        how |= {"action": "extend", "nargs": "+"} if many else {"action": "append"}
    elif required:
        how["required"] = True
    if metavar is not None:
        how["metavar"] = metavar.removesuffix("…")
    if names := [mark.find() for mark in marks if isinstance(mark, Names) and mark.closed]:
        how["choices"] = names[0]
    for limits in (mark for mark in marks if isinstance(mark, range)):
        return how | {"type": partial(_read_number, limits)}
    return how | {"type": next((mark for mark in marks if callable(mark)), kind)}


def _read_number(limits: range, word: str) -> int:
    if not word.isdecimal() or len(word) > 19 or int(word) not in limits:
        most = f"to {limits.stop - 1}" if limits.stop < POSITIVE.stop else "on"
        raise argparse.ArgumentTypeError(
            f"{word:.40} is not a whole number from {limits.start} {most}"
        )
    return int(word)


def _describe(owner: type[Table], field: "Field[Any]", marks: Sequence[Any]) -> str:
    """The help of an option, with its default if that is a value."""
    text = _read_docstrings(owner.__module__)[owner.__name__, field.name][0]
    default = None if field.default is MISSING or field.default == () else field.default
    if not text:
        module, _, table = owner.described_by.partition(":")
        name = field.name.removeprefix(owner.prefix)
        text, value = _read_docstrings(module)[table, name]
        default = value if owner.shows_defaults else None
    text = text.rstrip(".")
    for names in (mark for mark in marks if isinstance(mark, Names)):
        text += f": {', '.join(names.find())}"
    shown = default is not None and default is not False and default != ""
    return f"{text} (default: {default})" if shown else text


@cache
def _read_docstrings(module: str) -> Mapping[tuple[str, str], tuple[str, str]]:
    """Class and field to its docstring, on one line, and its default, as the module writes them."""
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    found = {}
    for cls in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        lines = cls.body if isinstance(cls, ast.ClassDef) else []
        for line, after in zip_longest(lines, lines[1:]):
            if isinstance(line, ast.AnnAssign):
                text = ast.literal_eval(after.value) if isinstance(after, ast.Expr) else ""
                default = "" if line.value is None else ast.unparse(line.value)
                key = cls.name, ast.unparse(line.target)  # type: ignore[attr-defined]
                found[key] = " ".join(text.split()), "" if default in ("None", "False") else default
    return found
