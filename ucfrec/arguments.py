"""Checks of the arguments of the Python API: each kind of value is checked in one place."""

import inspect
import math
import operator
import reprlib
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from numbers import Real
from typing import Any, Final, ParamSpec, TypeVar, cast

import numpy as np

from ucfrec.arrays import Array
from ucfrec.errors import InputError

Check = Callable[[str, Any], Any]
"""Takes the name of an argument and its value, and returns the value to use in its place."""
LARGEST_SEED: Final = 2**32 - 1
"""scikit-learn accepts no larger one."""
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
_Value = TypeVar("_Value")
_WRITTEN: Final = (str, bytes, int, float, np.generic, list, tuple, set, dict, type(None))
"""Kinds of values that messages write out."""


def shown(value: object) -> str:
    """A value in a message, after "is": shortened, or of what type it is if that says more."""
    written = isinstance(value, _WRITTEN)
    return reprlib.repr(value) if written else f"a value of type {type(value).__name__}"


def require_whole(name: str, value: object, least: int = 1, most: int | None = None) -> int:
    """The whole number that `value` is; NumPy's count too.

    Raises:
        InputError: it is not a whole number, below `least` or above `most`.
    """
    try:
        whole = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        whole = None
    if whole is None or whole < least or (most is not None and whole > most):
        limits = f", {least} or more" if most is None else f" from {least} to {most:,}"
        raise InputError(f"{name} is {shown(value)}; give a whole number{limits}")
    return whole


def require_seed(name: str, value: object) -> int:
    """The seed that `value` is: a whole number from 0 to `LARGEST_SEED`.

    Raises:
        InputError: it is something else.
    """
    return require_whole(name, value, 0, LARGEST_SEED)


def require_number(name: str, value: object) -> float:
    """The number that `value` is.

    Raises:
        InputError: it is not a number, or not finite.
    """
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise InputError(f"{name} is {shown(value)}; give a finite number")
    return float(value)


def require_ids(name: str, value: object, of: str) -> Array:
    """The identifiers (N,) of a list, a series, an array, a set or an iterator, at least one.

    Args:
        of: what they are, e.g. "user_id".

    Raises:
        InputError: `value` is something else, is empty, or holds lists.
    """
    if not _is_list(value) or getattr(value, "ndim", 1) != 1:
        raise InputError(f"{name} is {shown(value)}; give a list of {of}s")
    ids = list(cast("Iterable[object]", value))
    if not ids or any(map(_is_list, ids)):
        raise InputError(f"{name} is empty or nested; give a list of {of}s, or None for all")
    return np.asarray(ids)


def _is_list(value: object) -> bool:
    return isinstance(value, Iterable) and not isinstance(value, (str, bytes))


def require_kind(what: str, *kinds: Any) -> Check:
    """A check that a value is of one of some types.

    Args:
        what: the remedy, after "give".
    """

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, kinds):
            raise InputError(f"{name} is {shown(value)}; give {what}")
        return value

    return check


def require_list(name: str, argument: object, what: str, *kinds: type[_Value]) -> list[_Value]:
    """The values of an argument that is one of them, or any number.

    Args:
        what: one of them in words, e.g. "a Recommender".
        kinds: types that they may have.

    Raises:
        InputError: one has another type.
    """
    alone = isinstance(argument, kinds) or not _is_list(argument)
    values = [argument] if alone else list(cast("Iterable[object]", argument))
    for value in values:
        if not isinstance(value, kinds):
            raise InputError(f"{name} has {shown(value)}; give {what}")
    return cast("list[_Value]", values)


def check_arguments(
    checks: Mapping[str, Check],
) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """A decorator that checks arguments by their names, before anything else happens.

    None is not checked where it is the default.

    Args:
        checks: name of an argument to its check.
    """

    def decorate(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        signature = inspect.signature(function)

        @wraps(function)
        def call(*args: _Parameters.args, **keywords: _Parameters.kwargs) -> _Result:
            try:
                bound = signature.bind(*args, **keywords)
            except TypeError:
                return function(*args, **keywords)  # raises the same with the function's name
            for name, value in bound.arguments.items():
                if name in checks and not (
                    value is None and signature.parameters[name].default is None
                ):
                    bound.arguments[name] = checks[name](name, value)
            return function(*bound.args, **bound.kwargs)

        return call

    return decorate
