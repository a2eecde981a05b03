"""A small record, and values that no entry of a record should have."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

from hypothesis import strategies as st

from ucfrec.files.record import Record, Undefinable


class Example(Record):
    FILE: ClassVar[str] = "record.json"
    KIND: ClassVar[str] = "an example: it has no record.json; make one"
    REMEDY: ClassVar[str] = "make it again"

    version: int
    numbers: tuple[Undefinable, ...]
    note: str | None = None
    needed: str | None = "x"


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
"""What may stand in JSON, and more that Python reads."""
MISSING = object()
DAMAGE: dict[str, Any] = {
    "missing": MISSING,
    "null": None,
    "true": True,
    "text": "soon",
    "NaN": float("nan"),
    "huge": 10**400,
    "beyond 64 bits": 1e300,
    "negative": -1,
    "list": [[]],
    "object": {"?": 0},
}
"""Kind of damage to the value that an entry gets."""


def paths(value: Mapping[str, Any], depth: int = 2) -> Iterator[tuple[str, ...]]:
    """Paths of all entries of a JSON object, down to `depth` objects below it."""
    for name, inner in value.items():
        yield (name,)
        if depth and isinstance(inner, Mapping) and name != "files":
            yield from ((name, *rest) for rest in paths(inner, depth - 1))


def damaged(file: Path, value: Mapping[str, Any], path: tuple[str, ...], damage: Any) -> None:
    """Write `value` with the entry at `path` replaced, or taken away if `damage` is `MISSING`."""

    def inner(here: Mapping[str, Any], rest: tuple[str, ...]) -> dict[str, Any]:
        name, *more = rest
        changed = inner(here[name], tuple(more)) if more else damage
        others = {key: each for key, each in here.items() if key != name}
        return others if changed is MISSING else {**others, name: changed}

    file.write_text(json.dumps(inner(value, path)))  # with NaN, which `write_json` makes null
