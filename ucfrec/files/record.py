"""Records: the JSON file that says what a folder is, as a model, with checksums of the other files.

A subclass of `Record` declares its entries with their types; reading checks them all. What is
missing, of another type or out of range is one `InputError` that names file and entry.

Checksums (XXH3, 64 bits) find accidents, not forgers.
"""

import math
import os
from collections.abc import Container, Iterator, Mapping
from functools import partial
from hashlib import file_digest
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import xxhash
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    InstanceOf,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from ucfrec.errors import InputError, explain_os_error
from ucfrec.files.atomic import LOCK, SCRATCH, read_json, write_json

CARD, MEASURED = "MODEL_CARD.md", "measured.json"
"""Files of a run that later measurements change; they are never listed."""
RUN_RECORD = "run.json"
"""Record of a run."""
_THREADS = 2
_LARGEST = 2**48
SMALL = 2**26
"""Bytes of a file that is always read to check it."""
Text = InstanceOf[str]
"""A text; unlike pydantic's own, file names may have bytes that are not valid Unicode."""
Count = Annotated[int, Field(strict=True, ge=0, lt=_LARGEST)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Undefinable = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number that may be NaN, which JSON has as null."""


def file_checksum(path: Path) -> str:
    """XXH3 (64 bits, hexadecimal) of the content of a file."""
    with path.open("rb", buffering=0) as file:
        return file_digest(file, xxhash.xxh3_64).hexdigest()


def _names(folder: Path) -> Iterator[str]:
    for where, folders, files in os.walk(folder):
        # A folder with a record of its own has checksums of its own.
        folders[:] = [name for name in folders if not (Path(where) / name / RUN_RECORD).is_file()]
        for name in files:
            if not name.endswith((LOCK, SCRATCH)) and name not in (CARD, MEASURED):
                yield (Path(where) / name).relative_to(folder).as_posix()


def _inside(files: dict[str, tuple[int, str]]) -> dict[str, tuple[int, str]]:
    for name in files:
        if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
            raise ValueError("a file lies outside the folder")
    return files


_ABSENT: tuple[object, ...] = (None, (), [], {})


class Entry(BaseModel):
    """An immutable JSON object; optional entries that are None or empty are excluded."""

    model_config = ConfigDict(frozen=True)

    @model_serializer(mode="wrap")
    def _serialize(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        return {
            name: value
            for name, value in dump(self).items()
            if name not in fields or fields[name].is_required() or value not in _ABSENT
        }


class Record(Entry):
    """What a folder is: the content of the JSON file `FILE` in it.

    Messages say with `KIND` what makes such a folder, with `REMEDY` what to do about a damaged one.
    """

    FILE: ClassVar[str]
    KIND: ClassVar[str]
    REMEDY: ClassVar[str]

    files: Annotated[dict[Text, tuple[Count, Text]], AfterValidator(_inside)]
    """Size in bytes and checksum of the other files, by path in the folder."""

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read and check the record of a folder; of the other files, nothing is read."""
        path = folder / cls.FILE
        if not path.is_file():
            raise InputError(f"{folder} is not {cls.KIND}")
        value = read_json(path)
        if not isinstance(value, dict):
            raise InputError(f"{path} is damaged: it is not a JSON object; {cls.REMEDY}")
        return cls.of(value, path)

    @classmethod
    def of(cls, value: Mapping[str, Any], path: Path) -> Self:
        """The record of a JSON object; an `InputError` names an entry that is missing or wrong."""
        try:
            _require_bounded(value)
            return cls.model_validate(value)
        except ValidationError as error:
            raise _first_fault(error, path, cls.REMEDY) from None
        except (RecursionError, OverflowError) as error:
            raise InputError(f"{path} is damaged: {error}; {cls.REMEDY}") from None

    def copy_with(self, **entries: Any) -> Self:
        """A copy with other entries."""
        return self.model_copy(update=entries)

    def seal(self, folder: Path) -> Self:
        """Write the record of a complete folder, with the checksums of the other files in it.

        A file that is listed already keeps its checksum, so that damage since is not signed off.
        """
        files = {
            name: self.files.get(name)
            or ((folder / name).stat().st_size, file_checksum(folder / name))
            for name in sorted(_names(folder))
            if name != self.FILE
        }
        return self.copy_with(files=files).write(folder)

    def reopen(self, folder: Path, unchanged: Container[str]) -> Self:
        """Write the record before files of the folder change, but for those `unchanged`."""
        files = {name: entry for name, entry in self.files.items() if name in unchanged}
        return self if files == self.files else self.copy_with(files=files).write(folder)

    def write(self, folder: Path) -> Self:
        """Write the record as it is; returns it."""
        write_json(folder / self.FILE, self.model_dump(), seal=True)
        return self

    def require(
        self,
        folder: Path,
        *names: str,
        small: int = -1,
    ) -> None:
        """Check size and content of `names` that are listed; without any, sizes, and small files.
        An InputError names the first file that is missing or has another content."""
        for name in names or self.files:
            if name not in self.files:
                continue
            if fault := self._find_fault(folder, name, bool(names) or self.files[name][0] <= small):
                raise InputError(f"{folder / name} {fault}; restore the file, or {self.REMEDY}")

    def faults(self, folder: Path) -> Iterator[tuple[str, str]]:
        """Read every file; yields (path in the folder, what is wrong with it)."""
        from concurrent.futures import ThreadPoolExecutor  # only to verify everything

        with ThreadPoolExecutor(_THREADS) as threads:
            faults = threads.map(partial(self._find_fault, folder), self.files)
            yield from (pair for pair in zip(self.files, faults, strict=True) if pair[1])

    def strangers(self, folder: Path) -> list[str]:
        """Files of the folder that are not listed, without locks and scratch."""
        return sorted(set(_names(folder)) - self.files.keys())

    def _find_fault(
        self,
        folder: Path,
        name: str,
        content: bool = True,
    ) -> str:
        path, (stated, checksum) = folder / name, self.files[name]
        try:
            if not path.is_file():
                return "is not a regular file" if path.exists() else "is missing"
            if (size := path.stat().st_size) != stated:
                kind = "truncated" if size < stated else "grown"
                return f"is {kind}: {size:,} of {stated:,} bytes"
            same = not content or file_checksum(path) == checksum
            return "" if same else "has another content than was written"
        except OSError as error:
            return f"cannot be read ({explain_os_error(error)})"


def _first_fault(error: ValidationError, path: Path, remedy: str) -> InputError:
    """The first of pydantic's errors, as one line."""
    fault = error.errors(include_url=False)[0]
    name = ".".join(str(part) for part in fault["loc"] if part != "[key]")
    cause = fault.get("ctx", {}).get("error", "")
    what = f" is damaged: its {name} is {fault['input']!r:.60}{cause and f', {cause}'}"
    if isinstance(cause, InputError):
        what = f": {cause}"
    elif fault["type"] == "missing":
        what = f" has no {name}"
    return InputError(f"{path}{what}; {remedy}")


def _require_bounded(value: object, name: str = "") -> None:
    """Raise OverflowError for an integer that does not fit 64 bits."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise OverflowError(f"its {name} is a number with more than 18 digits")
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    for key, entry in value.items() if isinstance(value, Mapping) else ():
        _require_bounded(entry, f"{name}.{key}" if name else str(key))
