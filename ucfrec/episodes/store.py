"""EpisodeStore: every episode, on disk, opened for nothing and gathered in windows."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Overlay, Transitions, Windows
from ucfrec.episodes.writer import StoreWriter
from ucfrec.errors import InputError
from ucfrec.files import atomic_folder, read_json

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

ITEM_STATES = "item_states.safetensors"
_STATISTICS_STEPS = 1_000_000


class EpisodeStore:
    """Episodes (user sessions, robot trajectories) of one store folder, or a view of some of them.

    Positions among `episode_ids`, and after them the copies of the overlay, number the episodes of
    a view; `episodes` arguments are such positions.
    """

    def __init__(self, path: Path, meta: Mapping[str, Any], overlay: Overlay | None = None) -> None:
        self.path = path
        self.meta = meta
        self.overlay = overlay
        self._shards = [path / f"shard-{i:05d}" for i in range(meta["n_shards"])]
        self._selection: IntArray | None = None
        self._columns: dict[str, _Column] = {}

    @classmethod
    def open(cls, path: str | Path) -> "EpisodeStore":
        """Open a store folder; columns are memory-mapped, nothing is read yet.

        Raises:
            InputError: the folder is no store, is damaged, or a newer ucfrec wrote it.
        """
        path = Path(path)
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
    def write(
        cls,
        path: Path,
        steps: Mapping[str, Array],
        lengths: IntArray,
        episodes: Mapping[str, Array] | None = None,
        reward: str = schema.REWARD,
        source: Mapping[str, Any] | None = None,
        shard_steps: int = 2**24,
    ) -> "EpisodeStore":
        """Write a store from arrays in memory, atomically.

        Args:
            steps: step columns of `ucfrec.schema`, each (N,) or (N, size).
            lengths: (E,) steps of each episode, at least one, adding up to N.
            episodes: episode columns, each (E,); without `split`, all are for training.

        Raises:
            InputError: `path` exists, an episode has no steps, or rewards are not finite.
        """
        if np.any(np.asarray(lengths) < 1):
            raise InputError(f"{path}: an episode without steps cannot be stored; leave it out")
        first = np.zeros(int(np.sum(lengths)), dtype=bool)
        first[np.cumsum(lengths) - lengths] = True
        values = {schema.SPLIT: np.zeros(len(lengths), dtype=np.uint8), **(episodes or {})}
        with atomic_folder(path) as scratch:
            writer = StoreWriter(scratch, shard_steps)
            writer.append(steps, first, {k: np.repeat(v, lengths) for k, v in values.items()})
            writer.finish(reward=reward, source=source or {})
        return cls.open(path)

    # Which episodes.

    @cached_property
    def _offsets(self) -> tuple[IntArray, IntArray]:
        """First step and length of each base episode, (E,) each."""
        starts, lengths, before = [], [], 0
        for shard in self._shards:
            offsets = _load(shard / "offsets.npy")
            starts.append(offsets[:-1] + before)
            lengths.append(np.diff(offsets))
            before += int(offsets[-1])
        return np.concatenate(starts), np.concatenate(lengths)

    @cached_property
    def episode_ids(self) -> IntArray:
        """(E,) base numbers of the view's episodes, copies not among them."""
        if self._selection is not None:
            return self._selection
        return np.arange(self.meta["n_episodes"])

    @cached_property
    def _base_ids(self) -> IntArray:
        """(E + C,) base number behind every episode of the view, copies after the rest."""
        if self.overlay is None:
            return self.episode_ids
        return np.concatenate([self.episode_ids, self.overlay.copy_source])

    @cached_property
    def lengths(self) -> IntArray:
        """(E + C,) steps of each episode."""
        return self._offsets[1][self._base_ids]

    @property
    def n_episodes(self) -> int:
        """Episodes of the view, copies among them."""
        return len(self._base_ids)

    @cached_property
    def n_steps(self) -> int:
        """Steps of the view, those of copies among them."""
        return int(self.lengths.sum())

    def __len__(self) -> int:
        return self.n_episodes

    def select(self, episodes: IntArray) -> "EpisodeStore":
        """A view of some base episodes, without an overlay."""
        view = EpisodeStore(self.path, self.meta)
        view._selection = self.episode_ids[episodes]
        view._columns = self._columns
        return view

    def split(self, name: str) -> "EpisodeStore":
        """The view of one split's base episodes, "train", "validation" or "test"; may be empty."""
        splits = self.episode_values(schema.SPLIT)[: len(self.episode_ids)]
        return self.select(np.flatnonzero(splits == schema.SPLITS.index(name)))

    def with_overlay(self, overlay: Overlay) -> "EpisodeStore":
        """The union of this view and the edited copies of `overlay`."""
        view = EpisodeStore(self.path, self.meta, overlay)
        view._selection = self.episode_ids
        view._columns = self._columns
        return view

    def with_returns_to_go(self, values: FloatArray) -> "EpisodeStore":
        """This view with other returns-to-go, (n_steps,) in the order of `all_steps`; no copies."""
        whole = self._column(schema.RETURN_TO_GO).take(np.arange(self.meta["n_steps"]))
        base = self.select(np.arange(len(self.episode_ids)))
        starts, steps = base._offsets[0][base._base_ids], base.all_steps()[1]
        whole[np.repeat(starts, base.lengths) + steps] = values
        base._columns = {**self._columns, schema.RETURN_TO_GO: _Column([whole])}
        return base

    def without_observed(self, dimensions: Sequence[int]) -> "EpisodeStore":
        """This view without some of the numbers that were observed; no copies.

        Args:
            dimensions: of the logged observation.
        """
        kept = np.setdiff1d(np.arange(self.observation_size), dimensions)
        whole = self._column(schema.OBSERVATION).take(np.arange(self.meta["n_steps"]))[:, kept]
        columns = {**self.meta["columns"], schema.OBSERVATION: [len(kept)]}
        view = EpisodeStore(self.path, {**self.meta, "columns": columns})
        view._selection = self.episode_ids
        view._columns = {**self._columns, schema.OBSERVATION: _Column([whole])}
        return view

    # What they hold.

    @property
    def has_items(self) -> bool:
        """Whether actions are items of a catalogue; otherwise they are vectors."""
        return schema.ITEM in self.meta["columns"]

    @cached_property
    def item_states(self) -> ItemStates:
        """How states are made of items (stores of items only)."""
        return ItemStates.load(self.path / ITEM_STATES)

    @property
    def observation_size(self) -> int:
        """Size of the logged observation; 0 where none was logged."""
        return int((self.meta["columns"].get(schema.OBSERVATION) or [0])[0])

    @property
    def state_size(self) -> int:
        """S."""
        return self.observation_size + (self.item_states.size if self.has_items else 0)

    def episode_values(self, name: str) -> Array:
        """One episode column, (E + C,); copies have their source's values."""
        return self._of_episodes(name)[self._base_ids]

    def _of_episodes(self, name: str) -> Array:
        return np.concatenate([_load(shard / f"{name}.npy") for shard in self._shards])

    @cached_property
    def returns(self) -> FloatArray:
        """(E + C,) return of each episode."""
        return self._column(schema.RETURN_TO_GO).take(self._offsets[0][self._base_ids])

    def step_values(self, name: str, episodes: IntArray, steps: IntArray) -> Array:
        """One step column at the given steps of the given episodes; arrays broadcast."""
        return self._column(name).take(self._offsets[0][self._base_ids[episodes]] + steps)

    def all_steps(self) -> tuple[IntArray, IntArray]:
        """(episodes, steps) of every step of the view, in order."""
        episodes = np.repeat(np.arange(self.n_episodes), self.lengths)
        starts = np.cumsum(self.lengths) - self.lengths
        return episodes, np.arange(self.n_steps) - np.repeat(starts, self.lengths)

    @cached_property
    def _ends(self) -> IntArray:
        return np.cumsum(self.lengths)

    def draw_steps(self, generator: np.random.Generator, count: int) -> tuple[IntArray, IntArray]:
        """`count` (episodes, steps) drawn uniformly over the steps of the view."""
        return self.locate(generator.integers(self.n_steps, size=count))

    def locate(self, numbers: IntArray) -> tuple[IntArray, IntArray]:
        """(episodes, steps) of steps numbered 0 to n_steps − 1 through the view."""
        episodes = np.searchsorted(self._ends, numbers, side="right")
        return episodes, numbers - (self._ends[episodes] - self.lengths[episodes])

    # Gathering.

    def windows(self, episodes: IntArray, ends: IntArray, length: int) -> Windows:
        """Windows of the `length` steps up to and with step `ends[b]` of episode `episodes[b]`.

        Example: for an episode with rewards [5, 6, 7, 8], end 1 and length 3 give rewards
        [0, 5, 6], mask [false, true, true] and timesteps [0, 0, 1].

        Args:
            episodes: (B,) positions in the view.
            ends: (B,) last step of each window.
            length: K.
        """
        steps = ends[:, None] + np.arange(1 - length, 1)  # (B, K)
        mask = steps >= 0
        index = self._offsets[0][self._base_ids[episodes]][:, None] + np.maximum(steps, 0)
        there = torch.from_numpy(mask)

        def gather(name: str) -> Tensor:
            values = torch.from_numpy(self._column(name).take(index))
            shape = (*there.shape, *([1] * (values.ndim - there.ndim)))
            return values.masked_fill(~there.view(shape), 0)

        return Windows(
            states=self._edited_states(episodes, steps).masked_fill(~there.unsqueeze(-1), 0.0),
            actions=gather(schema.ITEM).long() if self.has_items else gather(schema.ACTION),
            rewards=gather(schema.REWARD),
            returns_to_go=gather(schema.RETURN_TO_GO),
            timesteps=torch.from_numpy(np.maximum(steps, 0)),
            mask=there,
        )

    def transitions(self, episodes: IntArray, steps: IntArray) -> Transitions:
        """Single steps (M,) of the view, with factual successors."""
        window = self.windows(episodes, steps, 1)
        last = steps == self.lengths[episodes] - 1
        following = np.where(last, steps, steps + 1)
        next_states = self._factual_states(episodes, following[:, None])[:, 0]
        ended = torch.from_numpy(last)
        return Transitions(
            states=window.states[:, 0],
            actions=self.action_vectors(window.actions[:, 0]),
            rewards=window.rewards[:, 0],
            next_states=next_states.masked_fill(ended.unsqueeze(-1), 0.0),
            last=ended,
        )

    def action_vectors(self, actions: Tensor) -> Tensor:
        """Actions as vectors (..., A): items as their embeddings, vectors as they are."""
        return self.item_states.embeddings[actions] if self.has_items else actions

    @cached_property
    def state_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (S,) of the view's states, from at most a million steps."""
        episodes, steps = self.all_steps()
        stride = -(-len(steps) // _STATISTICS_STEPS)
        total = torch.zeros(self.state_size, dtype=torch.float64)
        squares, count = total.clone(), 0
        for chunk in range(0, len(steps), stride * 8192):
            part = slice(chunk, chunk + stride * 8192, stride)
            states = self.windows(episodes[part], steps[part], 1).states[:, 0].double()
            total, squares = total + states.sum(0), squares + states.square().sum(0)
            count += len(states)
        mean = total / count
        variance = (squares / count - mean.square()).clamp(min=0)
        return mean.float(), variance.sqrt().float()

    def _factual_states(self, episodes: IntArray, steps: IntArray) -> Tensor:
        """States (B, K, S) at `steps` (B, K) as they were logged; anything where step < 0."""
        index = self._offsets[0][self._base_ids[episodes]][:, None] + np.maximum(steps, 0)
        observed = torch.zeros(*steps.shape, 0)
        if self.observation_size:
            observed = torch.from_numpy(self._column(schema.OBSERVATION).take(index))
        return self._from_items(episodes, steps, index, observed) if self.has_items else observed

    def _edited_states(self, episodes: IntArray, steps: IntArray) -> Tensor:
        """The same with the edits of the overlay applied."""
        states = self._factual_states(episodes, steps)
        if self.overlay is None:
            return states
        rows, columns, edits = self._edits_at(episodes, steps)
        states[rows, columns] = torch.from_numpy(self.overlay.edit_state[edits])
        return states

    def _from_items(
        self, episodes: IntArray, steps: IntArray, index: IntArray, observed: Tensor
    ) -> Tensor:
        back = self.item_states.window
        # The K windows of history overlap: gather K + back − 1 steps once, then look through a
        # sliding view, most recent first.
        width = steps.shape[1] + back - 1
        history = steps[:, -1:] - np.arange(width, 0, -1)  # (B, K + back − 1), up to step end − 1
        at = np.maximum(index[:, -1:] - steps[:, -1:] + history, 0)
        items = np.where(history >= 0, self._column(schema.ITEM).take(at), -1).astype(np.int64)
        rewards = np.where(history >= 0, self._column(schema.REWARD).take(at), 0)
        view = np.lib.stride_tricks.sliding_window_view
        users = self.user_rows[self._base_ids[episodes]][:, None]
        return self.item_states.build(
            torch.from_numpy(view(items, back, axis=1)[..., ::-1].copy()),
            torch.from_numpy(view(rewards, back, axis=1)[..., ::-1].astype(np.float32)),
            torch.from_numpy(np.maximum(steps, 0)),
            torch.from_numpy(np.broadcast_to(users, steps.shape).copy()),
            observed,
        )

    @cached_property
    def user_rows(self) -> IntArray:
        """(base episodes,) row of each episode's user among the user features; −1 without any."""
        if self.item_states.user_features.shape[1] == 0:
            return np.full(self.meta["n_episodes"], -1)
        return self._of_episodes(schema.USER)

    @cached_property
    def _edit_keys(self) -> IntArray:
        """(M + 1,) one increasing number an edit, and one at the end that nothing reaches."""
        assert self.overlay is not None
        keys = self.overlay.edit_copy * self._stride + self.overlay.edit_step
        return np.append(keys, np.iinfo(np.int64).max)

    @cached_property
    def _stride(self) -> int:
        return int(self._offsets[1].max()) + 1

    def _edits_at(self, episodes: IntArray, steps: IntArray) -> tuple[Array, Array, Array]:
        """Rows and columns of `steps` (B, K) that are edited, and the edits' numbers."""
        copies = np.asarray(episodes)[:, None] - len(self.episode_ids)
        wanted = np.where((copies >= 0) & (steps >= 0), copies * self._stride + steps, -1)
        found = np.searchsorted(self._edit_keys, wanted)
        rows, columns = np.nonzero(self._edit_keys[found] == wanted)
        return rows, columns, found[rows, columns]

    def _column(self, name: str) -> "_Column":
        if name not in self._columns:
            if name not in (*self.meta["columns"], schema.RETURN_TO_GO):
                raise InputError(f"{self.path} has no column {name!r}; prepare the logs with it")
            column = _Column([_load(s / f"{name}.npy", mmap=True) for s in self._shards])
            if len(column) != self.meta["n_steps"]:
                raise InputError(
                    f"{self.path} is damaged: column {name!r} has {len(column)} of "
                    f"{self.meta['n_steps']} steps; prepare it again"
                )
            self._columns[name] = column
        return self._columns[name]


class _Column:
    """One column over all shards, memory-mapped unless made in memory."""

    def __init__(self, parts: list[Array]) -> None:
        self._parts = parts
        self._bounds = np.cumsum([0] + [len(part) for part in self._parts])

    def __len__(self) -> int:
        return int(self._bounds[-1])

    def take(self, index: IntArray) -> Array:
        """Values at global positions `index`, any shape, as an array of their own."""
        if len(self._parts) == 1:
            return np.asarray(self._parts[0][index])
        shard = np.searchsorted(self._bounds[1:-1], index, side="right")
        like = self._parts[0]
        values = np.empty((*index.shape, *like.shape[1:]), dtype=like.dtype)
        for i, part in enumerate(self._parts):
            here = shard == i
            values[here] = part[index[here] - self._bounds[i]]
        return values


def _load(path: Path, mmap: bool = False) -> Array:
    try:
        values: Array = np.load(path, mmap_mode="r" if mmap else None)
    except (OSError, ValueError, EOFError) as error:
        message = str(error).splitlines()[0]
        raise InputError(f"{path} is missing or damaged ({message}); prepare it again") from None
    return values
