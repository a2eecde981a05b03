"""Public data sets as their authors publish them: download, checksum, unpacking, columns."""

import hashlib
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from textwrap import shorten
from typing import Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder
from ucfrec.logs.mapping import Dataset, LogFiles, LogMapping, Release

_CHUNK: Final = 2**20


def load_release(
    adapter: str, dataset: Dataset, name: str, folder: Path, part: str | None = None
) -> LogFiles:
    """The logs of a release with their columns mapped, downloaded where they are not there yet.

    Args:
        folder: of the archive, and of what it holds in a folder of the release's name.
        part: key of `Release.parts`; None for the first.

    Raises:
        InputError: there is no such part, the archive can be neither found nor downloaded, it has
            another checksum, or it does not hold the part.
    """
    release = dataset.releases[name]
    part = next(iter(release.parts)) if part is None else part
    if part not in release.parts:
        raise InputError(f"{name} has no part {part!r}; it has {', '.join(release.parts)}")
    path = _unpacked(name, release, folder) / release.parts[part]
    if not path.exists():
        raise InputError(f"{path} is missing; delete {folder / name} and load it again")
    files, mapping = dataset.resolve([path], LogMapping())
    return LogFiles(files, mapping, adapter)


def find_release(datasets: Mapping[str, Dataset], name: str) -> str:
    """Name of the adapter that has a release.

    Raises:
        InputError: none has.
    """
    known = {each: adapter for adapter, dataset in datasets.items() for each in dataset.releases}
    if name not in known:
        raise InputError(f"no data set is called {name!r}; there are {', '.join(sorted(known))}")
    return known[name]


def _unpacked(name: str, release: Release, folder: Path) -> Path:
    """The folder with the files of a release."""
    target = folder / name
    if target.is_dir():
        return target
    archive = folder / PurePosixPath(release.url).name
    if not archive.is_file():
        _download(name, release, archive)
    _require_checksum(release, archive)
    with atomic_folder(target) as scratch:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as content:
                content.extractall(scratch)
        else:
            with tarfile.open(archive) as content:
                # Names that lead elsewhere, links out of the folder and devices are refused.
                content.extractall(scratch, filter="data")
        if release.convert is not None:
            release.convert(scratch)
    return target


def _download(name: str, release: Release, archive: Path) -> None:
    by_hand = (
        f"download {release.url} ({release.size / 1e6:,.0f} MB, see {release.homepage}) to "
        f"{archive}, then repeat this"
    )
    try:
        import pooch
    except ModuleNotFoundError:
        raise InputError(
            f"downloading {name} needs pooch; install ucfrec[datasets], or {by_hand}"
        ) from None
    archive.parent.mkdir(parents=True, exist_ok=True)
    logger = pooch.get_logger()
    logger.setLevel("WARNING")
    try:
        pooch.retrieve(release.url, release.checksum, archive.name, archive.parent)
    except Exception as error:  # of several libraries, for names, connections, certificates, status
        if "does not match the known hash" in str(error):
            raise InputError(f"{release.url} has changed: {error}; {by_hand}") from None
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{name} cannot be downloaded ({shorten(reason, 200, placeholder=' …')}); {by_hand}"
        ) from None


def _require_checksum(release: Release, archive: Path) -> None:
    kind, _, expected = release.checksum.partition(":")
    found = hashlib.new(kind, usedforsecurity=False)
    with archive.open("rb") as file:
        while chunk := file.read(_CHUNK):
            found.update(chunk)
    if found.hexdigest() != expected:
        raise InputError(
            f"{archive} has {kind} {found.hexdigest()}, the release {expected}; it is damaged or "
            f"another version: delete it and load it again"
        )
