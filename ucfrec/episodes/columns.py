"""The columns of a store: memory-mapped from its folder, or arrays in memory."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.returns import returns_to_go
from ucfrec.episodes.states import ItemStates
from ucfrec.errors import InputError
from ucfrec.files import read_json

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]

ITEM_STATES = "item_states.safetensors"
_OFFSETS = "offsets"
_IN_MEMORY = Path("<memory>")


class Columns:
    """All episodes of one store, E in number, with N steps together.

    Episodes go by their number in the store here, 0 to E − 1, whichever view looks at them.
    """

    def __init__(
        self,
        path: Path,
        meta: Mapping[str, Any],
        arrays: Mapping[str, Array] | None = None,
        item_states: ItemStates | None = None,
    ) -> None:
        """Args:
        path: folder of the store.
        meta: contents of its `meta.json`.
        arrays: whole columns in memory that stand for those of the folder.
        item_states: likewise.
        """
        self.path, self.meta = path, meta
        self._arrays, self._given_states = dict(arrays or {}), item_states
        self._shards = [path / f"shard-{i:05d}" for i in range(meta["n_shards"])]
        self._steps: dict[str, _StepColumn] = {}

    @classmethod
    def open(cls, path: Path) -> "Columns":
        """Those of a store folder; nothing but `meta.json` is read yet.

        Raises:
            InputError: the folder is no store, is damaged, or a newer ucfrec wrote it.
        """
        if not (path / "meta.json").is_file():
            raise InputError(f"{path} is not an episode store: it has no meta.json")
        meta = read_json(path / "meta.json")
        version = meta.get("version") if isinstance(meta, dict) else None
        if not isinstance(version, int):
            raise InputError(f"{path / 'meta.json'} is not that of an episode store")
        if version > schema.STORE_VERSION:
            raise InputError(
                f"{path} has store version {version}, this ucfrec reads up to "
                f"{schema.STORE_VERSION}; upgrade ucfrec"
            )
        return cls(path, meta)

    @classmethod
    def from_arrays(
        cls,
        steps: Mapping[str, Array],
        lengths: IntArray,
        episodes: Mapping[str, Array],
        item_states: ItemStates | None,
    ) -> "Columns":
        """See `EpisodeStore.from_arrays`."""
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        arrays = {name: np.asarray(v, dtype=schema.STEP_DTYPES[name]) for name, v in steps.items()}
        arrays |= {
            name: np.asarray(v, dtype=schema.EPISODE_DTYPES[name]) for name, v in episodes.items()
        }
        for name, values in arrays.items():
            wanted = int(offsets[-1]) if name in steps else len(lengths)
            if len(values) != wanted:
                raise InputError(f"column {name!r} has {len(values)} values instead of {wanted}")
        meta = {
            "version": schema.STORE_VERSION,
            "n_steps": int(offsets[-1]),
            "n_episodes": len(lengths),
            "n_shards": 0,
            "columns": {name: list(arrays[name].shape[1:]) for name in steps},
            "reward": schema.REWARD,
            "source": {},
        }
        arrays[_OFFSETS] = offsets
        arrays[schema.RETURN_TO_GO] = returns_to_go(arrays[schema.REWARD], offsets)
        return cls(_IN_MEMORY, meta, arrays, item_states)

    def replaced(self, name: str, values: Array) -> "Columns":
        """The same columns but for one step column, which is `values` (N,) or (N, size)."""
        sizes = dict(self.meta["columns"])
        if name in sizes:
            sizes[name] = list(values.shape[1:])
        others = Columns(
            self.path,
            {**self.meta, "columns": sizes},
            {**self._arrays, name: values},
            self._given_states,
        )
        others._steps = {other: column for other, column in self._steps.items() if other != name}
        return others

    @cached_property
    def starts(self) -> IntArray:
        """(E,) place of each episode's first step among the N."""
        return self._starts_and_lengths[0]

    @cached_property
    def lengths(self) -> IntArray:
        """(E,) steps of each episode."""
        return self._starts_and_lengths[1]

    @cached_property
    def _starts_and_lengths(self) -> tuple[IntArray, IntArray]:
        starts, lengths, before = [], [], 0
        for offsets in self._parts(_OFFSETS):
            starts.append(offsets[:-1] + before)
            lengths.append(np.diff(offsets))
            before += int(offsets[-1])
        return np.concatenate(starts), np.concatenate(lengths)

    @property
    def has_items(self) -> bool:
        """Whether actions are items of a catalogue; otherwise they are vectors."""
        return schema.ITEM in self.meta["columns"]

    @property
    def observation_size(self) -> int:
        """O, size of the logged observation; 0 where none was logged."""
        return int((self.meta["columns"].get(schema.OBSERVATION) or [0])[0])

    @cached_property
    def item_states(self) -> ItemStates:
        """How states are made of items (stores of items only)."""
        return self._given_states or ItemStates.load(self.path / ITEM_STATES)

    @property
    def knows_items(self) -> bool:
        """Whether `item_states` is at hand."""
        return self._given_states is not None or (self.path / ITEM_STATES).is_file()

    @cached_property
    def user_rows(self) -> IntArray:
        """(E,) row of each episode's user among the user features; −1 where nothing is known."""
        if self.item_states.user_features.shape[1] == 0:
            return np.full(self.meta["n_episodes"], -1)
        return self.of_episodes(schema.USER)

    def of_episodes(self, name: str) -> Array:
        """One episode column, (E,)."""
        parts = self._parts(name)
        if not parts:
            raise InputError(f"{self.path} has no column {name!r}")
        return np.concatenate(parts)

    def of_steps(self, name: str) -> Array:
        """One step column as an array of its own, (N,) or (N, size)."""
        return self._column(name).take(np.arange(self.meta["n_steps"]))

    def at(self, name: str, index: IntArray) -> Array:
        """One step column at places `index` among the N, any shape.

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        return self._column(name).take(index)

    def states(self, episodes: IntArray, steps: IntArray) -> Tensor:
        """States (B, K, S) as they were logged.

        Args:
            episodes: (B,).
            steps: (B, K), consecutive in a row; what stands where a step is below 0 is undefined.
        """
        index = self.starts[episodes][:, None] + np.maximum(steps, 0)
        observed = torch.zeros(*steps.shape, 0)
        if self.observation_size:
            observed = torch.from_numpy(self.at(schema.OBSERVATION, index))
        if not self.has_items:
            return observed
        back = self.item_states.window
        # The K windows of history overlap: gather K + back − 1 steps once, then look through a
        # sliding view, most recent first.
        width = steps.shape[1] + back - 1
        history = steps[:, -1:] - np.arange(width, 0, -1)  # (B, K + back − 1), up to step end − 1
        at = np.maximum(index[:, -1:] - steps[:, -1:] + history, 0)
        items = np.where(history >= 0, self.at(schema.ITEM, at), -1).astype(np.int64)
        rewards = np.where(history >= 0, self.at(schema.REWARD, at), 0)
        view = np.lib.stride_tricks.sliding_window_view
        users = self.user_rows[episodes][:, None]
        return self.item_states.build(
            torch.from_numpy(view(items, back, axis=1)[..., ::-1].copy()),
            torch.from_numpy(view(rewards, back, axis=1)[..., ::-1].astype(np.float32)),
            torch.from_numpy(np.maximum(steps, 0)),
            torch.from_numpy(np.broadcast_to(users, steps.shape).copy()),
            observed,
        )

    def _column(self, name: str) -> "_StepColumn":
        if name not in self._steps:
            if name not in (*self.meta["columns"], schema.RETURN_TO_GO):
                raise InputError(f"{self.path} has no column {name!r}; prepare the logs with it")
            column = _StepColumn(self._parts(name, mmap=True))
            if len(column) != self.meta["n_steps"]:
                raise InputError(
                    f"{self.path} is damaged: column {name!r} has {len(column)} of "
                    f"{self.meta['n_steps']} steps; prepare it again"
                )
            self._steps[name] = column
        return self._steps[name]

    def _parts(self, name: str, mmap: bool = False) -> list[Array]:
        """A column shard by shard; one in memory is one part."""
        if name in self._arrays:
            return [self._arrays[name]]
        return [_load(shard / f"{name}.npy", mmap) for shard in self._shards]


class _StepColumn:
    """One step column over all shards."""

    def __init__(self, parts: list[Array]) -> None:
        self._parts = parts
        self._bounds = np.cumsum([0] + [len(part) for part in self._parts])

    def __len__(self) -> int:
        return int(self._bounds[-1])

    def take(self, index: IntArray) -> Array:
        """Values at places `index`, any shape, as an array of their own."""
        if len(self._parts) == 1:
            return np.asarray(self._parts[0][index])
        shard = np.searchsorted(self._bounds[1:-1], index, side="right")
        like = self._parts[0]
        values = np.empty((*index.shape, *like.shape[1:]), dtype=like.dtype)
        for i, part in enumerate(self._parts):
            here = shard == i
            values[here] = part[index[here] - self._bounds[i]]
        return values


def _load(path: Path, mmap: bool) -> Array:
    try:
        values: Array = np.load(path, mmap_mode="r" if mmap else None)
    except (OSError, ValueError, EOFError) as error:
        message = str(error).splitlines()[0]
        raise InputError(f"{path} is missing or damaged ({message}); prepare it again") from None
    return values
