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
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from ucfrec.files.remote import Input, Output, uri_or_path

ARGUMENT = object()
"""Marks a field as positional."""
INPUT = uri_or_path(Input, str)
INPUT_FOLDER = uri_or_path(Input, Path)
OUTPUT = uri_or_path(Output, Path)


def read_number(limits: range, word: str) -> int:
    """A whole number within limits, or argparse's error."""
    if not word.isdecimal() or len(word) > 19 or int(word) not in limits:
        most = f"to {limits.stop - 1}" if limits.stop < 2**63 else "on"
        raise argparse.ArgumentTypeError(f"{word} is not a whole number from {limits.start} {most}")
    return int(word)


POSITIVE = partial(read_number, range(1, 2**63))
SEED = partial(read_number, range(2**32))


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

    The type may be `Annotated` with what the help calls the value (N of whole numbers, PATH of
    paths, else the last word of the name), a function that reads a word, and marks of this module.
    An option of a sequence is repeatable.
    """

    title: ClassVar[str | None] = None
    """Title of the group of the options and, after a semicolon, more of its description."""
    described_by: ClassVar[str] = ""
    """`MODULE:TABLE`, or `MODULE:CLASS.METHOD`, that fields without a docstring come from."""
    prefix: ClassVar[str] = ""
    """What the names of these fields begin with, before those that they have there."""
    shows_defaults: ClassVar[bool] = True
    """Whether the help has the defaults that they have there."""
    usage: ClassVar[str | None] = None
    epilog: ClassVar[str | None] = None

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def execute(self) -> None:
        """Run the command. InputError if what the command line names cannot be used."""
        raise NotImplementedError


def settings_given(options: Table, table: type[Any], prefix: str = "") -> dict[str, Any]:
    """The fields of a settings table that the command line names."""
    values = {field.name: getattr(options, prefix + field.name, None) for field in fields(table)}
    return {name: value for name, value in values.items() if not (value is None or value is False)}


def add_options(
    parser: argparse.ArgumentParser, table: type[Table], arguments: Sequence[str]
) -> None:
    """Add the options of a command to its parser, in groups, with the help that is asked for: all,
    or what fits one screen, with options of titled groups by name only, and of the others what
    comes before a semicolon."""
    asks_help = any(word.startswith(("-h", "--h")) for word in arguments)
    everything = any(word.startswith("--help-") for word in arguments)
    text = "show this help message and exit" if everything else argparse.SUPPRESS
    parser.add_argument("-h", "--help", action="help", help=text)
    parser.add_argument("--help-all", action="help", help="describe all options")
    groups: dict[str, Any] = {"": parser}
    hidden: dict[str, list[str]] = {}
    usage, hints = ["%(prog)s"], get_type_hints(table, include_extras=True)
    for field in fields(table):  # type: ignore[arg-type]
        hint = hints[field.name]
        kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        owner = next(cls for cls in table.__mro__ if field.name in inspect.get_annotations(cls))
        of_class = vars(owner).get("title") or ""
        title = next((mark for mark in marks if isinstance(mark, Group)), of_class)
        title, _, more = title.partition("; ")
        if title not in groups:
            groups[title] = parser.add_argument_group(title, (everything and more) or None)
        group = groups[title]
        name = f"--{field.name.replace('_', '-')}"
        if ARGUMENT in marks:
            name, group = field.name, parser
        text = _describe(owner, field, marks).replace("%", "%%") if asks_help else ""
        if not everything:
            text = text.partition(";")[0]
            if title and group is not parser:
                hidden.setdefault(title, []).append(name)
                text = argparse.SUPPRESS
        action = group.add_argument(name, help=text, **_read_words(field, kind, marks))
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
    parser.usage = table.usage or " ".join([*usage, "[options]"])
    parser.epilog = table.epilog


def _read_words(option: "Field[Any]", kind: Any, marks: Sequence[Any]) -> dict[str, Any]:
    """Arguments of `add_argument` for a field of some type."""
    if get_origin(kind) in (Union, UnionType):
        kind = get_args(kind)[0]  # the other one is None
    positional, default, origin = ARGUMENT in marks, option.default, get_origin(kind)
    required = default is MISSING
    how: dict[str, Any] = {} if required else {"default": default}
    if kind is bool:
        return how | {"action": "store_true"}
    if origin is Literal:
        return how | {"choices": get_args(kind)}
    last = option.name.rpartition("_")[2].upper()
    name = last if positional else {int: "N", Path: "PATH"}.get(kind, last)
    name = how["metavar"] = next((mark for mark in marks if type(mark) is str), name)
    if origin is tuple:
        return how | {"type": float, "nargs": 2, "metavar": tuple(name.split())}
    if several := origin is Sequence:
        kind = get_args(kind)[0]
        how["default"] = [] if default is MISSING else [*default]
    if positional and (several or not required):
        how["nargs"] = "?" if not several else "+" if required else "*"
    elif several:
        how["action"] = "append"
    elif required and not positional:
        how["required"] = True
    if names := [mark.find() for mark in marks if isinstance(mark, Names) and mark.closed]:
        how["choices"] = names[0]
    return how | {"type": next((mark for mark in marks if callable(mark)), kind)}


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
        for number, line in enumerate(cls.body, 1):
            if isinstance(line, ast.AnnAssign):
                text = ast.get_docstring(ast.Module(cls.body[number:], [])) or ""
                default = "" if line.value is None else ast.unparse(line.value)
                default = "" if default in ("None", "False") else default.strip("'")
                texts[f"{cls.name}.{ast.unparse(line.target)}"] = " ".join(text.split()), default
            elif isinstance(line, ast.FunctionDef):
                arguments = (ast.get_docstring(line) or "").partition("Args:\n")[2]
                for name, text in re.findall(r"^    (\w+): (.+(?:\n     .+)*)", arguments, re.M):
                    texts[f"{cls.name}.{line.name}.{name}"] = " ".join(text.split()), ""
    return texts
