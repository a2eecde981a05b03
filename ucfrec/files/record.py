"""Records: the JSON file that says what a folder is, as a model, with checksums of the other files.

A subclass of `Record` declares its entries with their types; reading checks them all. What is
missing, of another type or out of range is one `InputError` that names file and entry.
"""

import math
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Self

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

from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_sealed_json
from ucfrec.files.checksums import Sealed, files_of

_LARGEST: Final = 2**48

Text = InstanceOf[str]
"""A text; unlike pydantic's own, file names may have bytes that are not valid Unicode."""
Count = Annotated[int, Field(strict=True, ge=0, lt=_LARGEST)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Undefinable = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number that may be NaN, which JSON has as null."""


def _inside(files: dict[str, tuple[int, str]]) -> dict[str, tuple[int, str]]:
    for name in files:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ValueError("a file lies outside the folder")
    return files


class Entry(BaseModel):
    """An immutable JSON object; optional entries that are None or empty are excluded."""

    model_config = ConfigDict(frozen=True)

    @model_serializer(mode="wrap")
    def _without_absent(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        return {
            name: value
            for name, value in dump(self).items()
            if name not in fields or fields[name].is_required() or not _absent(value)
        }


def _absent(value: object) -> bool:
    return value is None or (isinstance(value, tuple | list | dict) and not value)


class Record(Entry):
    """What a folder is: the content of the JSON file `FILE` in it."""

    FILE: ClassVar[str]
    """Name of the file in the folder."""
    KIND: ClassVar[str]
    """What the folder is, for messages, with what makes one."""
    REMEDY: ClassVar[str]
    """What to do about a damaged folder."""

    files: Annotated[dict[Text, tuple[Count, Text]], AfterValidator(_inside)]
    """Size in bytes and checksum of the other files, by path in the folder."""

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read and check the record of a folder; of the other files, nothing is read.

        Raises:
            InputError: the folder has no such record, or it is damaged.
        """
        path = folder / cls.FILE
        if not path.is_file():
            raise InputError(f"{folder} is not {cls.KIND}")
        value = read_json(path)
        if not isinstance(value, dict):
            raise InputError(f"{path} is damaged: it is no JSON object; {cls.REMEDY}")
        return cls.of(value, path)

    @classmethod
    def of(cls, value: Mapping[str, Any], path: Path) -> Self:
        """The record of a JSON object.

        Raises:
            InputError: an entry is missing, has another type or is out of range.
        """
        try:
            _require_bounded(value)
            return cls.model_validate(value)
        except RecursionError:
            raise InputError(f"{path} is damaged: it is nested too deep; {cls.REMEDY}") from None
        except OverflowError as error:
            raise InputError(f"{path} is damaged: {error}; {cls.REMEDY}") from None
        except ValidationError as error:
            raise _first_fault(error, path, cls.REMEDY) from None

    def with_entries(self, **entries: Any) -> Self:
        """A copy with other entries."""
        return self.model_copy(update=entries)

    def sealed(self, folder: Path) -> Self:
        """Write the record of a complete folder, with the checksums of the other files in it.

        A file that is listed already keeps its checksum, so that damage since is not signed off.
        """
        return self.with_entries(files=files_of(folder, self.FILE, self.files)).written(folder)

    def reopened(self, folder: Path, kept: Container[str]) -> Self:
        """Write the record before files of the folder change.

        Args:
            folder: sealed by `sealed`.
            kept: files that will not change; the others are no longer listed.
        """
        listed = {name: entry for name, entry in self.files.items() if name in kept}
        return self if listed == self.files else self.with_entries(files=listed).written(folder)

    def written(self, folder: Path) -> Self:
        """Write the record as it is; returns it."""
        write_sealed_json(folder / self.FILE, self.model_dump())
        return self

    def checksums(self, folder: Path) -> Sealed:
        """Of the other files of the folder of this record."""
        return Sealed(folder, self.REMEDY, self.files)


def _first_fault(error: ValidationError, path: Path, remedy: str) -> InputError:
    """The first of pydantic's errors, as one line."""
    fault = error.errors(include_url=False)[0]
    name = ".".join(str(part) for part in fault["loc"] if part != "[key]")
    cause = fault.get("ctx", {}).get("error")
    if isinstance(cause, InputError):
        return InputError(f"{path}: {cause}; {remedy}")
    if fault["type"] == "missing":
        return InputError(f"{path} has no {name}; {remedy}")
    what = f", {cause}" if cause else ""
    return InputError(f"{path} is damaged: its {name} is {fault['input']!r:.60}{what}; {remedy}")


def _require_bounded(value: object, name: str = "") -> None:
    """Raise OverflowError for an integer that does not fit 64 bits."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise OverflowError(f"its {name} is a number with more than 18 digits")
    if isinstance(value, Mapping):
        for key, each in value.items():
            _require_bounded(each, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        for each in value:
            _require_bounded(each, name)
