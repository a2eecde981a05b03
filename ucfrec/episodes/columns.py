"""The columns of an episode store: memory-mapped files or arrays in memory."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.episodes.record import Source, StoreRecord
from ucfrec.episodes.returns import ReturnToGo, returns_to_go
from ucfrec.episodes.states import ItemStates
from ucfrec.errors import InputError, one_line
from ucfrec.files.record import Sealed

_REMEDY: Final = StoreRecord.REMEDY
_DTYPES: Final = {
    schema.OFFSETS: "<i8",
    schema.RETURN_TO_GO: "<f4",
    **schema.STEP_DTYPES,
    **schema.EPISODE_DTYPES,
}
_IN_MEMORY = Path("<memory>")


def load_column(
    store: Path, file: str, shape: tuple[int, ...], mmap: bool, sealed: Sealed
) -> Array:
    """A column of one shard.

    Args:
        file: of the column, named `SHARD/COLUMN.npy`.
        shape: of each row.
        mmap: whether the file stays mapped instead of being read.

    Raises:
        InputError: the file is missing or damaged, or holds something else.
    """
    sealed.require(file)
    path = store / file
    try:
        # Mapping compares the header with the size of the file before it takes memory.
        values: Array = np.load(path, mmap_mode="r")
    except Exception as error:  # numpy parses headers as Python and raises what that raises
        message = one_line(str(error)) or type(error).__name__
        raise InputError(f"{path} is missing or damaged ({message}); {_REMEDY}") from None
    if values.dtype != _DTYPES[path.stem] or values.shape[1:] != shape or values.ndim == 0:
        raise InputError(
            f"{path} is damaged: it holds {values.dtype} in the shape {values.shape}; {_REMEDY}"
        )
    return values if mmap else np.array(values)


class StepColumn:
    """A step column, indexed across its shards."""

    def __init__(self, parts: list[Array], kept: IntArray | None = None) -> None:
        """
        Args:
            parts: one a shard, (M,) or (M, size).
            kept: dimensions that values have; None for all.
        """
        self._parts, self._kept = parts, kept
        self._bounds = np.cumsum([0] + [len(part) for part in self._parts])

    def __len__(self) -> int:
        return int(self._bounds[-1])

    def of_dimensions(self, kept: IntArray) -> "StepColumn":
        """The same column with some dimensions of those that it has, (K,) indices."""
        return StepColumn(self._parts, kept if self._kept is None else self._kept[kept])

    def range(self) -> tuple[Any, Any]:
        """The lowest and the highest value."""
        return min(part.min() for part in self._parts), max(part.max() for part in self._parts)

    def take(self, index: IntArray) -> Array:
        """A copy of the values at the indices `index`, of any shape."""
        values = self._taken(index)
        return values if self._kept is None else values[..., self._kept]

    def between(self, begin: int, end: int) -> Array:
        """The values from index `begin` to before `end`; of one shard, without a copy."""
        first = int(np.searchsorted(self._bounds, begin, side="right")) - 1
        last = int(np.searchsorted(self._bounds, end, side="left"))
        parts = [
            np.asarray(part[max(begin - low, 0) : end - low])
            for part, low in zip(self._parts[first:last], self._bounds[first:last], strict=True)
        ]
        values = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return values if self._kept is None else values[..., self._kept]

    def _taken(self, index: IntArray) -> Array:
        if len(self._parts) == 1:
            return np.asarray(self._parts[0][index])
        shard = np.searchsorted(self._bounds[1:-1], index, side="right")
        first = self._parts[0]
        values = np.empty((*index.shape, *first.shape[1:]), dtype=first.dtype)
        for i, part in enumerate(self._parts):
            in_shard = shard == i
            values[in_shard] = part[index[in_shard] - self._bounds[i]]
        return values


class Columns:
    """The columns of all E episodes of a store, with N steps in total.

    Episodes are numbered 0 to E − 1 in the order of the store, independently of any view.
    """

    def __init__(
        self,
        path: Path,
        record: StoreRecord,
        arrays: Mapping[str, Array] | None = None,
        item_states: ItemStates | None = None,
        return_to_go: ReturnToGo | None = None,
    ) -> None:
        """
        Args:
            arrays: columns in memory, by name, used instead of the files of the folder.
            item_states: used instead of the file of the folder.
            return_to_go: what the returns-to-go count; None for the rest of the session.
        """
        self.return_to_go = return_to_go or ReturnToGo()
        self.path, self.record, self._sealed = path, record, record.checksums(path)
        self._arrays, self._item_states_in_memory = dict(arrays or {}), item_states
        self._shards = [path / f"shard-{i:05d}" for i in range(record.n_shards)]
        self._steps: dict[str, StepColumn] = {}
        self.skipped: IntArray | None = None
        """(E,) number of steps at the beginning of each episode that are known but do not count;
        None for none."""

    @classmethod
    def open(cls, path: Path) -> "Columns":
        """Open a store folder; only `meta.json` is read, columns are mapped on first use.

        Raises:
            InputError: the folder is not a store, is damaged, or was written by a newer ucfrec.
        """
        columns = cls(path, StoreRecord.read(path))
        columns._sealed.require_sizes()
        return columns

    @classmethod
    def from_arrays(
        cls,
        steps: Mapping[str, Array],
        lengths: IntArray,
        episodes: Mapping[str, Array],
        item_states: ItemStates | None,
    ) -> "Columns":
        """See `EpisodeStore.from_arrays`; `episodes` must include `split`.

        Raises:
            InputError: columns differ in length.
        """
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        arrays = {name: np.asarray(v, dtype=schema.STEP_DTYPES[name]) for name, v in steps.items()}
        arrays |= {
            name: np.asarray(v, dtype=schema.EPISODE_DTYPES[name]) for name, v in episodes.items()
        }
        for name, values in arrays.items():
            expected = int(offsets[-1]) if name in steps else len(lengths)
            if len(values) != expected:
                raise InputError(
                    f"column {name!r} has {len(values)} values instead of {expected}; give one per "
                    f"{'step' if name in steps else 'episode'}"
                )
        record = StoreRecord(
            files={},
            version=schema.STORE_VERSION,
            n_steps=int(offsets[-1]),
            n_episodes=len(lengths),
            n_shards=0,
            columns={name: list(arrays[name].shape[1:]) for name in steps},
            fingerprint="",
            reward=schema.REWARD,
            source=Source(),
        )
        arrays[schema.OFFSETS] = offsets
        arrays[schema.RETURN_TO_GO] = returns_to_go(arrays[schema.REWARD], offsets)
        return cls(_IN_MEMORY, record, arrays, item_states)

    def with_step_column(
        self, name: str, values: Array, return_to_go: ReturnToGo | None = None
    ) -> "Columns":
        """A copy in which step column `name` is `values`, (N,) or (N, size); files stay as is.

        Args:
            values: of all steps.
            return_to_go: what the returns-to-go count; None for what they counted before.
        """
        copy = self._copy(name, values.shape[1:], return_to_go)
        copy._arrays[name] = values
        return copy

    def with_observation_dimensions(self, kept: IntArray) -> "Columns":
        """A copy whose observations have only some dimensions, (K,) indices; files stay as is."""
        column = self._column(schema.OBSERVATION).of_dimensions(kept)
        copy = self._copy(schema.OBSERVATION, (len(kept),))
        copy._steps[schema.OBSERVATION] = column
        return copy

    def _copy(
        self, name: str, size: tuple[int, ...], return_to_go: ReturnToGo | None = None
    ) -> "Columns":
        """A copy with a step column that is not there yet, of the given size."""
        sizes = dict(self.record.columns)
        if name in sizes:
            sizes[name] = list(size)
        copy = Columns(
            self.path,
            self.record.copy_with(columns=sizes),
            self._arrays,
            self._item_states_in_memory,
            return_to_go or self.return_to_go,
        )
        copy._steps = {
            column_name: column
            for column_name, column in self._steps.items()
            if column_name != name
        }
        return copy

    @cached_property
    def starts(self) -> IntArray:
        """(E,) index of each episode's first step among the N steps of the store."""
        return self._starts_and_lengths[0]

    @cached_property
    def lengths(self) -> IntArray:
        """(E,) number of steps of each episode."""
        return self._starts_and_lengths[1]

    @cached_property
    def _starts_and_lengths(self) -> tuple[IntArray, IntArray]:
        starts, lengths, first_step = [], [], 0
        for offsets in self._parts(schema.OFFSETS):
            if len(offsets) < 2 or offsets[0] != 0 or np.any(offsets[1:] <= offsets[:-1]):
                raise self._damaged(schema.OFFSETS, "do not ascend from 0")
            starts.append(offsets[:-1] + first_step)
            lengths.append(np.diff(offsets))
            first_step += int(offsets[-1])
        counted = (sum(map(len, starts)), first_step)
        expected = (self.record.n_episodes, self.record.n_steps)
        if counted != expected:
            raise self._damaged(
                schema.OFFSETS,
                "have {} episodes of {} steps, not {} of {}".format(*counted, *expected),
            )
        return np.concatenate(starts), np.concatenate(lengths)

    @property
    def has_items(self) -> bool:
        """Whether actions are items of a catalogue; otherwise they are vectors."""
        return schema.ITEM in self.record.columns

    @property
    def observation_size(self) -> int:
        """O, size of the logged observation; 0 if none was logged."""
        return int((self.record.columns.get(schema.OBSERVATION) or [0])[0])

    @cached_property
    def item_states(self) -> ItemStates:
        """Builds states from items; for stores of items only.

        Raises:
            InputError: the file of item states is missing or damaged.
        """
        if self._item_states_in_memory is not None:
            return self._item_states_in_memory
        self._sealed.require(ITEM_STATES)
        return ItemStates.load(self.path / ITEM_STATES)

    @property
    def has_item_states(self) -> bool:
        """Whether the store has `item_states`, in memory or as a file."""
        return self._item_states_in_memory is not None or (self.path / ITEM_STATES).is_file()

    @cached_property
    def user_rows(self) -> IntArray:
        """(E,) row of each episode's user in the user features; −1 for an unknown user."""
        if self.item_states.user_features.shape[1] == 0:
            return np.full(self.record.n_episodes, -1)
        return self.episode_column(schema.USER)

    def has_episode_column(self, name: str) -> bool:
        """Whether the store has the episode column `name`."""
        files = [shard / f"{name}.npy" for shard in self._shards]
        return name in self._arrays or (bool(files) and all(file.is_file() for file in files))

    def episode_column(self, name: str) -> Array:
        """The whole episode column `name`, (E,).

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        parts = self._parts(name)
        if not parts:
            raise InputError(f"{self.path} has no column {name!r}; write the store with it")
        values = np.concatenate(parts)
        if len(values) != self.record.n_episodes:
            raise self._damaged(name, f"has {len(values)} of {self.record.n_episodes} episodes")
        if name == schema.SPLIT and np.any(values >= len(schema.SPLITS)):
            raise self._damaged(name, "has numbers that are not a split")
        return values

    def step_column(self, name: str) -> Array:
        """A copy of the whole step column `name`, (N,) or (N, size).

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        return self._column(name).take(np.arange(self.record.n_steps))

    def step_values(self, index: IntArray, *names: str) -> list[Array]:
        """Values of step columns at the step indices `index`.

        Args:
            index: indices among the N steps of the store, of any shape.

        Returns:
            For each name, values of the shape of `index`, followed by the size of a vector.

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        return [self._column(name).take(index) for name in names]

    def step_range(self, name: str, begin: int, end: int) -> Array:
        """Values of step column `name` from step `begin` of the store to before step `end`.

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        return self._column(name).between(begin, end)

    def states(self, episodes: IntArray, steps: IntArray) -> Tensor:
        """The logged states (without edits) before the given steps.

        Args:
            episodes: (B,) numbers in the store.
            steps: (B, K) steps of those episodes, consecutive in each row; may be below 0.

        Returns:
            (B, K, S) float32; undefined at steps below 0.
        """
        index = self.starts[episodes][:, None] + np.maximum(steps, 0)
        observations = torch.zeros(*steps.shape, 0)
        if self.observation_size:
            observations = torch.from_numpy(self._column(schema.OBSERVATION).take(index))
        if not self.has_items:
            return observations
        window = self.item_states.window
        # The histories of the K steps overlap: gather their K + window − 1 steps once.
        width = steps.shape[1] + window - 1
        history = steps[:, -1:] - np.arange(width, 0, -1)  # (B, width), the last is step end − 1
        history_index = np.maximum(index[:, -1:] - steps[:, -1:] + history, 0)
        valid = history >= 0
        items, rewards = self.step_values(history_index, schema.ITEM, schema.REWARD)
        items = np.where(valid, items, -1).astype(np.int64)
        rewards = np.where(valid, rewards, 0)
        return self.item_states.build(
            torch.from_numpy(items),
            torch.from_numpy(rewards.astype(np.float32)),
            torch.from_numpy(np.maximum(steps, 0)),
            torch.from_numpy(self.user_rows[episodes]),
            observations,
        )

    def _column(self, name: str) -> StepColumn:
        if name not in self._steps:
            if name not in (*self.record.columns, schema.RETURN_TO_GO):
                raise InputError(f"{self.path} has no column {name!r}; prepare the logs with it")
            column = StepColumn(self._parts(name, mmap=True))
            if len(column) != self.record.n_steps:
                raise self._damaged(name, f"has {len(column)} of {self.record.n_steps} steps")
            if name == schema.ITEM and name not in self._arrays:
                self._require_items(column)
            self._steps[name] = column
        return self._steps[name]

    def _parts(self, name: str, mmap: bool = False) -> list[Array]:
        """A column as one array per shard; a column in memory is a single array."""
        if name in self._arrays:
            return [self._arrays[name]]
        shape = tuple(self.record.columns.get(name, ()))
        return [
            load_column(self.path, f"{shard.name}/{name}.npy", shape, mmap, self._sealed)
            for shard in self._shards
        ]

    def _require_items(self, column: StepColumn) -> None:
        if not self.has_item_states:
            return
        low, high = column.range()
        items = len(self.item_states.embeddings)
        if not -1 <= low <= high < items:
            raise self._damaged(schema.ITEM, f"has items from {low} to {high}, there are {items}")

    def _damaged(self, name: str, fault: str) -> InputError:
        return InputError(f"{self.path} is damaged: column {name!r} {fault}; {StoreRecord.REMEDY}")
