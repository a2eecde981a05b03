"""Columns of a store, memory-mapped or in memory, and views of its episodes."""

from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.item_table import ITEM_STATES, OFFERS
from ucfrec.episodes.offers import Offer, Offers
from ucfrec.episodes.record import StoreRecord
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Steps, Transitions, Windows, draw_ends, list_earlier
from ucfrec.errors import InputError

_DTYPES = {
    schema.OFFSETS: "<i8",
    schema.RETURN_TO_GO: "<f4",
    **schema.STEP_DTYPES,
    **schema.EPISODE_DTYPES,
}
_BATCH_STEPS = 2**20


class StepColumn:
    """A step column, indexed across its shards."""

    def __init__(self, parts: list[Any], dimensions: IntArray | None = None) -> None:
        """Parts are one a shard, (M,) or (M, size); values have some `dimensions` of it, or all."""
        self.parts, self._dimensions = parts, dimensions
        self._bounds = np.cumsum([0] + [len(part) for part in parts])

    def __len__(self) -> int:
        return int(self._bounds[-1])

    def select_dimensions(self, dimensions: IntArray) -> "StepColumn":
        """The same column with some dimensions of those that it has, (K,) indices."""
        chosen = dimensions if self._dimensions is None else self._dimensions[dimensions]
        return StepColumn(self.parts, chosen)

    def take(self, index: IntArray) -> Array:
        """A copy of the values at the indices `index`, of any shape."""
        if len(self.parts) == 1:
            values = np.asarray(self.parts[0][index])
        else:
            shard = np.searchsorted(self._bounds[1:-1], index, side="right")
            first = self.parts[0]
            values = np.empty((*index.shape, *first.shape[1:]), dtype=first.dtype)
            for i, part in enumerate(self.parts):
                in_shard = shard == i
                values[in_shard] = part[index[in_shard] - self._bounds[i]]
        return values if self._dimensions is None else values[..., self._dimensions]


class Columns:
    """The columns of all E episodes of a store, numbered in its order, with N steps in total."""

    def __init__(
        self,
        path: Path,
        record: StoreRecord,
        arrays: Mapping[str, Array] | None = None,
        item_states: ItemStates | None = None,
    ) -> None:
        """Arrays are columns in memory, by name; they and `item_states` are used instead of the
        folder's files, of which none may be missing or have another size than when written."""
        self.path, self.record = path, record
        record.require(path)
        self._arrays = dict(arrays or {})
        if item_states is not None:
            self.item_states = item_states
        self._shards = [path / f"shard-{i:05d}" for i in range(record.n_shards)]
        self._steps: dict[str, StepColumn] = {}
        self.has_items = schema.ITEM in record.columns
        self.observation_size = int((record.columns.get(schema.OBSERVATION) or [0])[0])
        self.return_to_go = ReturnToGo()
        """What the returns-to-go count."""
        self.skipped: IntArray | None = None
        """(E,) first steps of each episode that are known but do not count; None for none."""

    def replace(
        self,
        name: str,
        column: StepColumn,
        **changes: Any,
    ) -> "Columns":
        """A copy with another step column and other attributes; files stay as they are."""
        copied = copy(self)
        vars(copied).update(changes, _steps={**self._steps, name: column})
        return copied

    @cached_property
    def starts(self) -> IntArray:
        """(E,) index of each episode's first step among the N steps of the store."""
        return np.cumsum(self.lengths) - self.lengths

    @cached_property
    def lengths(self) -> IntArray:
        """(E,) number of steps of each episode."""
        parts, record = self._parts(schema.OFFSETS), self.record
        for offsets in parts:
            if len(offsets) < 2 or offsets[0] != 0 or np.any(offsets[1:] <= offsets[:-1]):
                raise self._explain_damage(schema.OFFSETS, "do not ascend from 0")
        lengths = np.concatenate([np.diff(offsets) for offsets in parts])
        held, expected = (len(lengths), int(lengths.sum())), (record.n_episodes, record.n_steps)
        if held != expected:
            fault = f"have episodes and steps {held}, not {expected}"
            raise self._explain_damage(schema.OFFSETS, fault)
        return lengths

    @cached_property
    def item_states(self) -> ItemStates:
        """See `EpisodeView.item_states`."""
        self.record.require(self.path, ITEM_STATES)
        return ItemStates.load(self.path / ITEM_STATES)

    @cached_property
    def offers(self) -> Offers | None:
        """When items are available; None where all always are."""
        if not (self.path / OFFERS).is_file():
            return None
        self.record.require(self.path, OFFERS)
        return Offers.load(self.path / OFFERS, len(self.item_states.embeddings))

    @property
    def has_item_states(self) -> bool:
        """Whether the store has `item_states`, in memory or as a file."""
        return "item_states" in vars(self) or (self.path / ITEM_STATES).is_file()

    @cached_property
    def user_rows(self) -> IntArray:
        """(E,) row of each episode's user in the user features; −1 for an unknown user."""
        if self.item_states.user_features.shape[1] == 0:
            return np.full(self.record.n_episodes, -1)
        return self.episode_column(schema.USER)

    def has_episode_column(self, name: str) -> bool:
        """Whether the store has the episode column `name`."""
        if not self._shards:
            return name in self._arrays
        return all((shard / f"{name}.npy").is_file() for shard in self._shards)

    def episode_column(self, name: str) -> Array:
        """The whole episode column `name`, (E,); see `EpisodeView.episode_values`."""
        parts = self._parts(name)
        if not parts:
            raise InputError(f"{self.path} has no column {name!r}; write the store with it")
        values = np.concatenate(parts)
        if len(values) != self.record.n_episodes:
            fault = f"has {len(values)} of {self.record.n_episodes} episodes"
            raise self._explain_damage(name, fault)
        if name == schema.SPLIT and np.any(values >= len(schema.SPLITS)):
            raise self._explain_damage(name, "has numbers that are not a split")
        return values

    def step_column(self, name: str) -> StepColumn:
        """The step column `name`; see `EpisodeView.step_values`."""
        if name not in self._steps:
            if name not in (*self.record.columns, schema.RETURN_TO_GO):
                raise InputError(f"{self.path} has no column {name!r}; prepare the logs with it")
            column = StepColumn(self._parts(name, mmap=True))
            if len(column) != self.record.n_steps:
                fault = f"has {len(column)} of {self.record.n_steps} steps"
                raise self._explain_damage(name, fault)
            if name == schema.ITEM and name not in self._arrays and self.has_item_states:
                low = min(part.min() for part in column.parts)
                high = max(part.max() for part in column.parts)
                items = len(self.item_states.embeddings)
                if not -1 <= low <= high < items:
                    fault = f"has items from {low} to {high}, there are {items}"
                    raise self._explain_damage(name, fault)
            self._steps[name] = column
        return self._steps[name]

    def _parts(self, name: str, mmap: bool = False) -> list[Array]:
        """A column as one array per shard; a column in memory is a single array."""
        if name in self._arrays:
            return [self._arrays[name]]
        expected = np.dtype(_DTYPES[name]), tuple(self.record.columns.get(name, ()))
        parts = []
        for shard in self._shards:
            path = shard / f"{name}.npy"
            self.record.require(self.path, f"{shard.name}/{name}.npy")
            try:
                # Mapping compares the header with the size of the file before it takes memory.
                values: Array = np.load(path, mmap_mode="r")
                if (values.dtype, values.shape[1:]) != expected or values.ndim == 0:
                    raise ValueError(f"it holds {values.dtype} in the shape {values.shape}")
            except Exception as error:  # numpy parses headers as Python and raises what that raises
                what = f"{path} is missing or damaged ({str(error) or type(error).__name__})"
                raise InputError(f"{what}; {StoreRecord.REMEDY}") from None
            parts.append(values if mmap else np.array(values))
        return parts

    def states(self, episodes: IntArray, steps: IntArray) -> Tensor:
        """The states (B, K, S) before steps (B, K), consecutive in each row, of episodes with
        numbers (B,) in the store; of steps below 0, they are undefined.
        """
        index = self.starts[episodes][:, None] + np.maximum(steps, 0)
        observations = torch.zeros((*steps.shape, 0))
        if self.observation_size:
            observations = torch.from_numpy(self.step_column(schema.OBSERVATION).take(index))
        if not self.has_items:
            return observations
        window = self.item_states.window
        # The histories of the K steps overlap: gather their K + window − 1 steps once.
        width = steps.shape[1] + window - 1
        history = steps[:, -1:] - np.arange(width, 0, -1)  # (B, width), the last is step end − 1
        history_index = np.maximum(index[:, -1:] - steps[:, -1:] + history, 0)
        valid = history >= 0
        items, rewards = (
            self.step_column(name).take(history_index) for name in (schema.ITEM, schema.REWARD)
        )
        return self.item_states.build(
            torch.from_numpy(np.where(valid, items, -1).astype(np.int64)),
            torch.from_numpy(np.where(valid, rewards, 0).astype(np.float32)),
            torch.from_numpy(np.maximum(steps, 0)),
            torch.from_numpy(self.user_rows[episodes]),
            observations,
        )

    def _explain_damage(self, name: str, fault: str) -> InputError:
        return InputError(f"{self.path} is damaged: column {name!r} {fault}; {StoreRecord.REMEDY}")


class EpisodeView:
    """E episodes of a store. Wherever a method takes `episodes`, these are positions in the view,
    0 to E − 1."""

    def __init__(self, columns: Columns, episode_ids: IntArray | None = None) -> None:
        """Episodes have the numbers `episode_ids` (E,) in the store; None for all."""
        self._columns, self._selected = columns, episode_ids
        self.path, self.record = columns.path, columns.record
        """The store folder, and the content of its `meta.json`."""
        self.return_to_go = columns.return_to_go
        """What the returns-to-go count."""
        self.has_items = columns.has_items
        """Whether actions are items of a catalogue; otherwise they are vectors."""
        self.observation_size = columns.observation_size
        """O, size of the logged observation; 0 if none was logged."""

    def __repr__(self) -> str:
        facts = [f"{self.n_steps:,} steps", f"{len(self):,} episodes"]
        if self.has_items and self._columns.has_item_states:
            facts.append(f"{len(self.item_states.embeddings):,} items")
        facts.append(f"reward={self.record.reward}")
        if self._selected is not None:
            splits = np.unique(self.episode_values(schema.SPLIT))
            facts += [f"split={schema.SPLITS[split]}" for split in splits if len(splits) == 1]
        return f"{type(self).__name__}({', '.join(facts)})"

    def __len__(self) -> int:
        return self.n_episodes

    @cached_property
    def episode_ids(self) -> IntArray:
        """(E,) numbers in the store of the episodes of the view."""
        return np.arange(self.record.n_episodes) if self._selected is None else self._selected

    @cached_property
    def lengths(self) -> IntArray:
        """(E,) number of steps of each episode."""
        return self._columns.lengths[self.episode_ids]

    @cached_property
    def n_episodes(self) -> int:
        """E, the number of episodes of the view."""
        return len(self.episode_ids)

    @cached_property
    def n_steps(self) -> int:
        """Number of steps of the view."""
        return int(self._counts.sum())

    @cached_property
    def _counts(self) -> IntArray:
        """(E,) number of steps of each episode that count, which are its last."""
        if self._columns.skipped is None:
            return self.lengths
        return self.lengths - self._columns.skipped[self.episode_ids]

    @cached_property
    def _ends(self) -> IntArray:
        return np.cumsum(self._counts)

    @property
    def has_users(self) -> bool:
        """Whether the store names the user of every episode."""
        return self._columns.has_episode_column(schema.USER)

    @cached_property
    def item_states(self) -> ItemStates:
        """Builds states from items, in a store of items. InputError if their file is damaged."""
        return self._columns.item_states

    @property
    def state_size(self) -> int:
        """S, size of a state: that of the item state, if actions are items, plus O."""
        return self.observation_size + (self.item_states.size if self.has_items else 0)

    def episode_values(self, name: str) -> Array:
        """An episode column, (E,). InputError if the store lacks it or its files are damaged."""
        return self._columns.episode_column(name)[self.episode_ids]

    @property
    def terminated(self) -> BoolArray:
        """(E,) whether each session is known to have ended with its last step."""
        if not self._columns.has_episode_column(schema.TERMINATED):
            return np.ones(self.n_episodes, dtype=bool)
        return self.episode_values(schema.TERMINATED).astype(bool)

    @cached_property
    def returns(self) -> Float32Array:
        """(E,) undiscounted return of each episode, in reward units."""
        episodes = np.arange(self.n_episodes)
        return self.step_values(schema.RETURN_TO_GO, episodes, np.zeros_like(episodes))

    def step_values(
        self,
        name: str,
        episodes: IntArray,
        steps: IntArray,
    ) -> Array:
        """Values of a step column at steps (from 0) of episodes, two arrays whose shapes broadcast;
        of this shape, followed by the size of a vector. InputError if the store has no such column,
        or its files are damaged."""
        index = self._columns.starts[self.episode_ids[episodes]] + steps
        return self._columns.step_column(name).take(index)

    def items_at(self, episodes: IntArray, steps: IntArray) -> IntArray:
        """The int64 items of steps, as `step_values`; −1 for unknown ones."""
        return self.step_values(schema.ITEM, episodes, steps).astype(np.int64)

    @property
    def has_offers(self) -> bool:
        """Whether items come and go; otherwise all are always on offer."""
        offers = self._columns.offers
        return offers is not None and bool(offers.intervals.size)

    def offer(self, episodes: IntArray, steps: IntArray) -> Offer | None:
        """What was on offer at steps of episodes, as `step_values`; None for everything."""
        offers = self._columns.offers
        if offers is None:
            return None
        times, sets = self.step_values(schema.TIMESTAMP, episodes, steps), None
        if schema.CANDIDATES in self.record.columns:
            numbers = self.step_values(schema.CANDIDATES, episodes, steps)
            sets = torch.from_numpy(numbers.astype(np.int64))
        return offers.at(torch.from_numpy(times), sets)

    def rewards_before(self, episodes: IntArray, steps: IntArray) -> Float64Array:
        """(B,) sum of the rewards of sessions (B,) before steps (B,), in reward units."""
        owner, earlier_steps = list_earlier(steps)
        rewards = self.step_values(schema.REWARD, episodes[owner], earlier_steps)
        return np.bincount(owner, rewards, minlength=len(steps)).astype(np.float64)

    def all_steps(self) -> tuple[IntArray, IntArray]:
        """(episodes, steps), each (n_steps,): every step of the view, episode by episode."""
        episodes = np.repeat(np.arange(self.n_episodes), self._counts)
        return episodes, np.arange(self.n_steps) - (self._ends - self.lengths)[episodes]

    def step_batches(self, most: int | None = None) -> Iterator[tuple[IntArray, IntArray]]:
        """`all_steps` in batches, for views whose steps are too many to list."""
        size = most or _BATCH_STEPS
        for begin in range(0, self.n_steps, size):
            end = min(begin + size, self.n_steps)
            first, last = np.searchsorted(self._ends, (begin, end - 1), side="right")
            counts = np.diff(self._ends[first : last + 1].clip(max=end), prepend=begin)
            episodes = np.repeat(np.arange(first, last + 1), counts)
            starts = self._ends[episodes] - self.lengths[episodes]
            yield episodes, np.arange(begin, end) - starts

    def column(self, name: str) -> Array:
        """The values of a step column at `all_steps`, (n_steps,) or (n_steps, size)."""
        parts = [part for (part,) in self.column_batches(name)]
        return np.concatenate(parts) if parts else self.step_values(name, *self.all_steps())

    def column_batches(self, *names: str) -> Iterator[tuple[Array, ...]]:
        """Step columns at `all_steps`, some steps at a time."""
        for episodes, steps in self.step_batches():
            yield tuple(self.step_values(name, episodes, steps) for name in names)

    def item_counts(self) -> IntArray:
        """(n_items,) number of steps of the view that show each item; for stores of items only."""
        counts = np.zeros(len(self.item_states.embeddings), dtype=np.int64)
        for (items,) in self.column_batches(schema.ITEM):
            counts += np.bincount(items, minlength=len(counts))
        return counts

    def draw_steps(self, generator: np.random.Generator, count: int, length: int = 1) -> Steps:
        """Steps drawn uniformly, with replacement; or ends of windows of this `length` = K, such
        that of all equally likely windows a step is in K to 2K − 1, the last ones as well."""
        return draw_ends(generator, count, self._ends, self.lengths, length)

    def locate(self, numbers: IntArray) -> tuple[IntArray, IntArray]:
        """(episodes, steps) of the steps with the given indices in `all_steps`, of any shape."""
        episodes = np.searchsorted(self._ends, numbers, side="right")
        return episodes, numbers - (self._ends[episodes] - self.lengths[episodes])

    def action_vectors(self, actions: Tensor) -> Tensor:
        """Actions as vectors (..., A): the embeddings of items (...); vectors are unchanged."""
        return self.item_states.embeddings[actions] if self.has_items else actions

    def decision_starts(self, episodes: IntArray, steps: IntArray) -> IntArray:
        """First rows of the decisions that steps of episodes, of equal shapes, belong to."""
        if schema.PLACE not in self.record.columns:
            return steps
        # A split may cut a decision whose rows have several times.
        return np.maximum(steps - self.step_values(schema.PLACE, episodes, steps), 0)

    def items_above(
        self,
        episodes: IntArray,
        steps: IntArray,
        most: int | None = None,
    ) -> IntArray:
        """(B, P) items of the rows before steps (B,) in their own decisions, −1 where there are
        fewer: the first P = `most`, or all; P is 0 where decisions have one row."""
        if schema.PLACE not in self.record.columns:
            return np.zeros((len(steps), 0), dtype=np.int64)
        starts = self.decision_starts(episodes, steps)
        count = int((steps - starts).max(initial=0)) if most is None else most
        rows, last = starts[:, None] + np.arange(count), steps[:, None]
        items = self.step_values(schema.ITEM, episodes[:, None], np.minimum(rows, last))
        return np.where(rows < last, items, -1).astype(np.int64)

    def usual_list(self) -> int:
        """Mean number of rows of a decision, in whole rows; 1 or more."""
        if schema.PLACE not in self.record.columns:
            return 1
        decisions = sum(int((places == 0).sum()) for (places,) in self.column_batches(schema.PLACE))
        return max(1, round(self.n_steps / max(decisions, 1)))

    def decision_ends(self, episodes: IntArray, steps: IntArray) -> IntArray:
        """The steps (M,) after the decisions that steps (M,) of episodes (M,) belong to."""
        ends = steps + 1
        if schema.PLACE not in self.record.columns:
            return ends
        inside = np.flatnonzero(ends < self.lengths[episodes])
        while len(inside):
            places = self.step_values(schema.PLACE, episodes[inside], ends[inside])
            inside = inside[places > 0]
            ends[inside] += 1
            inside = inside[ends[inside] < self.lengths[episodes[inside]]]
        return ends

    def windows(
        self,
        episodes: IntArray,
        ends: IntArray,
        length: int,
    ) -> Windows:
        """Windows of `length` steps that end with step `ends[b]` (inclusive) of `episodes[b]`.

        Of a decision with several rows, the rows before that step are left out: the last column is
        the decision, with the step's own action and reward, after the steps before the decision.
        InputError if an episode or step does not exist, or the arguments have other shapes.

        Example: for an episode with rewards [5, 6, 7, 8], end 1 and length 3 give rewards
        [0, 5, 6], mask [false, true, true] and timesteps [0, 0, 1].

        Args:
            episodes: (B,) positions in the view.
            ends: (B,) last step of each window, from 0.
            length: K, at least 1; shorter episodes are padded on the left.
        """
        self._require_steps(episodes, ends, length)
        starts = self.decision_starts(episodes, ends)
        steps = starts[:, None] + np.arange(1 - length, 1)  # (B, K)
        action = schema.ITEM if self.has_items else schema.ACTION
        numbers, columns = self.episode_ids[episodes], self._columns
        index = columns.starts[numbers][:, None] + np.maximum(steps, 0)
        returns = torch.from_numpy(columns.step_column(schema.RETURN_TO_GO).take(index))
        states, decides = columns.states(numbers, steps), None
        if schema.PLACE in self.record.columns:
            places = columns.step_column(schema.PLACE).take(index)
            places[:, -1] = 0
            decides = torch.from_numpy(places == 0)
            index[:, -1] += ends - starts
        actions, rewards = (
            torch.from_numpy(columns.step_column(name).take(index))
            for name in (action, schema.REWARD)
        )
        if self.has_items:
            actions = actions.long()
        windows = Windows.of(torch.from_numpy(steps), states, actions, rewards, returns)
        offer, times = self.offer(episodes[:, None], steps.clip(min=0)), None
        if self.has_items and schema.TIMESTAMP in self.record.columns:
            times = torch.from_numpy(columns.step_column(schema.TIMESTAMP).take(index))
        return replace(windows, offer=offer, times=times, decides=decides)

    def transitions(self, episodes: IntArray, steps: IntArray) -> Transitions:
        """Single steps (M,) of episodes (M,), with their next states; errors as of `windows`."""
        window, ends = self.windows(episodes, steps, 1), self.decision_ends(episodes, steps)
        last = ends == self.lengths[episodes]
        next_steps = np.where(last, steps, ends)
        next_states = self._columns.states(self.episode_ids[episodes], next_steps[:, None])[:, 0]
        is_last = torch.from_numpy(last)
        return Transitions(
            states=window.states[:, 0],
            actions=self.action_vectors(window.actions[:, 0]),
            rewards=window.rewards[:, 0],
            next_states=next_states.masked_fill(is_last.unsqueeze(-1), 0.0),
            last=is_last,
        )

    def _require_steps(
        self,
        episodes: IntArray,
        ends: IntArray,
        length: int,
    ) -> None:
        if episodes.ndim != 1 or episodes.shape != ends.shape or length < 1:
            raise InputError(
                f"windows of {length} steps, episodes of shape {episodes.shape} and steps of shape "
                f"{ends.shape}: give two arrays of the same length, and at least 1 step"
            )
        if not np.all((episodes >= 0) & (episodes < self.n_episodes)):
            raise InputError(
                f"{self} has no episodes {episodes.min()} to {episodes.max()}; give positions from "
                f"0 to {self.n_episodes - 1}"
            )
        lengths = self.lengths[episodes]
        outside = np.flatnonzero((ends < 0) | (ends >= lengths))
        if len(outside):
            row = outside[0]
            raise InputError(
                f"episode {episodes[row]} has {lengths[row]} steps, none numbered {ends[row]}; "
                "steps are numbered from 0"
            )
