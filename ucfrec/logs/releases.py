"""Public data sets as their authors publish them: download, checksum, unpacking, columns."""

import hashlib
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from textwrap import shorten

from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder
from ucfrec.logs.mapping import Dataset, LogFiles, LogMapping, Release


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
    path = _unpack(name, release, folder) / release.parts[part]
    if not path.exists():
        raise InputError(f"{path} is missing; delete {folder / name} and load it again")
    files, mapping = dataset.resolve([path], LogMapping())
    return LogFiles(files, mapping, adapter)


def find_release(datasets: Mapping[str, Dataset], name: str) -> str:
    """Name of the adapter that has a release.

    Raises:
        InputError: none has.
    """
    adapters = {release: key for key, dataset in datasets.items() for release in dataset.releases}
    if name not in adapters:
        raise InputError(f"no data set is called {name!r}; there are {', '.join(sorted(adapters))}")
    return adapters[name]


def _unpack(name: str, release: Release, folder: Path) -> Path:
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
    pooch.get_logger().setLevel("WARNING")
    try:
        pooch.retrieve(release.url, release.checksum, archive.name, archive.parent)
    except Exception as error:  # of several libraries, for names, connections, certificates, status
        if "does not match the known hash" in str(error):
            raise InputError(f"{release.url} has changed: {error}; {by_hand}") from None
        reason = shorten(str(error) or type(error).__name__, 200, placeholder=" …")
        raise InputError(f"{name} cannot be downloaded ({reason}); {by_hand}") from None


def _require_checksum(release: Release, archive: Path) -> None:
    kind, _, stated = release.checksum.partition(":")
    with archive.open("rb") as file:
        checksum = hashlib.file_digest(file, kind).hexdigest()
    if checksum != stated:
        raise InputError(
            f"{archive} has {kind} {checksum}, the release {stated}; it is damaged or another "
            "version: delete it and load it again"
        )
