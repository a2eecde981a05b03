"""`run.json`, the record of a run: the types of its entries."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.errors import InputError
from ucfrec.files.checksums import FILES
from ucfrec.runs.config import config_from_dict

_LARGEST: Final = 2**48


def is_of_store(record: Mapping[str, Any], meta: Mapping[str, Any]) -> bool:
    """Whether a run was trained on a store: on the same steps, with the same item states.

    Args:
        record: of the run.
        meta: of the store.
    """
    states = [each.get(FILES, {}).get(ITEM_STATES) for each in (record, meta)]
    # Runs and stores that an older ucfrec wrote list no files.
    same_states = None in states or states[0] == states[1]
    return bool(record["fingerprint"] == meta["fingerprint"]) and same_states


def require_run_record(path: Path, record: Mapping[str, Any]) -> None:
    """Check the entries of a run's record that reading a trained policy and reports rely on.

    Args:
        path: of the record, for messages.
        record: its content.

    Raises:
        InputError: an entry is missing or cannot be that of a run.
    """
    for name, holds in _REQUIRED.items():
        if name not in record or not holds(record[name]):
            raise _bad(path, name, record.get(name))
    for name, holds in _OPTIONAL.items():
        if name in record and not holds(record[name]):
            raise _bad(path, name, record[name])
    try:
        config_from_dict(record["config"])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _bad(path: Path, name: str, value: object) -> InputError:
    return InputError(f"{path} is damaged: its {name} is {value!r:.60}; restore it or train again")


def _text(value: object) -> bool:
    return isinstance(value, str)


def _count(value: object) -> bool:
    return type(value) is int and 0 <= value < _LARGEST


def _counts(value: object) -> bool:
    return isinstance(value, list) and all(map(_count, value))


def _number(value: object) -> bool:
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) < _LARGEST
    return isinstance(value, float) and math.isfinite(value)


def _object(value: object) -> bool:
    return isinstance(value, dict)


def _screening(value: object) -> bool:
    dimensions = value.get("dimensions") if isinstance(value, dict) else None
    return isinstance(dimensions, list) and all(
        isinstance(each, dict)
        and _count(each.get("dimension"))
        and isinstance(each.get("causes"), bool)
        for each in dimensions
    )


def _config(value: object) -> bool:
    return isinstance(value, dict) and _text(value.get("policy_name")) and "seed" in value


def _sizes(value: object) -> bool:
    names = ("state", "action", "items")
    if not isinstance(value, dict) or not all(_count(value.get(name)) for name in names):
        return False
    return all(_count(value.get(name, 0)) for name in ("tags", "users"))


def _return_to_go(value: object) -> bool:
    if not isinstance(value, dict) or value.keys() != {"definition", "discount", "horizon"}:
        return False
    if not _number(value["discount"]) or not _count(value["horizon"]):
        return False
    try:
        ReturnToGo(**value)
    except InputError:
        return False
    return True


def _quantiles(value: object) -> bool:
    if not isinstance(value, dict) or not value:
        return False
    try:
        return all(0 <= float(name) <= 1 and _number(each) for name, each in value.items())
    except ValueError:
        return False


def _or_none(holds: Callable[[object], bool]) -> Callable[[object], bool]:
    return lambda value: value is None or holds(value)


_REQUIRED: Final[Mapping[str, Callable[[object], bool]]] = {
    "config": _config,
    "sizes": _sizes,
    "fingerprint": _text,
    "observation_size": _count,
    "return_quantiles": _quantiles,
    "return_to_go": _return_to_go,
    "reward": _text,
    "train_episodes": _count,
    "train_steps": _count,
}
_OPTIONAL: Final[Mapping[str, Callable[[object], bool]]] = {
    "command": _text,
    "store": _text,
    "store_from_run": _or_none(_text),
    "seed": _count,
    "session_by": _or_none(_text),
    "session_gap_ms": _or_none(_number),
    "mean_return": _number,
    "wall_time_s": _number,
    "data": _object,
    "versions": _object,
    "augmentation": _or_none(_object),
    "dropped_observations": _counts,
    "screening": _screening,
    "policy": _object,
}
