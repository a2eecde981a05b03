"""Tables of settings: frozen dataclasses whose values are checked when they are built.

A field states its type and range in its annotation, its default behind it, and its meaning in the
text below it; errors and `ucfrec settings` read all three from there.
"""

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import wraps
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
)

import pydantic
from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from ucfrec.errors import InputError

Table = TypeVar("Table")
_CHECKED: Final = ConfigDict(
    # `true` is no number, and text is none either; a whole number may stand for any number.
    strict=True,
    extra="forbid",
    allow_inf_nan=False,
    use_attribute_docstrings=True,
)

Count = Annotated[int, Field(ge=1, le=10**12)]
"""Of updates, rows or episodes; there is at least one."""
Width = Annotated[int, Field(ge=1, le=16_384)]
"""Of a network's layer."""
Weight = Annotated[float, Field(ge=0, le=1e6)]
"""Of a term of a loss; 0 leaves it out."""
LearningRate = Annotated[float, Field(gt=0, le=10)]
WeightDecay = Annotated[float, Field(ge=0, le=1000)]
BatchSize = Annotated[int, Field(ge=1, le=1_000_000)]
Dropout = Annotated[float, Field(ge=0, lt=1)]
Share = Annotated[float, Field(ge=0, le=1)]
Quantile = Annotated[float, Field(ge=0, lt=1)]
"""Below it something is left out; at 1 all would be."""


class SettingError(InputError):
    """A value that a table of settings does not take."""

    def __init__(self, message: str, *keys: str) -> None:
        """Args:
        message: names field, value and what is allowed.
        keys: the fields concerned, as `table.field`.
        """
        super().__init__(message)
        self.keys = keys


@dataclass(frozen=True)
class Setting:
    """One field of a table, for a reader."""

    key: str
    """`table.field`, as `--set` takes it."""
    value: Any
    allowed: str
    """Type and range, in words."""
    meaning: str


@dataclass_transform(frozen_default=True, field_specifiers=(Field, field))
def settings_table(name: str) -> Callable[[type[Table]], type[Table]]:
    """Make a class a frozen dataclass that checks its values when built.

    Fields are annotated as pydantic reads them (`Annotated[int, Field(ge=1)]`); what must hold
    between fields is checked in `__post_init__`, by `require`. `dataclasses.fields`, `asdict` and
    `replace` work as on any dataclass.

    Args:
        name: of the table, which errors put before the field's: `policy` of `policy.heads`; empty
            for fields that are of no table.

    Raises:
        SettingError: of the class that is made, when built with a value that it does not take.
    """

    def decorate(cls: type[Table]) -> type[Table]:
        table: Any = checked_dataclass(frozen=True, config=_CHECKED)(cls)
        build = table.__init__

        @wraps(build)
        def checked(self: Any, *args: Any, **values: Any) -> None:
            try:
                build(self, *args, **values)
            except ValidationError as error:
                names = [f.name for f in fields(table)]
                given = dict(zip(names, args, strict=False)) | values
                raise _refusal(table, name, error, given) from None

        table.__init__ = checked
        made: type[Table] = table
        return made

    return decorate


def require(holds: bool, message: str, *keys: str) -> None:
    """Refuse a combination of values, in a table's `__post_init__`.

    Args:
        message: names fields, values and what is allowed.
        keys: the fields concerned, as `table.field`.

    Raises:
        SettingError: unless `holds`.
    """
    if not holds:
        raise SettingError(message, *keys)


def describe(name: str, table: Any) -> Iterator[Setting]:
    """Every field of `table`, an instance of a class that `settings_table` made."""
    for key, info in _fields(type(table)).items():
        meaning = next(
            (
                own[key].description
                for base in type(table).__mro__
                if key in (own := _fields(base)) and own[key].description
            ),
            "",
        )
        allowed = _allowed(info.annotation, info.metadata)
        yield Setting(f"{name}.{key}", getattr(table, key), allowed, " ".join(meaning.split()))


def is_table(cls: type) -> bool:
    """Whether `settings_table` made the class itself, not only one that it derives from."""
    return bool(_fields(cls))


def nearest(name: str, known: Sequence[str]) -> str:
    """The known name that was probably meant, or all of them."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"


def _fields(table: type) -> Mapping[str, Any]:
    """Pydantic's account of each field; empty for any other class."""
    if not pydantic.dataclasses.is_pydantic_dataclass(table):
        return {}
    found: Mapping[str, Any] = table.__dict__["__pydantic_fields__"]
    return found


def _refusal(
    table: Any, name: str, error: ValidationError, given: Mapping[str, Any]
) -> SettingError:
    """The first thing that is wrong, in a line."""
    first = error.errors(include_url=False)[0]
    known = list(_fields(table))
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, SettingError):
        return cause
    at = first["loc"][0]
    key = known[at] if isinstance(at, int) and at < len(known) else str(at)
    if key not in known:
        message = f"{name} has no field {key!r}; {nearest(key, known)}"
        return SettingError(message, _key(name, key))
    info = _fields(table)[key]
    allowed = _allowed(info.annotation, info.metadata)
    value = _shortened(repr(given[key])) if key in given else "missing"
    key = _key(name, key)
    return SettingError(f"{key} is {value}; it must be {allowed}", key)


def _shortened(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:57]}…"


def _allowed(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """A type and its range, in words."""
    if get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        return _allowed(annotation, [*_constraints(more), *metadata])
    if get_origin(annotation) in (Union, UnionType):
        kinds = [_allowed(kind, metadata) for kind in get_args(annotation) if kind is not NoneType]
        return f"{' or '.join(kinds)}, or unset"
    if get_origin(annotation) is Literal:
        *others, last = map(repr, get_args(annotation))
        return f"{', '.join(others)} or {last}" if others else last
    if get_origin(annotation) is tuple:
        inner = get_args(annotation)
        return f"{len(inner)} values, each {_allowed(inner[0])}"
    kinds_by_type = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    return kinds_by_type.get(annotation, str(annotation)) + _range(metadata)


def _constraints(metadata: Sequence[Any]) -> list[Any]:
    return [c for m in metadata for c in (m.metadata if hasattr(m, "metadata") else [m])]


def _range(metadata: Sequence[Any]) -> str:
    limits = {
        side: getattr(constraint, side)
        for constraint in metadata
        for side in ("ge", "gt", "le", "lt")
        if hasattr(constraint, side)
    }
    if {"ge", "le"} == limits.keys():
        return f" from {_number(limits['ge'])} to {_number(limits['le'])}"
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    parts = [f"{words[side]} {_number(limit)}" for side, limit in limits.items()]
    return f" {' and '.join(parts)}" if parts else ""


def _number(value: float) -> str:
    written = f"{value:,.0f}" if value == round(value) else f"{value:g}"
    return written if len(written) < 10 else f"{value:g}".replace("e+0", "e").replace("e+", "e")


def _key(table: str, name: str) -> str:
    return f"{table}.{name}" if table else name
