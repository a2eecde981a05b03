"""`meta.json`, the record of an episode store: its version, columns, counts and checksums."""

from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.files.record import Count, Entry, Record, Text

Milliseconds = Annotated[int, Field(strict=True, ge=-62_135_596_800_000, lt=253_402_300_800_000)]
"""Since the Unix epoch, in the years 1 to 9999."""
LONG = 100
"""Times the median from which on a session is hardly a person's."""
_Positive = Annotated[int, Field(strict=True, ge=1, lt=2**48)]
_Width = Annotated[int, Field(strict=True, ge=1, le=2**24)]


class Source(Entry):
    """What a store was made from, as `ucfrec prepare` or a dataset adapter wrote it.

    Every entry is optional; adapters may add others.
    """

    model_config = ConfigDict(extra="allow")

    files: tuple[Text, ...] = ()
    """The logs."""
    dataset: Text | None = None
    """Name of the dataset adapter, or of the dataset."""
    mapping: dict[Text, Text] = Field(default_factory=dict)
    """Log column to the column of the files or the SQL expression that it was."""
    time_format: Text | None = None
    """How its times were written, if they were text; see `ucfrec.logs.mapping.LogMapping`."""
    earliest: Text | None = None
    where: Text | None = None
    """Condition of the rows that were read."""
    partitions: bool = False
    session_by: schema.SessionBy | None = None
    session_gap_ms: Count | None = None
    min_steps: _Positive = 1
    """Episodes with fewer steps were dropped."""
    max_session: _Positive | None = None
    """Episodes with more steps were dropped."""
    duplicates: Literal["highest", "lowest", "first", "last"] = "highest"
    """Which of several rows with the same user, item and time was kept."""
    rows_read: Count | None = None
    dropped: dict[Text, Count] = Field(default_factory=dict)
    """Rows dropped, by reason."""
    unsorted_rows: Count | None = None
    equal_times: Count | None = None
    """Rows at the time of another row of their user, in no order that could be learned."""
    steps: Count | None = None
    decisions: Count | None = None
    users: Count | None = None
    items: Count | None = None
    sessions: Count | None = None
    sessions_cut: Count | None = None
    unknown_propensities: Count | None = None
    """Steps without a propensity; None if the logs have none at all."""
    features: tuple[Text, ...] = ()
    """Id columns whose users or items had feature tables."""
    feature_tables: dict[Text, dict[Text, dict[Text, Count]]] = Field(default_factory=dict)
    """By id column: the feature tables, by file, and how many columns of which kind they had."""
    time_range_ms: tuple[Milliseconds, Milliseconds] | None = None
    """First and last time."""
    split_times_ms: tuple[Milliseconds, Milliseconds] | None = None
    """Times at which validation and test begin."""

    @property
    def others(self) -> Mapping[str, Any]:
        """The entries that an adapter added."""
        return self.__pydantic_extra__ or {}


def _known_columns(columns: dict[str, list[int]]) -> dict[str, list[int]]:
    if schema.REWARD not in columns:
        raise ValueError("it has no reward")
    for name, sizes in columns.items():
        vector = name in (schema.ACTION, schema.OBSERVATION)
        if name not in schema.STEP_DTYPES or len(sizes) != vector:
            raise ValueError(f"there is no column {name!r:.40} of this shape")
    return columns


class StoreRecord(Record):
    """The content of `meta.json`."""

    FILE: ClassVar[str] = "meta.json"
    KIND: ClassVar[str] = (
        "an episode store: it has no meta.json; give a folder that `ucfrec prepare` wrote"
    )
    REMEDY: ClassVar[str] = "prepare it again"

    version: Annotated[int, Field(strict=True, ge=1)]
    """Of the format of stores."""
    n_steps: _Positive
    n_episodes: _Positive
    n_shards: Count
    columns: Annotated[dict[str, list[_Width]], AfterValidator(_known_columns)]
    """Step columns to their sizes: () for numbers, (size,) for vectors."""
    fingerprint: Text
    """SHA-256 of the steps and identifiers; empty for a store in memory."""
    reward: Text
    """The expression that computed the rewards."""
    splits: dict[Text, dict[Text, Count]] = Field(default_factory=dict)
    """Episodes and steps of each split."""
    source: Source

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read and check the record of a store. InputError if the folder is not a store, its record
        is damaged, or a newer ucfrec wrote it."""
        record = super().read(folder)
        names = (folder / f"shard-{n:05d}" for n in range(record.n_shards))
        shards = list(takewhile(Path.is_dir, names))
        # Before memory for an entry per step is allocated: the files can hold the steps.
        files = [file for s in shards if (file := s / f"{schema.REWARD}.npy").is_file()]
        size = np.dtype(schema.STEP_DTYPES[schema.REWARD]).itemsize
        held = sum(file.stat().st_size for file in files) // size
        faults = {
            "n_shards": not 1 <= len(shards) == record.n_shards <= record.n_episodes,
            "n_steps": len(files) == record.n_shards and record.n_steps > held,
            "n_episodes": record.n_episodes > record.n_steps,
        }
        for name in (name for name, holds in faults.items() if holds):
            what = f"{folder / cls.FILE} is damaged: its {name} is {getattr(record, name)}"
            raise InputError(f"{what}; {cls.REMEDY}")
        return record

    @classmethod
    def of(cls, value: Mapping[str, Any], path: Path) -> Self:
        """See `Record.of`."""
        version = value.get("version")
        if type(version) is int and version > schema.STORE_VERSION:
            raise InputError(
                f"{path} has store version {version}, this ucfrec reads versions up to "
                f"{schema.STORE_VERSION}; upgrade ucfrec"
            )
        return super().of(value, path)
