"""Files that lie elsewhere: a URI on the command line becomes a local path, and back.

Inputs are copied whole to a scratch folder, because DuckDB's connection is closed to the network
and columns of a store are mapped into memory; outputs are copied to their place once the command
has succeeded.

Only `uri_or_path`, the type of an argument of the command line, makes the classes that this module
connects for: a URI in a file, such as a mapping or a run's record, is a path that does not exist.
"""

import argparse
import fnmatch
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import gettempdir
from typing import Any, Final

from ucfrec.errors import InputError, one_line
from ucfrec.files.locks import scratch_folder

_URI: Final = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://.+")
_BLOCK: Final = 2**22
_SPARE: Final = 0.9
"""Share of the free disk that copies may take."""
RECORDS: Final = ("meta.json", "run.json")
"""Files that make a folder a store or a run; they are copied last."""

_origins: dict[str, str] = {}
"""Local folder of copies to the address of their folder."""


class Input(str):
    """The URI of files or folders to read."""


class Output(str):
    """The URI of a file or folder to write."""


def uri_or_path(
    kind: type[Input] | type[Output], local: Callable[[str], Any]
) -> Callable[[str], Any]:
    """Type of an argument that may be a URI.

    Args:
        local: type of the argument if it is a path.
    """

    def read(given: str) -> Any:
        return kind(given) if _URI.fullmatch(given) else local(given)

    read.__name__ = "path or URI"
    return read


@contextmanager
def local_paths(options: argparse.Namespace) -> Iterator[argparse.Namespace]:
    """The same options with local paths in place of URIs.

    Raises:
        InputError: an input cannot be read or has no place on the disk, an output cannot be
            written, or a store exists already.
    """
    given = vars(options)
    uris = [each for value in given.values() for each in _each(value) if _is_remote(each)]
    if not uris:
        yield options
        return
    with scratch_folder(Path(gettempdir()), "remote") as scratch:
        try:
            places = {
                uri: _place(uri, scratch / str(n)) for n, uri in enumerate(dict.fromkeys(uris))
            }
            yield argparse.Namespace(**{name: _local(v, places) for name, v in given.items()})
            for uri, place in places.items():
                if isinstance(uri, Output) and place.exists():
                    _send(place, uri)
        except InputError as error:
            raise InputError(origin(str(error))) from None
        finally:
            _origins.clear()


def _place(uri: str, folder: Path) -> Path:
    """Where the copy of an input is, and that of an output will be."""
    folder.mkdir()
    relative = _fetched(uri, folder) if isinstance(uri, Input) else _require_new(uri)
    # Of a glob, every file has its own address.
    _origins[str(folder)] = uri.rstrip("/").removesuffix(relative).rstrip("/")
    return folder / relative


def _is_remote(value: object) -> bool:
    return isinstance(value, Input | Output)


def _each(value: object) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _local(value: Any, places: Mapping[str, Path]) -> Any:
    if isinstance(value, list):
        return [_local(each, places) for each in value]
    return places[value] if _is_remote(value) else value


def origin(text: str | Path) -> str:
    """A path or message with URIs in place of the paths of their copies."""
    text = str(text)
    for place, uri in _origins.items():
        text = text.replace(place, uri)
    return text


def _opened(uri: str) -> tuple[Any, str]:
    """The fsspec file system of a URI, and the path in it; pyarrow's own kinds need no package."""
    import pyarrow as pa
    from fsspec.core import url_to_fs
    from fsspec.implementations.arrow import ArrowFSWrapper
    from pyarrow import fs

    try:
        try:
            system, path = fs.FileSystem.from_uri(uri)
            return ArrowFSWrapper(system), str(path).rstrip("/")
        except pa.ArrowInvalid as error:
            if "Unrecognized filesystem" not in str(error):
                raise
        opened, path = url_to_fs(uri)
        return opened, str(path).rstrip("/")
    except (ImportError, ValueError, OSError) as error:
        raise _unusable(uri, error) from None


def _unusable(uri: str, error: Exception) -> InputError:
    return InputError(f"{uri} cannot be used ({one_line(str(error)):.300}); check the address")


def _fetched(uri: str, folder: Path) -> str:
    """Copy the files at a URI to a folder; returns their path or glob in it."""
    system, pattern = _opened(uri)
    magic = re.search(r"[*?[]", pattern)
    root = pattern[: magic.start()].rpartition("/")[0] if magic else pattern
    try:
        found = system.find(root, detail=True)
        sizes = {name: int(about["size"]) for name, about in found.items()}
    except (OSError, ValueError) as error:
        raise _unusable(uri, error) from None
    if magic:
        sizes = {name: n for name, n in sizes.items() if fnmatch.fnmatchcase(name, pattern)}
    if not sizes:
        raise InputError(f"{uri} has no file; check the address")
    free = shutil.disk_usage(folder).free
    if (total := sum(sizes.values())) > _SPARE * free:
        raise InputError(
            f"{uri} has {total:,} bytes to copy, more than the {free:,} that are free in "
            f"{gettempdir()} allow; free space, or set TMPDIR to a folder on a larger disk"
        )
    base = PurePosixPath(root).parent
    for name, size in sizes.items():
        target = _target(uri, folder, name, base)
        try:
            system.get_file(name, str(target))
        except (OSError, ValueError) as error:
            raise _unusable(uri, error) from None
        if target.stat().st_size != size:
            raise InputError(f"{uri}: {name} changed while it was read; run it again")
    return PurePosixPath(pattern).relative_to(base).as_posix()


def _target(uri: str, folder: Path, name: str, base: PurePosixPath) -> Path:
    """Where the copy of a file goes, in a folder that is made.

    Raises:
        InputError: its name leads out of `folder`.
    """
    relative = PurePosixPath(name).relative_to(base)
    parts = relative.parts
    if relative.is_absolute() or ".." in parts or re.search(r"[\\\0]|(^|/)\w:", str(relative)):
        raise InputError(f"{uri} has a file named {name!r:.200}; copy it here under a new name")
    target = folder / relative
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _require_new(uri: str) -> str:
    """Check that no store is at a URI, and that it can be reached; returns the output's name."""
    system, path = _opened(uri)
    try:
        exists = any(system.exists(f"{path}/{name}") for name in RECORDS)
    except (OSError, ValueError) as error:
        raise _unusable(uri, error) from None
    if exists:
        raise InputError(f"{uri} exists already; remove it or name another output")
    return PurePosixPath(path).name


def _send(place: Path, uri: str) -> None:
    """Copy a file or folder to a URI, its record last: without it, a folder is not a store."""
    system, path = _opened(uri)
    files = [place]
    if place.is_dir():
        files = [Path(where) / name for where, _, names in os.walk(place) for name in names]
    files.sort(key=lambda file: (file.name in RECORDS, str(file)))
    # Object stores have no folders, and making one may be forbidden.
    has_folders = not {"s3", "gcs", "abfs"}.intersection([system.protocol])
    try:
        for file in files:
            relative = file.relative_to(place).as_posix()
            target = path if file == place else f"{path}/{relative}"
            if has_folders:
                system.makedirs(target.rpartition("/")[0], exist_ok=True)
            with file.open("rb") as source, system.open(target, "wb") as copy:
                shutil.copyfileobj(source, copy, _BLOCK)
    except (OSError, ValueError) as error:
        raise _unusable(uri, error) from None
