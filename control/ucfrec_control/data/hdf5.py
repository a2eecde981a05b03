"""Open untrusted HDF5 files: nothing outside the file, nothing larger than it can hold."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from ucfrec.arrays import Array, Float32Array
from ucfrec.errors import InputError, one_line

_DEFLATE: Final = 1032
"""Largest factor by which deflate shrinks; more than that cannot be in a file."""
_LARGEST_RANK: Final = 2
_FAULTS: Final = (OSError, ValueError, TypeError, RuntimeError, KeyError, AttributeError)
"""What h5py raises for damaged files; `OSError` and `RuntimeError` carry the library's messages."""


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Yield the file, opened for reading, in which no link leads out of it.

    Raises:
        InputError: the file is missing, damaged or not HDF5, links to another file or stores values
            in one, or reading it in the block fails.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    try:
        # HDF5's own lock needs a writable file system and would only keep out other HDF5 writers.
        with h5py.File(path, "r", locking=False) as file:
            for name in file:
                _require_inside(file, name, path)
            yield file
    except InputError:
        raise
    except (*_FAULTS, MemoryError) as error:
        raise InputError(
            f"{path} is damaged or not HDF5 ({first_line(error)}); fetch it again"
        ) from None


def read_numbers(file: Any, path: Path, name: str) -> Array:
    """A data set of numbers in memory, of at most two dimensions; floats become float32.

    Args:
        file: yielded by `opened`.
        name: of the data set, which may lie in groups: `infos/final_observations`.

    Raises:
        InputError: it is not a data set of numbers, claims more values than the file can hold,
            has numbers beyond single precision, or cannot be read.
    """
    parent = file
    for part in name.split("/"):
        _require_inside(parent, part, path)
        parent = parent[part]
    dataset = parent
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{path}: {name} is a group, not a data set")
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: the values of {name} lie in another file; copy them into this")
    if dataset.dtype.kind not in "fiub" or dataset.dtype.subdtype is not None:
        raise InputError(f"{path}: {name} holds {dataset.dtype}, not numbers")
    shape = dataset.shape or ()
    if len(shape) > _LARGEST_RANK:
        raise InputError(f"{path}: {name} have shape {shape}, not 1 or 2 dimensions")
    _require_plausible_size(dataset, path, name)
    try:
        values = np.asarray(dataset)
    except (*_FAULTS, MemoryError) as error:
        raise InputError(
            f"{path}: {name} cannot be read ({first_line(error)}); fetch the file again"
        ) from None
    return convert_singles(values, str(path), name) if values.dtype.kind == "f" else values


def convert_singles(values: Array, where: str, name: str) -> Float32Array:
    """Numbers in single precision.

    Args:
        where: source of the numbers, which the error message starts with.
        name: of the numbers, in the plural.

    Raises:
        InputError: a finite number is beyond single precision.
    """
    with np.errstate(over="ignore"):
        singles = values.astype(np.float32)
    beyond = int(np.count_nonzero(np.isinf(singles) & np.isfinite(values)))
    if beyond:
        raise InputError(
            f"{where}: {beyond} {'number' if beyond == 1 else 'numbers'} of its {name} "
            f"{'is' if beyond == 1 else 'are'} beyond single precision "
            f"(±{np.finfo(np.float32).max:.2g}); scale the {name}, or remove their trajectories"
        )
    return singles


def require_inside(path: Path) -> None:
    """Check that no data set or group of a file leads out of it.

    Raises:
        InputError: one does, or the file is damaged.
    """
    with open_hdf5(path) as file:
        waiting = [file]
        seen = 0
        while waiting:
            group = waiting.pop()
            for name in group:
                _require_inside(group, name, path)
                child = group[name]
                seen += 1
                if seen > 10_000_000:
                    raise InputError(f"{path} has more than 10 million entries")
                if isinstance(child, h5py.Group):
                    waiting.append(child)
                elif child.is_virtual or child.external:
                    raise InputError(
                        f"{path}: the values of {child.name} lie in another file; copy them into "
                        "this"
                    )
                elif child.dtype.kind in "fiub":
                    _require_plausible_size(child, path, str(child.name))


def _require_inside(group: Any, name: str, path: Path) -> None:
    """Check that an entry of a group is neither an external nor a soft link."""
    link = group.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        kind = "another file" if isinstance(link, h5py.ExternalLink) else "another name"
        raise InputError(f"{path}: {name} is a link to {kind}, which is not followed; copy it")


def _require_plausible_size(dataset: Any, path: Path, name: str) -> None:
    """Check that the values can be in the file, before memory is allocated for them."""
    stored = min(int(dataset.id.get_storage_size()), path.stat().st_size)
    factor = _DEFLATE if dataset.id.get_create_plist().get_nfilters() else 1
    if dataset.size * dataset.dtype.itemsize > stored * factor:
        raise InputError(
            f"{path}: {name} claims the shape {dataset.shape}, but only {stored:,} bytes are "
            "stored; fetch the file again"
        )


def first_line(error: BaseException) -> str:
    """The message of an error on one line; its type if it has none."""
    return one_line((str(error).splitlines() or [""])[0]) or type(error).__name__
