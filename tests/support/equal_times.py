"""The order of rows of one user at one time, in whole numbers of Python."""

import xxhash

_ALL = 2**64 - 1


def _mixed(value: int) -> int:
    value = value + 0x9E3779B97F4A7C15 & _ALL
    value = (value ^ value >> 30) * 0xBF58476D1CE4E5B9 & _ALL
    value = (value ^ value >> 27) * 0x94D049BB133111EB & _ALL
    return value ^ value >> 31


def tie_key(user: object, time: int, item: object) -> int:
    """By which the rows of one user and time are sorted: a hash of user, time and item."""
    of_user, of_item = (xxhash.xxh3_64_intdigest(str(each).encode()) for each in (user, item))
    return _mixed(of_item + _mixed(of_user + int(time) & _ALL) & _ALL)
