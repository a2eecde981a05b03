"""Files that lie elsewhere: a URI on the command line becomes a local path, and back.

Inputs are copied to a scratch folder, because DuckDB's connection is closed to the network and
columns of a store are mapped into memory; outputs are copied to their place once the command has
succeeded. Of Parquet logs and of the shards of a store nothing is copied but the columns that a
command reads: their copies have holes, which `fetch` fills before a column is read.

Only `uri_or_path`, the type of an argument of the command line, makes the classes that this module
connects for: a URI in a file, such as a mapping or a run's record, is a path that does not exist.
"""

import argparse
import fnmatch
import os
import re
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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


_SMALL: Final = 2**20
"""Bytes up to which a file is copied at once."""


@dataclass
class _Partial:
    """A file whose copy has holes, which read as zeros."""

    system: Any
    uri: str
    path: str
    about: tuple[int, object]
    """Its size and time of change."""
    holes: dict[str, list[tuple[int, int]]]
    """Begin and end of what is not there yet, by the column that it belongs to."""


_partial: dict[str, _Partial] = {}
"""Path of each copy with holes to its file."""
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
        kind: what the argument is.
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
            _partial.clear()


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
    """The pyarrow file system of a URI, and the path in it."""
    import pyarrow as pa
    from pyarrow import fs

    try:
        system, path = fs.FileSystem.from_uri(uri)
        return system, str(path)
    except pa.ArrowInvalid as error:
        if "Unrecognized filesystem" not in str(error):
            raise _unusable(uri, error) from None
    except OSError as error:
        raise _unusable(uri, error) from None
    try:
        from fsspec.core import url_to_fs

        opened, path = url_to_fs(uri)
    except (ImportError, ValueError, OSError) as error:
        raise _unusable(uri, error) from None
    return fs.PyFileSystem(fs.FSSpecHandler(opened)), path


def _unusable(uri: str, error: Exception) -> InputError:
    if isinstance(error, ModuleNotFoundError) and error.name == "fsspec":
        return InputError(f"{uri} needs fsspec; pip install 'ucfrec[cloud]'")
    return InputError(f"{uri} cannot be used ({one_line(str(error)):.300}); check the address")


def _files(uri: str) -> tuple[Any, str, str, list[Any]]:
    """File system, path or glob, folder or file of it, and pyarrow's `FileInfo` of the files."""
    from pyarrow import fs

    system, path = _opened(uri)
    path = path.rstrip("/")
    try:
        magic = re.search(r"[*?[]", path)
        root = path[: magic.start()].rpartition("/")[0] if magic else path
        (about,) = system.get_file_info([root])
        if about.type == fs.FileType.File:
            return system, path, root, [about]
        found = system.get_file_info(fs.FileSelector(root, recursive=True))
    except (OSError, ValueError) as error:
        raise _unusable(uri, error) from None
    files = [each for each in found if each.type == fs.FileType.File]
    if magic:
        files = [each for each in files if fnmatch.fnmatchcase(each.path, path)]
    return system, path, root, files


def _fetched(uri: str, folder: Path) -> str:
    """Copy the files at a URI to a folder; returns their path or glob in it."""
    system, pattern, root, files = _files(uri)
    if not files:
        raise InputError(f"{uri} has no file; check the address")
    base = PurePosixPath(root).parent
    stores = {str(PurePosixPath(each.path).parent) for each in files if each.base_name in RECORDS}
    whole = []
    for each in files:
        relative = PurePosixPath(each.path).relative_to(base)
        if ".." in relative.parts or relative.is_absolute() or "\\" in each.path:
            raise InputError(
                f"{uri} has a file named {each.path!r:.200}; copy it here under a new name"
            )
        target = folder / relative
        target.parent.mkdir(parents=True, exist_ok=True)
        holes = None
        if each.size > _SMALL:
            holes = _holes(system, uri, each, stores)
        found = _Partial(system, uri, each.path, (each.size, each.mtime_ns), holes or {})
        with target.open("xb") as copy:
            copy.truncate(each.size)
        kept = _outside(found.holes, each.size)
        whole.append((found, target, kept))
        if found.holes:
            _partial[os.path.realpath(target)] = found
    _require_room(uri, sum(end - begin for *_, kept in whole for begin, end in kept), folder)
    for found, target, kept in whole:
        _copy(found, target, kept)
    return PurePosixPath(pattern).relative_to(base).as_posix()


def fetch(file: Path, columns: Collection[str] | None = None) -> None:
    """Copy what is to be read of a file that the command line named by its address.

    A file that is here already, or never was elsewhere, is left alone.

    Args:
        file: its local path.
        columns: of a Parquet file, the only ones that will be read; None for all of the file.

    Raises:
        InputError: the file cannot be read, has changed, or has no place on the disk.
    """
    found = _partial.get(os.path.realpath(file))
    if found is None:
        return
    names = [name for name in found.holes if columns is None or name in columns]
    # Two columns share a part where the name of one, with its field, is the name of the other.
    ranges = sorted({part for name in names for part in found.holes[name]})
    if not ranges:
        return
    _require_room(found.uri, sum(end - begin for begin, end in ranges), file.parent)
    _copy(found, file, ranges)
    for name in names:
        del found.holes[name]


def _holes(
    system: Any, uri: str, about: Any, stores: set[str]
) -> dict[str, list[tuple[int, int]]] | None:
    """What need not be copied of a file before it is read; None if all of it must."""
    folder = PurePosixPath(about.path).parent
    if stores.intersection(map(str, (folder, *folder.parents))):
        is_column = folder.name.startswith("shard-") and about.path.endswith(".npy")
        return {"": [(0, about.size)]} if is_column else None
    if not about.path.endswith(".parquet"):
        return None
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with system.open_input_file(about.path) as source:
            metadata = pq.ParquetFile(source).metadata
            names = metadata.schema.to_arrow_schema().names
    except (pa.ArrowException, OSError, ValueError):
        # Whoever reads the copy says what is wrong with it.
        return None
    holes: dict[str, list[tuple[int, int]]] = {}
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            offsets = (column.dictionary_page_offset, column.data_page_offset)
            begin = min((offset for offset in offsets if offset), default=0)
            end = begin + column.total_compressed_size
            if not 0 < begin < end <= about.size:
                return None
            for name in names:
                if f"{column.path_in_schema}.".startswith(f"{name}."):
                    holes.setdefault(name, []).append((begin, end))
    return holes


def _outside(holes: Mapping[str, list[tuple[int, int]]], size: int) -> list[tuple[int, int]]:
    """Begin and end of what is in no hole."""
    kept, done = [], 0
    for begin, end in sorted(part for parts in holes.values() for part in parts):
        if begin > done:
            kept.append((done, begin))
        done = max(done, end)
    return [*kept, (done, size)] if done < size else kept


def _require_room(uri: str, size: int, folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if size > _SPARE * free:
        raise InputError(
            f"{uri} has {size:,} bytes to copy, more than the {free:,} that are free in "
            f"{gettempdir()} allow; free space, or set TMPDIR to a folder on a larger disk"
        )


def _copy(found: _Partial, target: Path, ranges: Sequence[tuple[int, int]]) -> None:
    """Copy parts of a file to the same places of its copy."""
    complete = True
    try:
        with found.system.open_input_file(found.path) as source, target.open("r+b") as copy:
            for begin, end in ranges:
                source.seek(begin)
                copy.seek(begin)
                while begin < end and (block := source.read(min(_BLOCK, end - begin))):
                    copy.write(block)
                    begin += len(block)
                complete = complete and begin == end
        (about,) = found.system.get_file_info([found.path])
    except (OSError, ValueError) as error:
        raise _unusable(found.uri, error) from None
    if not complete or (about.size, about.mtime_ns) != found.about:
        raise InputError(f"{found.uri}: {found.path} changed while it was read; run it again")


def _require_new(uri: str) -> str:
    """Check that no store is at a URI, and that it can be reached; returns the output's name."""
    system, path = _opened(uri)
    try:
        found = system.get_file_info([f"{path.rstrip('/')}/{name}" for name in RECORDS])
    except (OSError, ValueError) as error:
        raise _unusable(uri, error) from None
    if any(each.is_file for each in found):
        raise InputError(f"{uri} exists already; remove it or name another output")
    return PurePosixPath(path).name


def _send(place: Path, uri: str) -> None:
    """Copy a file or folder to a URI, its record last: without it, a folder is no store."""
    system, path = _opened(uri)
    files = [place]
    if place.is_dir():
        files = [Path(where) / name for where, _, names in os.walk(place) for name in names]
    files.sort(key=lambda file: (file.name in RECORDS, str(file)))
    try:
        for file in files:
            relative = file.relative_to(place).as_posix()
            target = path.rstrip("/") if file == place else f"{path.rstrip('/')}/{relative}"
            if _has_folders(system):
                system.create_dir(target.rpartition("/")[0], recursive=True)
            with file.open("rb") as source, system.open_output_stream(target) as copy:
                shutil.copyfileobj(source, copy, _BLOCK)
    except (OSError, ValueError) as error:
        raise _unusable(uri, error) from None


def _has_folders(system: Any) -> bool:
    """Whether folders must be made; object stores have none, and making one may be forbidden."""
    return system.type_name not in ("s3", "gcs", "abfs")
