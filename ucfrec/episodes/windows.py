"""What policies read: windows of a store, of running sessions and of augmented episodes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.states import ItemStates
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore

Steps = tuple[IntArray, IntArray]  # episodes (M,) and steps (M,) of them
AUGMENTED = "augmented.safetensors"
"""Name of the file of a run."""


@dataclass(frozen=True)
class _Rows:
    """Tensors with a row for each of B things."""

    def _change(self, change: Callable[[Tensor], Tensor]) -> Self:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changed: dict[str, Any] = {
            name: value.change(change) if isinstance(value, Offer) else change(value)
            for name, value in values.items()
            if value is not None
        }
        return replace(self, **changed)

    def at(self, rows: slice | IntArray | Tensor) -> Self:
        """The rows with the given numbers."""
        return self._change(lambda values: values[rows])

    def to(self, device: torch.device) -> Self:
        """A copy on `device`."""
        return self._change(lambda values: values.to(device, non_blocking=True))


@dataclass(frozen=True)
class Windows(_Rows):
    """B windows of K steps, padded on the left; at padding `mask` is false, and all values but
    times and offers are 0."""

    states: Tensor
    """(B, K, S) float32."""
    actions: Tensor
    """(B, K, A) float32 vectors, or (B, K) int64 items."""
    rewards: Tensor
    """(B, K) float32, in reward units."""
    returns_to_go: Tensor
    """(B, K) float32 undiscounted Ĝ_t, in reward units."""
    timesteps: Tensor
    """(B, K) int64 number of the step in its episode, from 0."""
    mask: Tensor
    """(B, K) bool, true at steps of the episode, false at padding."""
    offer: Offer | None = None
    """What was on offer at each of the (B, K) steps; None for everything."""
    times: Tensor | None = None
    """(B, K) int64 ms of the steps; None where items are not known by time."""
    decides: Tensor | None = None
    """(B, K) bool, false where a step is a later row of a decision with several; None for true."""

    @property
    def decided(self) -> Tensor:
        """(B, K) bool, the steps whose actions are predicted: first rows of decisions."""
        return self.mask if self.decides is None else self.mask & self.decides

    @classmethod
    def of(
        cls,
        numbers: Tensor,
        states: Tensor,
        actions: Tensor,
        rewards: Tensor,
        returns_to_go: Tensor | None = None,
    ) -> "Windows":
        """Windows of steps with `numbers` (B, K) int64 in their episodes, below 0 at padding, where
        all becomes 0. Without returns-to-go, a decision sets them."""
        mask = numbers >= 0
        padding = ~mask

        def kept(values: Tensor) -> Tensor:
            return values.masked_fill(padding if values.ndim == 2 else padding.unsqueeze(-1), 0)

        return cls(
            kept(states),
            kept(actions),
            kept(rewards),
            torch.zeros_like(rewards) if returns_to_go is None else kept(returns_to_go),
            numbers.clamp(min=0),
            mask,
        )

    @classmethod
    def joined(cls, parts: Sequence["Windows"]) -> "Windows":
        """The windows of all parts, one part after the other."""
        columns: dict[str, Any] = {
            name: torch.cat([getattr(part, name) for part in parts])
            for name, value in vars(parts[0]).items()
            if isinstance(value, Tensor)
        }
        return cls(**columns)

    def last(self, steps: int) -> "Windows":
        """The windows of this number of last steps."""
        return self._change(lambda values: values[:, -steps:])


@dataclass(frozen=True)
class Transitions(_Rows):
    """M single steps."""

    states: Tensor
    """(M, S)."""
    actions: Tensor
    """(M, A) vectors; an item is represented by its embedding."""
    rewards: Tensor
    """(M,), in reward units."""
    next_states: Tensor
    """(M, S) next states as logged; zeros at the last step of an episode."""
    last: Tensor
    """(M,) bool, true at the last step of an episode."""


class Shown(NamedTuple):
    """What B sessions showed before a step."""

    items: Tensor
    """(B, N) int64, most recent first; −1 before the session or window began."""
    rewards: Tensor
    """(B, N) in reward units; 0 where there is no item."""

    @classmethod
    def before_last(cls, windows: Windows) -> "Shown":
        """What windows of K steps show before their last one, N = K − 1."""
        items = windows.actions.masked_fill(~windows.mask, -1)
        return cls(items[:, :-1].flip(1), windows.rewards[:, :-1].flip(1))

    @classmethod
    def before(
        cls,
        store: "EpisodeStore",
        episodes: IntArray,
        steps: IntArray,
        length: int,
    ) -> "Shown":
        """What sessions (B,) of a store of items showed in the N = `length` steps before steps
        (B,). An unknown item (−1) counts as the first."""
        earlier = steps[:, None] - np.arange(1, length + 1)
        missing, owner, earlier = earlier < 0, episodes[:, None], np.maximum(earlier, 0)
        items = store.step_values(schema.ITEM, owner, earlier).clip(min=0).astype(np.int64)
        rewards = store.step_values(schema.REWARD, owner, earlier)
        return cls(
            torch.from_numpy(np.where(missing, -1, items)),
            torch.from_numpy(np.where(missing, np.float32(0), rewards)),
        )

    def at(self, rows: slice | int | Tensor) -> "Shown":
        """The sessions with the given numbers."""
        return Shown(self.items[rows], self.rewards[rows])

    def padded(self, steps: int) -> "Shown":
        """What was shown in the latest `steps`, (B, `steps`), also where fewer are known."""
        return Shown(pad_columns(self.items, steps, -1), pad_columns(self.rewards, steps, 0))

    def latest(self, steps: int) -> "Shown":
        """What was shown in the latest `steps` of these."""
        return Shown(self.items[:, :steps], self.rewards[:, :steps])


@dataclass(frozen=True)
class Exposed(_Rows):
    """Items shown before each of M steps and their rewards; the return-to-go and offer of steps."""

    items: Tensor
    """(M, N) int64 items shown, most recent first; −1 before the session or window began."""
    rewards: Tensor
    """(M, N) their rewards, in reward units."""
    returns: Tensor
    """(M,) returns-to-go in units of the policy's return scale."""
    offer: Offer | None = None
    """Of the M steps; None for everything."""
    times: Tensor | None = None
    """(M,) int64 ms of the steps, in training; None for the latest."""

    @classmethod
    def before(
        cls,
        windows: Windows,
        lags: int,
        steps: Tensor | None = None,
    ) -> "Exposed":
        """For every step t of B windows of K steps, or those in a mask (B, K): steps t − 1 to
        t − `lags` of the same window."""
        items = windows.actions.masked_fill(~windows.mask, -1)
        exposed = cls(
            _earlier(items, lags, -1),
            _earlier(windows.rewards, lags, 0),
            windows.returns_to_go.flatten(),
            windows.offer and windows.offer.change(torch.flatten),
            None if windows.times is None else windows.times.flatten(),
        )
        return exposed if steps is None else exposed._change(lambda part: part[steps.flatten()])

    @classmethod
    def before_last(cls, windows: Windows, lags: int) -> "Exposed":
        """For the last step of B windows, as `before`, (B, lags)."""
        recent = Shown.before_last(windows.last(lags + 1)).padded(lags)
        offer = windows.offer and windows.offer.change(lambda part: part[:, -1])
        return cls(recent.items, recent.rewards, windows.returns_to_go[:, -1], offer)


def draw_ends(
    generator: np.random.Generator, count: int, ends: IntArray, lengths: IntArray, length: int
) -> Steps:
    """See `EpisodeView.draw_steps`; `ends` (E,) are running totals of steps that are drawn, which
    are the last of `lengths` (E,)."""
    # Windows that would end up to `length` − 1 steps after a session end with it.
    if length > 1:
        ends = ends + (length - 1) * np.arange(1, len(ends) + 1)
    numbers = generator.integers(ends[-1], size=count)
    episodes = np.searchsorted(ends, numbers, side="right")
    steps = numbers - ends[episodes] + lengths[episodes] + length - 1
    return episodes, np.minimum(steps, lengths[episodes] - 1)


def pad_columns(values: Tensor, length: int, padding: int) -> Tensor:
    """The first `length` columns of values (B, N), with more columns where there are fewer."""
    missing = max(0, length - values.shape[1])
    values = values[:, :length]
    return nn.functional.pad(values, (0, missing), value=padding) if missing else values


def _earlier(values: Tensor, lags: int, padding: int) -> Tensor:
    """Values (B·K, lags) of the steps before each of (B, K), most recent first."""
    padded = nn.functional.pad(values, (lags, 0), value=padding)[:, :-1]
    return padded.unfold(1, lags, 1).flip(-1).flatten(0, 1)


@dataclass(frozen=True)
class Sessions(_Rows):
    """B sessions, each before the step to decide."""

    actions: Tensor
    """(B, L) int64 items shown, the latest last, −1 before the session; or (B, L, A) vectors."""
    rewards: Tensor
    """(B, L) float32 their rewards, in reward units; 0 before the session began."""
    steps: Tensor
    """(B,) int64 number of steps that the session has had, which may be more than L."""
    collected: Tensor
    """(B,) float64 sum of all rewards of the session."""
    users: Tensor
    """(B,) int64 numbers of the users in the training logs, −1 for others."""
    trained_steps: Tensor
    """(B,) int64 number of the session's first steps that are training rows of the reward model."""
    observations: Tensor | None = None
    """(B, K, O) float32 of the last K steps or more, with the one to decide; None without any."""
    states: Tensor | None = None
    """(B, K, S) float32 of the last K steps or more, where they are known; None to build them."""
    offer: Offer | None = None
    """What is on offer at the step to decide; None for everything."""

    @classmethod
    def begun(
        cls,
        count: int,
        length: int,
        vector_size: int = 0,
    ) -> "Sessions":
        """B = `count` sessions of unknown users without a step; of items, if A is 0."""
        actions = torch.full((count, length), -1)
        if vector_size:
            actions = torch.zeros(count, length, vector_size)
        steps = torch.zeros(count, dtype=torch.int64)
        return cls(actions, torch.zeros(count, length), steps, steps.double(), steps - 1, steps)

    @classmethod
    def from_rows(
        cls,
        owner: IntArray,
        items: IntArray,
        rewards: Float32Array,
        users: IntArray,
        length: int,
        observations: Tensor | None = None,
    ) -> "Sessions":
        """The sessions (N,) `owner`, 0 to B − 1 and sorted, of N rows with items and rewards (N,),
        of which the latest `length` = L are kept."""
        counts = np.bincount(owner, minlength=len(users))
        # Places from the end: the latest row is the last column.
        places = np.arange(len(owner)) - np.cumsum(counts)[owner] + length
        recent = places >= 0
        at = owner[recent], places[recent]
        recent_items = np.full((len(users), length), -1)
        received = np.zeros((len(users), length), dtype=np.float32)
        recent_items[at], received[at] = items[recent], rewards[recent]
        collected = np.bincount(owner, rewards, minlength=len(users)).astype(np.float64)
        return cls(
            torch.from_numpy(recent_items),
            torch.from_numpy(received),
            torch.from_numpy(counts),
            torch.from_numpy(collected),
            torch.from_numpy(users),
            torch.from_numpy(0 * users),
            observations,
        )

    @classmethod
    def from_store(
        cls,
        store: "EpisodeStore",
        episodes: IntArray,
        steps: IntArray,
        context: int,
        length: int,
    ) -> "Sessions":
        """What was known before steps (B,) of sessions (B,) of a store of items: before the first
        rows of their decisions.

        The store has the training's items. An item −1 is unknown; any known item can replace it,
        because steps after it have weight 0 in all estimates. At most `context` = K states are
        read, and `length` = L items, or as many as the context has.
        """
        starts = store.decision_starts(episodes, steps)
        context = min(context, int(starts.max(initial=0)) + 1)
        recent = Shown.before(store, episodes, starts, max(length, context - 1))
        users = np.full(len(steps), -1)
        if store.has_users:
            users = store.episode_values(schema.USER)[episodes]
        return cls(
            recent.items.flip(1),
            recent.rewards.flip(1),
            torch.from_numpy(starts),
            torch.from_numpy(store.rewards_before(episodes, starts)),
            torch.from_numpy(users),
            torch.from_numpy(0 * users),
            states=store.windows(episodes, starts, context).states,
            offer=store.offer(episodes, steps),
        )

    def begin(self, rows: IntArray) -> None:
        """Let new sessions begin at the positions `rows`, of whichever users there are."""
        self.actions[rows] = -1
        for values in (self.rewards, self.steps, self.collected, self.trained_steps):
            values[rows] = 0

    def add_step(self, actions: Tensor, rewards: Tensor) -> "Sessions":
        """The sessions after one more step: actions (B,) or (B, A), and their rewards (B,)."""
        received = rewards.float()  # rounded like the store's, for bit-identical states
        return replace(
            self,
            actions=torch.cat([self.actions[:, 1:], actions.unsqueeze(1)], dim=1),
            rewards=torch.cat([self.rewards[:, 1:], received.unsqueeze(1)], dim=1),
            steps=self.steps + 1,
            collected=self.collected + received,
        )

    @cached_property
    def shown(self) -> Shown:
        """The items shown, the latest first."""
        return Shown(self.actions.flip(1), self.rewards.flip(1))

    @property
    def shown_since(self) -> Shown:
        """The same, with −1 in place of the items of `trained_steps`."""
        items, rewards = self.shown
        known = torch.arange(items.shape[1]) >= (self.steps - self.trained_steps).unsqueeze(1)
        return Shown(items.masked_fill(known, -1), rewards)

    def latest_states(self, states: ItemStates, observations: Tensor) -> Tensor:
        """States (B, S) before the steps to decide, whose observations are (B, O)."""
        steps, observations = self.steps.unsqueeze(1), observations.unsqueeze(1)
        return self._build_states(states, steps, observations)[:, 0]

    def windows(self, states: ItemStates | None, context: int) -> Windows:
        """What policies read: windows of at most `context` = K steps that end with the step to
        decide, which has neither an action nor a reward yet, nor returns-to-go.

        L must be at least K − 1, and where `states` build the states of items, because they are not
        known, K − 1 + their window.
        """
        vectors = self.actions.ndim == 3
        if not (vectors or torch.compiler.is_exporting()):
            # No policy's outputs depend on how much padding is before a session.
            context = min(context, int(self.steps.max()) + 1)
        numbers = self.steps.unsqueeze(1) + torch.arange(1 - context, 1)
        if self.states is not None:
            window_states = self.states[:, -context:]
        else:
            assert states is not None
            if self.observations is None:
                observations = self.rewards.new_zeros(self.steps.shape[0], context, 0)
            else:
                observations = self.observations[:, -context:]
            window_states = self._build_states(states, numbers.clamp(min=0), observations)
        first = self.actions.shape[1] - context + 1
        return Windows.of(
            numbers,
            window_states,
            nn.functional.pad(self.actions[:, first:], (0, 0, 0, 1) if vectors else (0, 1)),
            nn.functional.pad(self.rewards[:, first:], (0, 1)),
        )

    def _build_states(
        self,
        states: ItemStates,
        steps: Tensor,
        observations: Tensor,
    ) -> Tensor:
        """States (B, K, S) of steps (B, K), the last ones, with observations (B, K, O)."""
        reach = steps.shape[1] - 1 + states.window
        items, rewards = self.actions[:, -reach:], self.rewards[:, -reach:]
        return states.build(items, rewards, steps, self.users, observations)


def seen_before(store: "EpisodeStore", episodes: IntArray, steps: IntArray) -> Tensor:
    """(B, n_items) bool: the known items that sessions (B,) showed before steps (B,)."""
    rows, earlier_steps = list_earlier(steps)
    items = store.items_at(episodes[rows], earlier_steps)
    seen = torch.zeros(len(steps), len(store.item_states.embeddings), dtype=torch.bool)
    seen[torch.from_numpy(rows[items >= 0]), torch.from_numpy(items[items >= 0])] = True
    return seen


def list_earlier(steps: IntArray) -> tuple[IntArray, IntArray]:
    """Row and number of every step before the given ones (B,), row by row."""
    owner = np.repeat(np.arange(len(steps)), steps)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps)


def _no_integers() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class AugmentedEpisodes:
    """Counterfactual episodes of a store, kept as what differs from the logged ones.

    C copies have other states at some steps: rewards, actions, returns-to-go and next states are
    those of the source (paper appendix H). N action copies end with another action: the source up
    to some step, at which another action had another reward. Kept whole, the states of a copy
    would take S times the memory of its log, and an action copy K states for its one step.
    """

    edit_state: Float32Array
    """(M, S) counterfactual states."""
    copy_source: IntArray = field(default_factory=_no_integers)
    """(C,) number in the store of the episode that was copied."""
    edit_copy: IntArray = field(default_factory=_no_integers)
    """(M,) number of the copy, 0 to C − 1, that each edit belongs to."""
    edit_step: IntArray = field(default_factory=_no_integers)
    """(M,) step of the episode that each edit changes; (copy, step) is strictly increasing."""
    action_source: IntArray = field(default_factory=_no_integers)
    """(N,) number in the store of the episode that an action copy was made from."""
    action_step: IntArray = field(default_factory=_no_integers)
    """(N,) step of the episode with the other action, the last of the copy."""
    action: Array = field(default_factory=_no_integers)
    """(N,) int64 items or (N, A) float32 vectors: the other actions."""
    action_reward: Float32Array = field(default_factory=lambda: np.zeros(0, dtype=np.float32))
    """(N,) their rewards, in reward units."""

    def join(self, episodes: "AugmentedEpisodes") -> "AugmentedEpisodes":
        """These episodes, followed by others."""
        renumbered = replace(episodes, edit_copy=episodes.edit_copy + len(self.copy_source))
        values = {}
        for name in (column.name for column in fields(self)):
            parts = [getattr(self, name), getattr(renumbered, name)]
            # Without action copies, the size of an action is not known.
            values[name] = np.concatenate([part for part in parts if len(part)] or parts[:1])
        return AugmentedEpisodes(**values)

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        arrays = {f.name: torch.from_numpy(getattr(self, f.name)) for f in fields(self)}
        save_tensors(path, arrays, {})

    @classmethod
    def load(cls, path: Path) -> "AugmentedEpisodes":
        """Read a file that `save` wrote; an InputError if it is missing or damaged."""
        tensors, _ = load_tensors(path)
        with damage_explained(path, REMEDY):
            return cls(**{name: tensor.numpy() for name, tensor in tensors.items()})


class TrainingEpisodes:
    """E logged episodes, then C augmented ones with other states, then N action copies, of which
    only the last step is drawn: those before it are its source's."""

    def __init__(self, logged: "EpisodeStore", augmented: AugmentedEpisodes) -> None:
        self._augmented, self._n_logged = augmented, logged.n_episodes
        self._sources = logged.whole.select(
            np.concatenate([logged.episode_ids, augmented.copy_source, augmented.action_source])
        )
        self._first_action_copy = self._n_logged + len(augmented.copy_source)
        lengths, counts = self._sources.lengths.copy(), self._sources.lengths.copy()
        lengths[self._first_action_copy :] = augmented.action_step + 1
        counts[self._first_action_copy :] = 1
        self._ends = np.cumsum(counts)
        self.n_steps = int(self._ends[-1])
        """Number of steps that are drawn."""
        self._lengths = lengths
        self._stride = int(augmented.edit_step.max(initial=0)) + 1
        keys = augmented.edit_copy * self._stride + augmented.edit_step
        # A sentinel, so that every search ends inside.
        self._keys = np.append(keys, np.iinfo(np.int64).max)

    def draw_steps(self, generator: np.random.Generator, count: int, length: int = 1) -> Steps:
        """As `EpisodeStore.draw_steps`."""
        return draw_ends(generator, count, self._ends, self._lengths, length)

    def windows(
        self,
        episodes: IntArray,
        ends: IntArray,
        length: int,
    ) -> Windows:
        """Windows as `EpisodeStore.windows`; those of action copies end with their last step."""
        windows, augmented = self._sources.windows(episodes, ends, length), self._augmented
        starts = self._sources.decision_starts(episodes, ends)
        steps = starts[:, None] + np.arange(1 - length, 1)
        copies = episodes[:, None] - self._n_logged
        possible = (copies >= 0) & (steps >= 0) & (steps < self._stride)
        keys = np.where(possible, copies * self._stride + steps, -1)
        places = np.searchsorted(self._keys, keys)
        edited = np.nonzero(self._keys[places] == keys)
        windows.states[edited] = torch.from_numpy(augmented.edit_state[places[edited]])
        rows = np.flatnonzero(episodes >= self._first_action_copy)
        if len(rows):
            numbers = episodes[rows] - self._first_action_copy
            rewards = torch.from_numpy(augmented.action_reward[numbers])
            change = rewards.double() - windows.rewards[rows, -1].double()
            ahead = np.arange(length - 1, -1, -1)
            weights = torch.from_numpy(self._sources.return_to_go.weights(ahead))
            added = weights * change.unsqueeze(1) * windows.mask[rows]
            windows.returns_to_go[rows] = (windows.returns_to_go[rows].double() + added).float()
            windows.actions[rows, -1] = torch.from_numpy(augmented.action[numbers])
            windows.rewards[rows, -1] = rewards
        return windows
