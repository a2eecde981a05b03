"""Checksums of the files of a store or a run, recorded in its `meta.json` or `run.json`.

XXH3 (64 bits) runs at the speed of memory, where CRC-32 of zlib has a quarter of it. It finds
accidents, not forgers: who can change a file can change its checksum.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import xxhash

from ucfrec.errors import InputError, explain_os_error
from ucfrec.files.locks import is_lock_or_scratch

CARD, MEASURED = "MODEL_CARD.md", "measured.json"
"""Files of a run that later measurements change; they are never listed."""
RUN_RECORD: Final = "run.json"
"""Record of a run."""
_BLOCK: Final = 2**19
_THREADS: Final = 2


def files_of(
    folder: Path, record: str, known: Mapping[str, tuple[int, str]]
) -> dict[str, tuple[int, str]]:
    """Size and checksum of every file of a complete folder, but its record.

    Args:
        record: name of the record in it, e.g. `meta.json`.
        known: files that keep the entry that they have.
    """
    return {
        name: known.get(name) or ((folder / name).stat().st_size, file_checksum(folder / name))
        for name in sorted(_names(folder))
        if name != record
    }


def file_checksum(path: Path) -> str:
    """XXH3 (64 bits, hexadecimal) of the content of a file."""
    digest, block = xxhash.xxh3_64(), bytearray(_BLOCK)
    view = memoryview(block)
    with path.open("rb", buffering=0) as file:
        while size := file.readinto(block):
            digest.update(view[:size])
    return digest.hexdigest()


@dataclass(frozen=True)
class Sealed:
    """The files of a folder and what its record says about them."""

    folder: Path
    remedy: str
    """What to do about a damaged file, for messages."""
    files: Mapping[str, tuple[int, str]]
    """Path in the folder to size in bytes and checksum."""

    def require_sizes(self) -> None:
        """Check that every file is there with its size; no file is read.

        Raises:
            InputError: the first file that is missing, or has another size.
        """
        for name, (size, _) in self.files.items():
            if fault := _size_fault(self.folder / name, size):
                raise self._error(name, fault)

    def require(self, name: str) -> None:
        """Read a file and check its size and checksum; a file that is not listed passes.

        Raises:
            InputError: the file is missing or has another content.
        """
        if name in self.files and (fault := self._fault(name)):
            raise self._error(name, fault)

    def require_small(self, largest: int = 2**26) -> None:
        """Check the sizes of all files, and the content of those of at most `largest` bytes.

        Raises:
            InputError: the first file that is missing or has another content.
        """
        self.require_sizes()
        for name, (size, _) in self.files.items():
            if size <= largest:
                self.require(name)

    def faults(self) -> Iterator[tuple[str, str]]:
        """Read every file, several at a time; yields (path in the folder, what is wrong with it).

        Reading and hashing release Python's lock, so with two processors the hashing costs no time.
        """
        from concurrent.futures import ThreadPoolExecutor  # only to verify everything

        with ThreadPoolExecutor(_THREADS) as threads:
            for name, fault in zip(self.files, threads.map(self._fault, self.files), strict=True):
                if fault:
                    yield name, fault

    def strangers(self) -> list[str]:
        """Files of the folder that are not listed, without locks and scratch."""
        return sorted(set(_names(self.folder)) - self.files.keys())

    def _fault(self, name: str) -> str:
        size, stated = self.files[name]
        path = self.folder / name
        try:
            return _size_fault(path, size) or (
                "" if file_checksum(path) == stated else "has another content than was written"
            )
        except OSError as error:
            return f"cannot be read ({explain_os_error(error)})"
        except ValueError as error:  # a name that no file can have
            return f"cannot be read ({error})"

    def _error(self, name: str, fault: str) -> InputError:
        return InputError(f"{self.folder / name} {fault}; restore the file, or {self.remedy}")


def _size_fault(path: Path, size: int) -> str:
    try:
        found = path.stat().st_size
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError):
            return "is missing"
        return f"cannot be read ({error})"
    if found == size:
        return "" if path.is_file() else "is no regular file"
    return f"is {'truncated' if found < size else 'grown'}: {found:,} of {size:,} bytes"


def _names(folder: Path) -> Iterator[str]:
    for where, folders, files in os.walk(folder):
        # A folder with a record of its own has checksums of its own.
        folders[:] = [name for name in folders if not (Path(where) / name / RUN_RECORD).is_file()]
        for name in files:
            if not is_lock_or_scratch(name) and name not in (CARD, MEASURED):
                yield (Path(where) / name).relative_to(folder).as_posix()
