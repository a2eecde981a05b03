"""EpisodeStore: the episodes of a store folder, opened without reading and gathered in windows."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.columns import ITEM_STATES, Columns
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.view import EpisodeView
from ucfrec.episodes.windows import Overlay, Transitions, Windows
from ucfrec.episodes.writer import require_finite, require_steps, write_arrays
from ucfrec.errors import InputError

__all__ = ["ITEM_STATES", "EpisodeStore"]

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

_STATISTICS_STEPS = 1_000_000


class EpisodeStore(EpisodeView):
    """Episodes (user sessions, robot trajectories) of one store, or a view of some of them.

    A store is opened (`open`), written (`write`) or made in memory (`from_arrays`), and has a view
    of all its episodes; `split`, `select` and `with_overlay` make others.
    """

    @classmethod
    def open(cls, path: str | Path) -> "EpisodeStore":
        """Open a store folder; columns are memory-mapped, nothing is read yet.

        Raises:
            InputError: the folder is no store, is damaged, or a newer ucfrec wrote it.
        """
        return cls(Columns.open(Path(path)))

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
            reward: the expression that the rewards were computed by.
            source: what the store was made from.
            shard_steps: a shard ends with the episode that reaches so many steps.

        Raises:
            InputError: `path` exists, an episode has no steps, or rewards are not finite.
        """
        values = _with_split(episodes, lengths)
        write_arrays(path, steps, lengths, values, reward, source or {}, shard_steps)
        return cls.open(path)

    @classmethod
    def from_arrays(
        cls,
        steps: Mapping[str, Array],
        lengths: IntArray,
        episodes: Mapping[str, Array] | None = None,
        item_states: ItemStates | None = None,
    ) -> "EpisodeStore":
        """A store in memory, which lies in no folder.

        Args:
            steps: step columns of `ucfrec.schema`, each (N,) or (N, size).
            lengths: (E,) steps of each episode, at least one, adding up to N.
            episodes: episode columns, each (E,); without `split`, all are for training.
            item_states: how states are made, where `steps` has items.

        Raises:
            InputError: an episode has no steps, columns differ in length, or rewards are not
                finite.
        """
        lengths = require_steps("a store in memory", lengths)
        require_finite(steps[schema.REWARD])
        values = _with_split(episodes, lengths)
        return cls(Columns.from_arrays(steps, lengths, values, item_states))

    # Which episodes.

    def select(self, episodes: IntArray) -> "EpisodeStore":
        """A view of the episodes at the positions `episodes`, in that order.

        Raises:
            InputError: this view has edited copies.
        """
        self._require_no_copies("select from")
        return EpisodeStore(self._columns, self.episode_ids[episodes])

    def split(self, name: str) -> "EpisodeStore":
        """The view of one split's episodes, "train", "validation" or "test"; may be empty.

        Raises:
            InputError: there is no such split, or this view has edited copies.
        """
        if name not in schema.SPLITS:
            raise InputError(f"no split is called {name!r}; there are {', '.join(schema.SPLITS)}")
        self._require_no_copies("split")
        chosen = self.episode_values(schema.SPLIT) == schema.SPLITS.index(name)
        return self.select(np.flatnonzero(chosen))

    def with_overlay(self, overlay: Overlay) -> "EpisodeStore":
        """This view and, after its episodes, the edited copies of `overlay`.

        Raises:
            InputError: the copies are of other episodes or of other states than the store's.
        """
        source, size = overlay.copy_source, overlay.edit_state.shape[1]
        if len(source) and not 0 <= source.min() <= source.max() < self.meta["n_episodes"]:
            raise InputError(f"{overlay} has copies of episodes that {self.path} does not have")
        if size != self.state_size:
            raise InputError(
                f"{overlay} edits states of {size}; the store's have {self.state_size}"
            )
        joined = overlay if self.overlay is None else self.overlay.joined(overlay)
        return EpisodeStore(self._columns, self._chosen, joined)

    def without_copies(self) -> "EpisodeStore":
        """This view's episodes as they were logged."""
        return EpisodeStore(self._columns, self._chosen)

    def with_returns_to_go(self, values: FloatArray) -> "EpisodeStore":
        """This view with other returns-to-go, (n_steps,) in the order of `all_steps`.

        Raises:
            InputError: this view has edited copies.
        """
        self._require_no_copies("give other returns-to-go to")
        whole = self._columns.of_steps(schema.RETURN_TO_GO)
        episodes, steps = self.all_steps()
        whole[self._columns.starts[self._sources[episodes]] + steps] = values
        columns = self._columns.replaced(schema.RETURN_TO_GO, whole)
        return EpisodeStore(columns, self._chosen)

    def without_observed(self, dimensions: Sequence[int]) -> "EpisodeStore":
        """This view without some of the numbers that were observed.

        Args:
            dimensions: of the logged observation, each 0 to O − 1.

        Raises:
            InputError: this view has edited copies, whose states hold those numbers.
        """
        self._require_no_copies("leave observed numbers out of")
        kept = np.setdiff1d(np.arange(self.observation_size), dimensions)
        whole = self._columns.of_steps(schema.OBSERVATION)[:, kept]
        return EpisodeStore(self._columns.replaced(schema.OBSERVATION, whole), self._chosen)

    def _require_no_copies(self, what: str) -> None:
        if self.overlay is not None:
            raise InputError(
                f"{self} has edited copies; {what} its without_copies(), and lay copies over that "
                "by with_overlay"
            )

    # Gathering.

    def windows(self, episodes: IntArray, ends: IntArray, length: int) -> Windows:
        """Windows of the `length` steps up to and with step `ends[b]` of episode `episodes[b]`.

        Example: for an episode with rewards [5, 6, 7, 8], end 1 and length 3 give rewards
        [0, 5, 6], mask [false, true, true] and timesteps [0, 0, 1].

        Args:
            episodes: (B,) positions in the view.
            ends: (B,) last step of each window.
            length: K, at least 1.

        Raises:
            InputError: there is no such step, or the arguments have other shapes.
        """
        self._require_steps(episodes, ends, length)
        steps = ends[:, None] + np.arange(1 - length, 1)  # (B, K)
        mask = steps >= 0
        index = self._columns.starts[self._sources[episodes]][:, None] + np.maximum(steps, 0)
        valid = torch.from_numpy(mask)

        def gather(name: str) -> Tensor:
            values = torch.from_numpy(self._columns.at(name, index))
            shape = (*valid.shape, *([1] * (values.ndim - valid.ndim)))
            return values.masked_fill(~valid.view(shape), 0)

        return Windows(
            states=self._edited_states(episodes, steps).masked_fill(~valid.unsqueeze(-1), 0.0),
            actions=gather(schema.ITEM).long() if self.has_items else gather(schema.ACTION),
            rewards=gather(schema.REWARD),
            returns_to_go=gather(schema.RETURN_TO_GO),
            timesteps=torch.from_numpy(np.maximum(steps, 0)),
            mask=valid,
        )

    def transitions(self, episodes: IntArray, steps: IntArray) -> Transitions:
        """Single steps of the view, with factual successors.

        Args:
            episodes: (M,) positions in the view.
            steps: (M,) of those episodes.

        Raises:
            InputError: there is no such step, or the arguments have other shapes.
        """
        window = self.windows(episodes, steps, 1)
        last = steps == self.lengths[episodes] - 1
        next_steps = np.where(last, steps, steps + 1)
        next_states = self._columns.states(self._sources[episodes], next_steps[:, None])[:, 0]
        ended = torch.from_numpy(last)
        return Transitions(
            states=window.states[:, 0],
            actions=self.action_vectors(window.actions[:, 0]),
            rewards=window.rewards[:, 0],
            next_states=next_states.masked_fill(ended.unsqueeze(-1), 0.0),
            last=ended,
        )

    @cached_property
    def state_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, each (S,), of the view's states; of at most a million."""
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

    def _edited_states(self, episodes: IntArray, steps: IntArray) -> Tensor:
        """States (B, K, S) at `steps` (B, K), edits applied; undefined where a step is below 0."""
        states = self._columns.states(self._sources[episodes], steps)
        if self.overlay is not None:
            copies = episodes[:, None] - len(self.episode_ids)
            rows, columns, edits = self.overlay.edits_at(copies, steps)
            states[rows, columns] = torch.from_numpy(self.overlay.edit_state[edits])
        return states


def _with_split(episodes: Mapping[str, Array] | None, lengths: IntArray) -> dict[str, Array]:
    return {schema.SPLIT: np.zeros(len(lengths), dtype=np.uint8), **(episodes or {})}
