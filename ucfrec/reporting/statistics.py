"""Means and spreads over seeds: one definition for every table and every picture."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")


@dataclass(frozen=True)
class Summary:
    """A sample's mean and spread."""

    mean: float
    """NaN of no values."""
    sd: float
    """Standard deviation with n − 1 in the denominator; NaN of fewer than two values."""
    count: int

    @property
    def standard_error(self) -> float:
        """Of the mean; NaN of fewer than two values."""
        return float(self.sd / np.sqrt(self.count)) if self.count else float("nan")


def summary(values: Iterable[float]) -> Summary:
    """Mean, standard deviation and number of `values`."""
    known = np.asarray(list(values), dtype=np.float64)
    mean = float(known.mean()) if len(known) else float("nan")
    sd = float(known.std(ddof=1)) if len(known) > 1 else float("nan")
    return Summary(mean, sd, len(known))


def paired_differences(values: Mapping[Key, float], others: Mapping[Key, float]) -> list[float]:
    """`values` less `others` under the keys (seeds) that both have, in the order of `values`."""
    return [value - others[key] for key, value in values.items() if key in others]


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, Sequence[Item]]:
    """`items` by their `key`, keys and items in the order in which they come."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return dict(groups)
