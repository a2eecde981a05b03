"""Tables of settings: frozen dataclasses that validate their values when they are constructed.

The annotation of a field gives its type and range, the assignment its default, and the docstring
below it its meaning; error messages and `ucfrec settings` show all three.
"""

import difflib
import inspect
import math
import operator
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field, fields
from functools import partial, wraps
from numbers import Real
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
)

import numpy as np
from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic.dataclasses import is_pydantic_dataclass
from pydantic.fields import FieldInfo

from ucfrec.arrays import Array
from ucfrec.errors import InputError

Table = TypeVar("Table")
# Strict: `true` and "1" are not accepted as numbers; an int is accepted as a float.
_CONFIG = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

Count = Annotated[int, Field(ge=1, le=10**12)]
"""A number of updates, rows or episodes, at least 1."""
Width = Annotated[int, Field(ge=1, le=16_384)]
"""Units in a layer of a network."""
Weight = Annotated[float, Field(ge=0, le=1e6)]
"""Weight of a term of a loss; 0 disables the term."""
LearningRate = Annotated[float, Field(gt=0, le=10)]
WeightDecay = Annotated[float, Field(ge=0, le=1000)]
BatchSize = Annotated[int, Field(ge=1, le=1_000_000)]
Dropout = Annotated[float, Field(ge=0, lt=1)]
Share = Annotated[float, Field(ge=0, le=1)]
Quantile = Annotated[float, Field(ge=0, lt=1)]
"""A threshold below which steps are excluded; 1 is not allowed, it would exclude all."""


class SettingError(InputError):
    """A value, or a combination of values, that a table of settings rejects."""

    def __init__(self, message: str, *keys: str) -> None:
        """`message` names the value and the allowed ones, `keys` the fields, as `table.field`."""
        super().__init__(message)
        self.keys = keys


@dataclass_transform(frozen_default=True, field_specifiers=(Field, field))
def settings_table(name: str) -> Callable[[type[Table]], type[Table]]:
    """A decorator that makes a class a frozen dataclass with validated fields.

    Ranges are annotated for pydantic (`Annotated[int, Field(ge=1)]`); constraints between fields
    are checked in `__post_init__`, with `require`. Lists become tuples, as TOML and JSON have lists
    only. Constructing the class with an invalid value raises `SettingError`.

    `name` is the prefix of its fields in messages: `policy` in `policy.heads`; empty for none.
    """

    def decorate(cls: type[Table]) -> type[Table]:
        table: Any = pydantic_dataclass(frozen=True, config=_CONFIG)(cls)
        build, names = table.__init__, [f.name for f in fields(table)]

        @wraps(build)
        def check(self: Any, *args: Any, **values: Any) -> None:
            values |= dict(zip(names, args, strict=False))
            try:
                converted = {key: _convert_lists(value) for key, value in values.items()}
                build(self, *args[len(names) :], **converted)
            except ValidationError as error:
                raise _setting_error(table, name, error, values) from None

        table.__init__ = check
        return cast("type[Table]", table)

    return decorate


def require(holds: bool, message: str, *keys: str) -> None:
    """Raise a `SettingError` of `message` and `keys` if a constraint of fields does not hold."""
    if not holds:
        raise SettingError(message, *keys)


def allowed_values(table: Any, name: str) -> str:
    """Type and range, in words, of a field of a table."""
    info = table.__pydantic_fields__[name]
    return _allowed(info.annotation, info.metadata)


is_table = is_pydantic_dataclass
"""Whether a class itself is decorated by `settings_table`, not only a base class of it."""


def nearest(name: str, names: Sequence[str]) -> str:
    """The end of a message about an unknown `name`: the most similar of `names`, else all."""
    matches = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {matches[0]!r}?" if matches else f"there are {', '.join(names)}"


def _convert_lists(value: Any) -> Any:
    return tuple(map(_convert_lists, value)) if isinstance(value, list) else value


def _setting_error(
    table: Any,
    name: str,
    error: ValidationError,
    values: Mapping[str, Any],
) -> SettingError:
    """The first of pydantic's errors, as one line."""
    first, infos = error.errors(include_url=False)[0], table.__pydantic_fields__
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, SettingError):
        # Not the same one: it would hold `error`, which holds it, and Python finds no cycles there.
        return SettingError(str(cause), *cause.keys)
    field_name = str(first["loc"][0])
    key = f"{name}.{field_name}" if name else field_name
    if field_name not in infos:
        hint = nearest(field_name, list(infos))
        return SettingError(f"{name or table.__name__} has no field {field_name!r}; {hint}", key)
    allowed = allowed_values(table, field_name)
    value = repr(values[field_name]) if field_name in values else "missing"
    return SettingError(f"{key} is {value}; it must be {allowed}", key)


def _allowed(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """A type and its range, in words."""
    info = FieldInfo.from_annotation(annotation)
    annotation, metadata = info.annotation, [*info.metadata, *metadata]
    if get_origin(annotation) in (Union, UnionType):
        kinds = [_allowed(kind, metadata) for kind in get_args(annotation) if kind is not NoneType]
        return f"{' or '.join(kinds)}, or unset"
    if get_origin(annotation) is Literal:
        *choices, last = map(repr, get_args(annotation))
        return f"{', '.join(choices)} or {last}" if choices else last
    if get_origin(annotation) is tuple:
        inner = get_args(annotation)
        count = "one or more" if inner[-1] is Ellipsis else len(inner)
        return f"{count} values, each {_allowed(inner[0])}"
    kinds_by_type = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    return kinds_by_type.get(annotation, str(annotation)) + _range(metadata)


def _range(metadata: Sequence[Any]) -> str:
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    limits = {
        words[side]: _number(getattr(constraint, side))
        for constraint in metadata
        for side in words
        if hasattr(constraint, side)
    }
    if sorted(limits) == ["at least", "at most"]:
        return f" from {limits['at least']} to {limits['at most']}"
    parts = [f" {words} {limit}" for words, limit in limits.items()]
    return " and".join(parts)


def _number(value: float) -> str:
    written = f"{value:,.0f}" if value == round(value) else f"{value:g}"
    return written if len(written) < 10 else f"{value:g}".replace("e+0", "e").replace("e+", "e")


Check = Callable[[str, Any], Any]
"""Takes the name of an argument and its value, and returns the value to use in its place."""
LARGEST_SEED = 2**32 - 1
"""scikit-learn accepts no larger one."""
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
_Value = TypeVar("_Value")
_WRITTEN = (str, bytes, int, float, np.generic, list, tuple, set, dict, type(None))
"""Kinds of values that messages write out."""


def shown(value: object) -> str:
    """A value in a message, after "is": shortened, or of what type it is if that says more."""
    written = isinstance(value, _WRITTEN)
    return reprlib.repr(value) if written else f"a value of type {type(value).__name__}"


def require_whole(
    name: str,
    value: object,
    least: int = 1,
    most: int | None = None,
) -> int:
    """A whole number, also of NumPy, from `least` to `most`; InputError if `value` is none."""
    try:
        whole = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        whole = None
    if whole is None or whole < least or (most is not None and whole > most):
        limits = f", {least} or more" if most is None else f" from {least} to {most:,}"
        raise InputError(f"{name} is {shown(value)}; give a whole number{limits}")
    return whole


require_seed = partial(require_whole, least=0, most=LARGEST_SEED)
"""`require_whole` for seeds."""


def require_number(name: str, value: object) -> float:
    """The finite number that `value` is; an `InputError` if it is none."""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise InputError(f"{name} is {shown(value)}; give a finite number")
    return float(value)


def require_ids(name: str, value: object, of: str) -> Array:
    """The identifiers (N,) of a list, a series, an array, a set or an iterator, at least one.
    InputError if `value` is something else, is empty, or holds lists; `of` is e.g. "user_id"."""
    if not _is_list(value) or getattr(value, "ndim", 1) != 1:
        raise InputError(f"{name} is {shown(value)}; give a list of {of}s")
    ids = list(cast("Iterable[object]", value))
    if not ids or any(map(_is_list, ids)):
        raise InputError(f"{name} is empty or nested; give a list of {of}s, or None for all")
    return np.asarray(ids)


def _is_list(value: object) -> bool:
    return isinstance(value, Iterable) and not isinstance(value, (str, bytes))


def require_kind(what: str, *kinds: Any) -> Check:
    """A check that a value is of one of some types; `what` is the remedy, after "give"."""

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, kinds):
            raise InputError(f"{name} is {shown(value)}; give {what}")
        return value

    return check


def require_list(
    name: str,
    argument: object,
    what: str,
    *kinds: type[_Value],
) -> list[_Value]:
    """The values of an argument that is one of `kinds`, or any number of them. InputError if one
    has another type; `what` is one of them in words, e.g. "a Recommender"."""
    alone = isinstance(argument, kinds) or not _is_list(argument)
    values = [argument] if alone else list(cast("Iterable[object]", argument))
    for value in values:
        if not isinstance(value, kinds):
            raise InputError(f"{name} has {shown(value)}; give {what}")
    return cast("list[_Value]", values)


def check_arguments(
    checks: Mapping[str, Check],
) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """A decorator that checks arguments by their names; None is not, where it is the default."""

    def decorate(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        signature = inspect.signature(function)

        @wraps(function)
        def call(*args: _Parameters.args, **keywords: _Parameters.kwargs) -> _Result:
            bound = signature.bind(*args, **keywords)
            for name, value in bound.arguments.items():
                is_default = value is None and signature.parameters[name].default is None
                if name in checks and not is_default:
                    bound.arguments[name] = checks[name](name, value)
            return function(*bound.args, **bound.kwargs)

        return call

    return decorate
