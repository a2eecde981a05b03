"""`meta.json`, the record of an episode store: its version, columns, counts and checksums."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.files.checksums import Sealed, sealed_record

RECORD: Final = "meta.json"
"""Name of the file; `ucfrec.files.checksums.seal` adds the checksums of the other files."""
REMEDY: Final = "prepare it again"
"""What to do about a damaged store."""


def read_store_record(path: Path) -> tuple[dict[str, Any], Sealed | None]:
    """Read and check the record of a store.

    Args:
        path: folder of the store.

    Returns:
        The record, and its checksums; None if an older ucfrec wrote none.

    Raises:
        InputError: the folder is not a store, its record is damaged, or a newer ucfrec wrote it.
    """
    if not (path / RECORD).is_file():
        raise InputError(
            f"{path} is not an episode store: it has no {RECORD}; give a folder that "
            "`ucfrec prepare` wrote"
        )
    meta, sealed = sealed_record(path, RECORD, REMEDY)
    version = meta.get("version")
    if type(version) is not int:
        raise InputError(f"{path / RECORD} is damaged: it has no store version; {REMEDY}")
    if version > schema.STORE_VERSION:
        raise InputError(
            f"{path} has store version {version}, this ucfrec reads versions up to "
            f"{schema.STORE_VERSION}; upgrade ucfrec"
        )
    _require_entries(path / RECORD, meta)
    return meta, sealed


def _require_entries(path: Path, meta: Mapping[str, Any]) -> None:
    """Check the types and ranges of what this module reads of a store's record.

    Raises:
        InputError: an entry is missing or cannot be that of a store.
    """
    counts = {name: meta.get(name) for name in ("n_steps", "n_episodes", "n_shards")}
    for name, count in counts.items():
        if type(count) is not int or not 1 <= count < 2**48:
            raise _bad_meta(path, name, count)
    shards, columns = meta["n_shards"], meta.get("columns")
    if shards > meta["n_episodes"] or not (path.parent / f"shard-{shards - 1:05d}").is_dir():
        raise _bad_meta(path, "n_shards", shards)
    if not isinstance(columns, dict) or schema.REWARD not in columns:
        raise _bad_meta(path, "columns", columns)
    for name, shape in columns.items():
        sizes = shape if isinstance(shape, list) else [None]
        vector = name in (schema.ACTION, schema.OBSERVATION)
        known = name in schema.STEP_DTYPES and len(sizes) == vector
        if not known or not all(type(size) is int and 1 <= size <= 2**24 for size in sizes):
            raise _bad_meta(path, f"columns.{name}", shape)
    _require_held(path, meta)
    for name, kind in (("reward", str), ("fingerprint", str), ("source", dict)):
        if not isinstance(meta.get(name), kind):
            raise _bad_meta(path, name, meta.get(name))


def _require_held(path: Path, meta: Mapping[str, Any]) -> None:
    """Check that the files can hold the steps, before memory for an entry a step is asked for.

    Raises:
        InputError: they are too small, or there are fewer steps than episodes.
    """
    steps, episodes = meta["n_steps"], meta["n_episodes"]
    files = [
        path.parent / f"shard-{n:05d}" / f"{schema.REWARD}.npy" for n in range(meta["n_shards"])
    ]
    sizes = [file.stat().st_size for file in files if file.is_file()]
    held = sum(sizes) // np.dtype(schema.STEP_DTYPES[schema.REWARD]).itemsize
    if len(sizes) == len(files) and steps > held:
        raise _bad_meta(path, "n_steps", steps)
    if episodes > steps:
        raise _bad_meta(path, "n_episodes", episodes)


def _bad_meta(path: Path, name: str, value: object) -> InputError:
    return InputError(f"{path} is damaged: its {name} is {value!r:.60}; {REMEDY}")
