"""Arrays as callers give them, also lists and pandas Series, as the arrays to compute with.

Values count by their place: an index of pandas is ignored.
"""

from typing import Any

import numpy as np

from ucfrec.arrays import Array, BoolArray, Float64Array, IntArray
from ucfrec.errors import InputError


def numbers(name: str, values: Any, masked_is_missing: bool = False) -> Float64Array:
    """(N,) values as float64, without a copy where they are that; NaN where one is missing.

    Args:
        name: of the argument, for messages.
        masked_is_missing: whether masked values are taken as missing; refused if not.

    Raises:
        InputError: they have another shape, are no numbers, or some are masked.
    """
    given = array_of(name, values, masked_is_missing=masked_is_missing)
    try:
        if given.dtype.kind == "O":
            given = np.where(_missing(given), np.nan, given)
        if given.dtype.kind in "cmMV":
            raise TypeError  # A cast would take times as numbers, and cut complex ones.
        found = given.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise InputError(f"{name} has values of type {given.dtype}; give numbers") from None
    if np.ma.isMaskedArray(values):
        return np.where(np.ma.getmaskarray(values), np.nan, found)
    return found


def whole_numbers(name: str, values: Any) -> IntArray:
    """(N,) values as int64, without a copy where they are that.

    Raises:
        InputError: they have another shape, some are masked or not whole numbers.
    """
    given = array_of(name, values)
    if given.dtype.kind not in "iub":
        given = numbers(name, given)
        others = ~np.isfinite(given) | (np.floor(given) != given)
        if others.any():
            raise InputError(
                f"{name} is not a whole number at {others.sum():,} of {len(given):,} places; "
                "number from 0"
            )
    return given.astype(np.int64, copy=False)


def ids(name: str, values: Any) -> Array:
    """(N,) integer ids as they are; others (text, objects) numbered from 0.

    Raises:
        InputError: they have another shape, some are missing, or text and numbers are mixed.
    """
    given = array_of(name, values)
    if given.dtype.kind in "iub":
        return given
    if (lacking := _missing(given)).any():
        raise InputError(
            f"{name} is missing at {lacking.sum():,} of {len(given):,} places; give an id to each, "
            f"or leave {name} out"
        )
    try:
        return np.asarray(np.unique(given, return_inverse=True)[1])
    except TypeError:
        raise InputError(f"{name} mixes ids of several types; give all as text") from None


def array_of(name: str, values: Any, dimensions: int = 1, masked_is_missing: bool = False) -> Array:
    """Values as an array, without its mask.

    Raises:
        InputError: they have another number of dimensions, or some are masked.
    """
    try:
        given = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{name} is not an array ({error!s:.200}); give one") from None
    if given.ndim != dimensions:
        raise InputError(
            f"{name} has shape {given.shape}; give an array with {dimensions} "
            f"dimension{'s' * (dimensions > 1)}"
        )
    hidden = np.ma.getmaskarray(values).sum() if np.ma.isMaskedArray(values) else 0
    if hidden and not masked_is_missing:
        raise InputError(
            f"{name} is masked at {hidden:,} of {given.size:,} places; fill these in, or leave "
            "their sessions out"
        )
    return given


def _missing(values: Array) -> BoolArray:
    if values.dtype.kind == "O":
        return np.fromiter((_is_missing(each) for each in values), dtype=bool, count=len(values))
    return np.asarray(values != values)


def _is_missing(value: object) -> bool:
    try:
        return value is None or bool(value != value)
    except TypeError:  # pandas.NA is neither true nor false.
        return True
