"""Tables of options: the fields of a command's class are its options, their docstrings the help.

A class with a `title` is a group, which `--help` lists by name and `--help-all` describes. A field
without a docstring has that of the same field or argument of `described_by`, a settings table or a
method of the Python API, whose module is read but not imported: help answers at once.
"""

import argparse
import ast
import inspect
import re
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


class Group(str):
    """Marks a field of another group than that of its class, by the title; "" for none."""


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
    """`MODULE:TABLE`, or `MODULE:CLASS.METHOD`, that fields without a docstring are of."""
    prefix: ClassVar[str] = ""
    """What the names of these fields begin with, before those that they have there."""
    shows_defaults: ClassVar[bool] = True
    """Whether the help has the defaults that they have there."""
    usage: ClassVar[str | None] = None
    epilog: ClassVar[str | None] = None

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def execute(self) -> None:
        """Run the command.

        Raises:
            InputError: what the command line names cannot be used.
        """
        raise NotImplementedError

    @classmethod
    def read(cls, options: argparse.Namespace) -> Self:
        """The table with the values of a command line."""
        return cls(**{field.name: getattr(options, field.name) for field in fields(cls)})  # type: ignore[arg-type]


def settings_given(options: Table, table: type[Any], prefix: str = "") -> dict[str, Any]:
    """The fields of a settings table that the command line names."""
    values = {field.name: getattr(options, prefix + field.name, None) for field in fields(table)}
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if value is not None and value is not False
    }


def add_options(
    parser: argparse.ArgumentParser, table: type[Table], arguments: Sequence[str]
) -> None:
    """Add the options of a command to its parser, in groups, with the help that is asked for: all,
    or what fits one screen, with options of titled groups by name only, and of the others what
    comes before a semicolon."""
    shown = any(word.startswith(("-h", "--h")) for word in arguments)
    everything = any(word.startswith("--help-") for word in arguments)
    text = "show this help message and exit" if everything else argparse.SUPPRESS
    parser.add_argument("-h", "--help", action="help", help=text)
    parser.add_argument("--help-all", action="help", help="describe all options")
    groups: dict[Any, Any] = {"": parser}
    hidden: dict[str, list[str]] = {}
    usage, hints = ["%(prog)s"], get_type_hints(table, include_extras=True)
    for field in fields(table):  # type: ignore[arg-type]
        hint = hints[field.name]
        kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        owner = next(cls for cls in table.__mro__ if field.name in inspect.get_annotations(cls))
        titles = [mark for mark in marks if isinstance(mark, Group)]
        title, _, more = (titles or [Group(vars(owner).get("title") or "")])[0].partition("; ")
        if title not in groups:
            groups[title] = parser.add_argument_group(title, (everything and more) or None)
        group = groups[title]
        if EXCLUSIVE in marks:
            if owner not in groups:
                groups[owner] = group.add_mutually_exclusive_group()
            group = groups[owner]
        name = f"--{field.name.replace('_', '-')}"
        if ARGUMENT in marks:
            name, group = field.name, parser
        text = _describe(owner, field, marks).replace("%", "%%") if shown else ""
        if not everything:
            text = text.partition(";")[0]
            if title and group is not parser:
                hidden.setdefault(title, []).append(name)
                text = argparse.SUPPRESS
        action = group.add_argument(name, help=text, **_read_words(kind, marks, field.default))
        word = str(action.metavar or field.name.upper())
        if ARGUMENT in marks:
            word += "..." if action.nargs in ("+", "*") else ""
            usage.append(f"[{word}]" if action.nargs in ("?", "*") else word)
        elif action.required:
            usage.append(f"{name} {word}")
    if hidden:
        short = parser.add_argument_group("more, described by --help-all")
        short._group_actions += [
            argparse.Action([], title, help=", ".join(names)) for title, names in hidden.items()
        ]
    parser.usage, parser.epilog = table.usage or " ".join([*usage, "[options]"]), table.epilog


def _read_words(kind: Any, marks: Sequence[Any], default: Any) -> dict[str, Any]:
    """Arguments of `add_argument` for a field of some type."""
    if get_origin(kind) in (Union, UnionType):
        kind = get_args(kind)[0]  # the other one is None
    positional, required, origin = ARGUMENT in marks, default is MISSING, get_origin(kind)
    how: dict[str, Any] = {} if required else {"default": default}
    if kind is bool:
        return how | {"action": "store_true"}
    if origin is Literal:
        return how | {"choices": get_args(kind)}
    metavar = next((mark for mark in marks if type(mark) is str), None)
    if origin is tuple:
        return how | {"type": float, "nargs": 2, "metavar": tuple(str(metavar).split())}
    if several := origin is Sequence:
        kind = get_args(kind)[0]
        how = {} if required else {"default": [*default]}
    if positional:
        if several or not required:
            how["nargs"] = "?" if not several else "+" if required else "*"
    elif several:
        takes_several = metavar is not None and metavar.endswith("…")
        how |= {"action": "extend", "nargs": "+"} if takes_several else {"action": "append"}
    elif required:
        how["required"] = True
    if metavar is not None:
        how["metavar"] = metavar.removesuffix("…") if several else metavar
    if names := [mark.find() for mark in marks if isinstance(mark, Names) and mark.closed]:
        how["choices"] = names[0]
    for limits in (mark for mark in marks if isinstance(mark, range)):
        return how | {"type": partial(_read_number, limits)}
    return how | {"type": next((mark for mark in marks if callable(mark)), kind)}


def _read_number(limits: range, word: str) -> int:
    if not word.isdecimal() or len(word) > 19 or int(word) not in limits:
        most = f"to {limits.stop - 1}" if limits.stop < POSITIVE.stop else "on"
        raise argparse.ArgumentTypeError(f"{word} is not a whole number from {limits.start} {most}")
    return int(word)


def _describe(owner: type[Table], field: "Field[Any]", marks: Sequence[Any]) -> str:
    """The help of an option, with its default if that is a value."""
    text, _ = read_docstrings(owner.__module__)[f"{owner.__name__}.{field.name}"]
    default = field.default
    if not text:
        module, _, table = owner.described_by.partition(":")
        name = f"{table}.{field.name.removeprefix(owner.prefix)}"
        text, borrowed = read_docstrings(module)[name]
        text = text[:1].upper() + text[1:]
        if vars(owner).get("shows_defaults", True):
            text = re.sub(r"[;,] None for ([^.]*)", r" (default: \1)", text)
            default = default or borrowed
    text = text.rstrip(".")
    for names in (mark for mark in marks if isinstance(mark, Names)):
        text += f": {', '.join(names.find())}"
    unknown = default in (MISSING, None, (), "") or default is False
    return text if unknown or "(default: " in text else f"{text} (default: {default})"


@cache
def read_docstrings(module: str) -> Mapping[str, tuple[str, str]]:
    """`CLASS.FIELD` and `CLASS.METHOD.ARGUMENT` of a module to what its source says of them, on one
    line, and to the default of a field."""
    spec, texts = find_spec(module), {}
    source = Path(str(spec and spec.origin)).read_text(encoding="utf-8")
    for cls in ast.parse(source).body:
        if not isinstance(cls, ast.ClassDef):
            continue
        for line, next_line in zip_longest(cls.body, cls.body[1:]):
            if isinstance(line, ast.AnnAssign):
                text = ast.literal_eval(next_line.value) if isinstance(next_line, ast.Expr) else ""
                default = "" if line.value is None else ast.unparse(line.value)
                default = "" if default in ("None", "False") else default.strip("'")
                texts[f"{cls.name}.{ast.unparse(line.target)}"] = " ".join(text.split()), default
            elif isinstance(line, ast.FunctionDef):
                arguments = (ast.get_docstring(line) or "").partition("Args:\n")[2]
                for name, text in re.findall(r"^    (\w+): (.+(?:\n     .+)*)", arguments, re.M):
                    texts[f"{cls.name}.{line.name}.{name}"] = " ".join(text.split()), ""
    return texts
