"""Durations as options write them."""

import re
from typing import Final

from ucfrec.errors import InputError

_UNITS_MS: Final = {"s": 1_000, "m": 60_000, "h": 3_600_000, "d": 86_400_000}


def duration_ms(option: str, given: str) -> int:
    """Milliseconds of a duration such as `90s`, `30m`, `12h` or `60d`.

    Raises:
        InputError: it is written otherwise, or is 0.
    """
    found = re.fullmatch(r"(\d{1,9}(?:\.\d+)?)([smhd])", given.strip())
    milliseconds = 0 if found is None else round(float(found[1]) * _UNITS_MS[found[2]])
    if not milliseconds:
        raise InputError(f"{option} {given} is not a duration; write e.g. 90s, 30m, 12h or 60d")
    return milliseconds
