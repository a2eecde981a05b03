"""Write the steps of a log's episodes to a store, with numbers in place of ids."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.writer import StoreWriter
from ucfrec.logs.ids import numbers
from ucfrec.logs.measures import Measures
from ucfrec.logs.sessions import Episodes
from ucfrec.logs.spool import Spool
from ucfrec.logs.typed import TypedLog
from ucfrec.progress import Progress


@dataclass(frozen=True)
class StepNumbers:
    """The numbers that a store gives to the users and items of a log."""

    users: Spool
    """`number` of each user in the steps, in order; −1 for users that the store does not know."""
    items: IntArray
    """(items,) number of each item by code; −1 likewise, and for items in no step."""

    @classmethod
    def of(cls, log: TypedLog, measures: Measures, folder: Path) -> "StepNumbers":
        """The numbers in the tables of `ucfrec.logs.ids.number_ids`.

        Args:
            measures: of the log's episodes.
        """
        users = Spool(folder / "numbers")
        for batch in numbers(log, schema.USER_ID, "users"):
            users.append({"number": batch})
        items = np.full(len(measures.item_steps), -1, dtype=np.int64)
        if log.key == schema.ITEM_ID:
            found = numbers(log, schema.ITEM_ID, "items")
            items[np.flatnonzero(measures.item_steps)] = np.concatenate(list(found))
        return cls(users, items)


def write_steps(
    folder: Path,
    episodes: Iterable[Episodes],
    spool: Spool,
    numbered: StepNumbers,
    display: Progress,
    first_shard: int = 0,
    fill: Mapping[str, float] = MappingProxyType({}),
) -> StoreWriter:
    """Write all episodes to the store at `folder`.

    Args:
        fill: the step columns of the store, with what steps without a value have; others are left
            out. Empty for those of the log.
    """
    writer = StoreWriter(folder, first_shard=first_shard)
    names = [name for name in schema.STEP_DTYPES if name in spool.names]
    names = [name for name in names if name in fill or not fill]
    users_before, last_user = 0, None
    for found in episodes:
        if not len(found.lengths):
            continue
        steps: dict[str, Array] = {n: found.column(spool, n) for n in names}
        rows = int(found.lengths.sum())
        steps |= {n: np.full(rows, value) for n, value in fill.items() if n not in steps}
        if schema.ITEM in steps:
            steps[schema.ITEM] = numbered.items[steps[schema.ITEM]]
        new = np.append(found.users[0] != last_user, found.users[1:] != found.users[:-1])
        places = np.cumsum(new) - 1 + users_before
        first_place = int(places[0])
        values = numbered.users.read("number", first_place, int(places[-1]) + 1)
        users_before, last_user = int(places[-1]) + 1, found.users[-1]
        first = np.zeros(rows, dtype=bool)
        first[np.cumsum(found.lengths) - found.lengths] = True
        each = {
            schema.USER: values[places - first_place],
            schema.SPLIT: found.splits,
            schema.TERMINATED: found.terminated,
        }
        writer.append(steps, first, {n: np.repeat(v, found.lengths) for n, v in each.items()})
        display.update(len(first))
    return writer
