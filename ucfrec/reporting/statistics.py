"""Mean and standard deviation over seeds, defined once for all tables and figures."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation of a sample."""

    mean: float
    """NaN without values."""
    sd: float
    """Standard deviation with n − 1 in the denominator; NaN for fewer than two values."""
    count: int
    """Number n of values."""

    @property
    def standard_error(self) -> float:
        """Standard error of the mean, sd / √n; NaN for fewer than two values."""
        return float(self.sd / np.sqrt(self.count)) if self.count else float("nan")


def summary(values: Iterable[float]) -> Summary:
    """Mean, standard deviation and number of `values`."""
    sample = np.asarray(list(values), dtype=np.float64)
    mean = float(sample.mean()) if len(sample) else float("nan")
    sd = float(sample.std(ddof=1)) if len(sample) > 1 else float("nan")
    return Summary(mean, sd, len(sample))


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, Sequence[Item]]:
    """Group `items` by `key`; groups and their items stay in order of appearance."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return dict(groups)
