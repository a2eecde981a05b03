"""The order of rows of one user at one time, in whole numbers of Python."""

import hashlib

PRIME = 2**31 - 1


def _hash(identifier: object) -> int:
    return int(hashlib.md5(str(identifier).encode()).hexdigest()[:7], 16)


def tie_key(user: object, time: int, item: object) -> int:
    """By which the rows of one user and time are sorted: a hash of user, time and item."""
    multiplier = 1 + (_hash(user) * 7919 + int(time)) % (PRIME - 1)
    return multiplier * (1 + _hash(item)) % PRIME
