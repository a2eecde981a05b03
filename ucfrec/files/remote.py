"""Files that lie elsewhere: a URI on the command line becomes a local path, and back.

Inputs are copied whole to a scratch folder, because DuckDB's connection is closed to the network
and columns of a store are mapped into memory; outputs are copied to their place once the command
has succeeded.

Only `uri_or_path`, the type of an argument of the command line, makes the classes that this module
connects for: a URI in a file, such as a mapping or a run's record, is a path that does not exist.
"""

import argparse
import fnmatch
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import gettempdir
from typing import Any

from ucfrec.errors import InputError
from ucfrec.files.atomic import scratch_folder

_URI = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://.+")
_BLOCK = 2**22
_SPARE = 0.9
"""Share of the free disk that copies may take."""
RECORDS = ("meta.json", "run.json")
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
    """Type of an argument that may be a URI; `local` is its type if it is a path."""

    def read(argument: str) -> Any:
        return kind(argument) if _URI.fullmatch(argument) else local(argument)

    read.__name__ = "path or URI"
    return read


@contextmanager
def local_paths(options: argparse.Namespace) -> Iterator[argparse.Namespace]:
    """The same options with local paths in place of URIs. InputError if an input cannot be read or
    has no place on the disk, an output cannot be written, or a store exists already."""
    values = vars(options)
    lists = [value if isinstance(value, list) else [value] for value in values.values()]
    uris = [uri for arguments in lists for uri in arguments if isinstance(uri, Input | Output)]
    if not uris:
        yield options
        return
    with scratch_folder(Path(gettempdir()), "remote") as scratch:
        try:
            places: dict[str, Path] = {}
            for number, address in enumerate(dict.fromkeys(uris)):
                folder = scratch / str(number)
                folder.mkdir()
                with _errors_of(address):
                    is_input = isinstance(address, Input)
                    relative = _fetch(address, folder) if is_input else _require_new(address)
                # Of a glob, every file has its own address.
                _origins[str(folder)] = address.rstrip("/").removesuffix(relative).rstrip("/")
                places[address] = folder / relative
            yield argparse.Namespace(**{name: _local(v, places) for name, v in values.items()})
            for uri, place in places.items():
                if isinstance(uri, Output) and place.exists():
                    _send(place, uri)
        except InputError as error:
            raise InputError(origin(str(error))) from None
        finally:
            _origins.clear()


def _local(value: Any, places: Mapping[str, Path]) -> Any:
    if isinstance(value, list):
        return [_local(argument, places) for argument in value]
    return places[value] if isinstance(value, Input | Output) else value


def origin(text: str | Path) -> str:
    """A path or message with URIs in place of the paths of their copies."""
    text = str(text)
    for place, uri in _origins.items():
        text = text.replace(place, uri)
    return text


@contextmanager
def _errors_of(uri: str) -> Iterator[None]:
    """Name the address in errors of a file system."""
    try:
        yield
    except InputError:
        raise
    except (ImportError, ValueError, OSError) as error:
        raise InputError(f"{uri} cannot be used ({error}); check the address") from None


def _open(uri: str) -> tuple[Any, str]:
    """The fsspec file system of a URI, and the path in it; pyarrow's own kinds need no package."""
    from fsspec.core import url_to_fs
    from fsspec.implementations.arrow import ArrowFSWrapper
    from pyarrow import fs

    try:
        system, path = fs.FileSystem.from_uri(uri)
        system = ArrowFSWrapper(system)
    except ValueError as error:
        if "Unrecognized filesystem" not in str(error):
            raise
        system, path = url_to_fs(uri)
    return system, str(path).rstrip("/")


def _fetch(uri: str, folder: Path) -> str:
    """Copy the files at a URI to a folder; returns their path or glob in it."""
    system, pattern = _open(uri)
    magic = re.search(r"[*?[]", pattern)
    root = pattern[: magic.start()].rpartition("/")[0] if magic else pattern
    sizes = {
        name: int(info["size"])
        for name, info in system.find(root, detail=True).items()
        if not magic or fnmatch.fnmatchcase(name, pattern)
    }
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
        inner = PurePosixPath(name).relative_to(base).as_posix()
        # A name that leads out of the folder of the copies, on whatever system.
        if re.search(r"[\\\0]|^/|(^|/)(\w:|\.\.(/|$))", inner):
            raise InputError(f"{uri} has a file named {inner!r:.99}; copy it here under a new name")
        target = folder / inner
        target.parent.mkdir(parents=True, exist_ok=True)
        system.get_file(name, str(target))
        if target.stat().st_size != size:
            raise InputError(f"{uri}: {name} changed while it was read; run it again")
    return PurePosixPath(pattern).relative_to(base).as_posix()


def _require_new(uri: str) -> str:
    """Check that no store is at a URI, and that it can be reached; returns the output's name."""
    system, path = _open(uri)
    if any(system.exists(f"{path}/{name}") for name in RECORDS):
        raise InputError(f"{uri} exists already; remove it or name another output")
    return PurePosixPath(path).name


def _send(place: Path, uri: str) -> None:
    """Copy a file or folder to a URI, its record last: without it, a folder is not a store."""
    files = [file for file in place.rglob("*") if file.is_file()] if place.is_dir() else [place]
    files.sort(key=lambda file: (file.name in RECORDS, str(file)))
    with _errors_of(uri):
        system, path = _open(uri)
        # Object stores have no folders, and making one may be forbidden.
        has_folders = not {"s3", "gcs", "abfs"}.intersection([system.protocol])
        for file in files:
            target = path if file == place else f"{path}/{file.relative_to(place).as_posix()}"
            if has_folders:
                system.makedirs(target.rpartition("/")[0], exist_ok=True)
            with file.open("rb") as source, system.open(target, "wb") as copy:
                shutil.copyfileobj(source, copy, _BLOCK)
