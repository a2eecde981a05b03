"""Any Gymnasium environment as a simulated environment: `gymnasium:ID`."""

from collections.abc import Callable, Sequence
from functools import partial
from operator import add, attrgetter
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.files.atomic import require_file
from ucfrec.schema import ITEM_ID, USER_IDS

REWARD = "reward"
"""Column of the environment's rewards in logs."""

Items = Callable[[gymnasium.Env[Any, Any], int], pa.Table]
"""Reads the item table from an environment and its number of items."""
_Observed = tuple[tuple[str | None, spaces.Space[Any]], ...]
"""Spaces that are observed and their keys in the dict observation; None for all of it."""
FEATURES = "features"
"""Column of the item table with an array's numbers."""
TAGS = "tags"
"""Column of the item table with the numbers of an array's true columns."""


class GymnasiumEnvironment(SyncVectorEnv):
    """N copies of a Gymnasium environment with `AutoresetMode.SAME_STEP`.

    Actions are items 0 to n − 1 where the environment's are `Discrete(n)` or `MultiDiscrete([n])`,
    and vectors (A,) where they are a `Box`; vectors are clipped to its bounds.
    Observations are vectors (O,): of a dict observation the entries `observe`, one after the other;
    any other observation as a whole, numbers as they are and categories one-hot. O is 0 for items
    if nothing is chosen from a dict, or the observation has no fixed size.

    Of `info`, the environment passes on `user_id`, a whole number. One that `reset` gives is that
    of the whole session, but for steps that give another. `reset(seed=s)` seeds copy i with a
    number drawn from (s, i), so that two seeds share no sessions. InputError if it cannot be made
    or played, or lacks the entries `observe`; or later, if it gives only some sessions a `user_id`.
    """

    def __init__(self, env_id: str, num_envs: int, observe: Sequence[str] = ()) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}; at least one session must be simulated")
        make = partial(_Session, env_id, tuple(observe))
        super().__init__([make] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start all sessions; returns observations (N, O) and info."""
        if isinstance(seed, int):
            sequences = [np.random.SeedSequence([seed, i]) for i in range(self.num_envs)]
            seed = [int(sequence.generate_state(1)[0]) for sequence in sequences]
        observations, info = super().reset(seed=seed, options=options)
        self._gives_users = USER_IDS in info
        self._require_all_users(info)
        return observations, info

    def step(
        self, actions: Any
    ) -> tuple[Float32Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Take one item or vector as action in each session, (N,) or (N, A); InputError if they
        have another shape, or are not items of the environment."""
        space, actions = self.action_space, np.asarray(actions)
        if isinstance(space, spaces.Box):
            fits = actions.shape == space.shape
        else:
            fits = actions.dtype.kind in "iu" and space.contains(actions)
        if not fits:
            raise InputError(
                f"{self.num_envs} sessions take one action of {self.single_action_space} each, not "
                f"an array of {actions.dtype} of shape {actions.shape}: {actions.tolist()!s:.60}"
            )
        played = super().step(actions)
        self._require_all_users(played[-1])
        return played

    def _require_all_users(self, info: dict[str, Any]) -> None:
        # Gymnasium fills the entries of sessions that give none with 0, which may be a user's.
        present = info.get(f"_{USER_IDS}", np.zeros(self.num_envs, dtype=bool))
        if (present != self._gives_users).any():
            raise InputError(
                f"only some sessions or steps have info[{USER_IDS!r}]; the environment's reset "
                "must give it in every session, or in none"
            )


class GymnasiumCatalog(GymnasiumEnvironment):
    """A `GymnasiumEnvironment` of items, not vectors, whose features `items` reads."""

    def __init__(
        self, env_id: str, num_envs: int, items: Items, observe: Sequence[str] = ()
    ) -> None:
        super().__init__(env_id, num_envs, observe)
        space = self.single_action_space
        if not isinstance(space, spaces.Discrete):
            raise InputError(f"{env_id} takes vectors, not items; omit --item-features")
        self._table = items(self.envs[0], int(space.n))

    def item_features(self) -> pa.Table:
        """One row per item in the order of the actions, with the column `item_id`."""
        return self._table


class _Session(gymnasium.Wrapper[Float32Array, Any, Any, Any]):
    """One environment as `GymnasiumEnvironment` describes it."""

    def __init__(self, env_id: str, observe: tuple[str, ...]) -> None:
        try:
            super().__init__(_make(env_id))
        except Exception as error:  # the module of an environment may raise anything
            raise InputError(
                f"gymnasium:{env_id} cannot be made ({error}); give an identifier that Gymnasium "
                "knows, or with the module that registers it, as in gymnasium:MODULE:ID"
            ) from None
        self.action_space, self._to_action = _actions(self.env.action_space, env_id)
        vectors = isinstance(self.action_space, spaces.Box)
        self._observed = _select_observed(self.env.observation_space, observe, vectors, env_id)
        size = sum(spaces.flatdim(space) for _, space in self._observed)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start a session; returns the observation (O,) and info."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._user = _user(info)
        return self._vector(observation), self._user

    def step(self, action: Any) -> tuple[Float32Array, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take one item or vector as action (A,)."""
        observation, reward, terminated, truncated, info = self.env.step(self._to_action(action))
        # Many environments give it once, at the start of the session.
        self._user = _user(info) or self._user
        return self._vector(observation), reward, terminated, truncated, self._user

    def _vector(self, observation: Any) -> Float32Array:
        parts: list[Any] = [
            spaces.flatten(space, observation if key is None else observation[key])
            for key, space in self._observed
        ]
        return np.concatenate([np.zeros(0), *parts]).astype(np.float32)


def _make(env_id: str) -> gymnasium.Env[Any, Any]:
    try:
        return gymnasium.make(env_id, disable_env_checker=True)
    except gymnasium.error.NamespaceNotFound:
        # Most packages register their environments, as NAMESPACE/NAME, when they are imported.
        module = env_id.partition("/")[0]
        return gymnasium.make(f"{module}:{env_id}", disable_env_checker=True)


def _actions(
    space: spaces.Space[Any], env_id: str
) -> tuple[spaces.Discrete | spaces.Box, Callable[[Any], Any]]:
    """The environment's action space, and what turns its actions into the environment's."""
    if isinstance(space, spaces.Discrete):
        return spaces.Discrete(space.n), partial(add, space.start)
    if isinstance(space, spaces.MultiDiscrete) and space.shape == (1,):
        first = space.start
        return spaces.Discrete(space.nvec[0]), lambda item: (first + item).astype(space.dtype)
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        low, high, kind = space.low, space.high, space.dtype
        box = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        return box, lambda vector: np.clip(vector, low, high).astype(kind)
    raise InputError(
        f"gymnasium:{env_id} takes actions of {space}; ucfrec takes one item (Discrete, or "
        "MultiDiscrete of one entry) or one vector (Box of one dimension)"
    )


def _select_observed(
    space: spaces.Space[Any],
    keys: tuple[str, ...],
    vectors: bool,
    env_id: str,
) -> _Observed:
    entries = dict(space.spaces) if isinstance(space, spaces.Dict) else {}
    unknown = [key for key in keys if key not in entries]
    if unknown:
        has = f"has the entries {', '.join(entries)}" if entries else "has no named entries"
        raise InputError(f"--observe {','.join(unknown)}: the observation of {env_id} {has}")
    chosen: _Observed = ((None, space),) if not entries else tuple((k, entries[k]) for k in keys)
    sized = all(part.is_np_flattenable for _, part in chosen)
    if (keys and not sized) or (vectors and not (sized and chosen)):
        raise InputError(
            f"gymnasium:{env_id} has the observation {space}; name entries of a fixed size with "
            "--observe KEY,KEY"
        )
    return chosen if sized else ()


def _user(info: dict[str, Any]) -> dict[str, IntArray]:
    """What is passed on of `info`."""
    if USER_IDS not in info:
        return {}
    user = np.asarray(info[USER_IDS])
    if user.shape != () or user.dtype.kind not in "iu":
        raise InputError(f"info[{USER_IDS!r}] is {info[USER_IDS]!r}; it must be a whole number")
    return {USER_IDS: user.astype(np.int64)}


def item_table(source: str, env: gymnasium.Env[Any, Any], n_items: int) -> pa.Table:
    """The features of an environment's items: one row per action, with the column `item_id`.

    `source` names a file (`.npy`, `.parquet`) or else an attribute of the environment, with dots
    for attributes of attributes. Row i of an array belongs to action i: finite numbers (n_items,)
    or (n_items, D) become the column `features`, booleans (n_items, D) the column `tags`, the list
    of the columns that are true. A Parquet file has a column `item_id` with the numbers of the
    actions, and its other columns are kept. InputError for anything else.
    """
    if source.endswith((".parquet", ".npy")):
        require_file(Path(source), "name another file")
    try:
        if source.endswith(".parquet"):
            return _order_rows(pq.read_table(source), source, n_items)
        if source.endswith(".npy"):
            return _table(np.load(source, allow_pickle=False), source, n_items)
    except (OSError, ValueError) as error:
        raise InputError(f"--item-features {source} cannot be read ({error})") from None
    name, _, path = source.partition(".")
    try:
        value = env.get_wrapper_attr(name)
        return _table(np.asarray(attrgetter(path)(value) if path else value), source, n_items)
    except AttributeError as error:
        raise InputError(
            f"--item-features {source} is neither a .npy or .parquet file nor an attribute of the "
            f"environment ({error})"
        ) from None


def _table(values: Array, source: str, n_items: int) -> pa.Table:
    """The item table of an array (n_items,) or (n_items, D)."""
    if values.dtype.kind not in "biuf" or values.ndim not in (1, 2) or len(values) != n_items:
        raise InputError(
            f"--item-features {source} is an array of {values.dtype} of shape {values.shape}; give "
            f"numbers with one row for each of the {n_items} items"
        )
    ids = pa.array(np.arange(n_items))
    if values.dtype.kind == "b" and values.ndim == 2:
        return pa.table({ITEM_ID: ids, TAGS: [np.flatnonzero(row) for row in values]})
    if not np.isfinite(values).all():
        raise InputError(f"--item-features {source} has numbers that are not finite")
    column = values.astype(np.float64) if values.ndim == 1 else list(values.astype(np.float32))
    return pa.table({ITEM_ID: ids, FEATURES: pa.array(column)})


def _order_rows(table: pa.Table, source: str, n_items: int) -> pa.Table:
    """The rows of a Parquet file, in the order of the actions."""
    if ITEM_ID not in table.column_names or not pa.types.is_integer(table[ITEM_ID].type):
        raise InputError(
            f"--item-features {source} has no whole numbers as {ITEM_ID}; name the column of the "
            f"actions' numbers {ITEM_ID}"
        )
    ids = np.asarray(table[ITEM_ID])
    order = np.argsort(ids)
    if not np.array_equal(ids[order], np.arange(n_items)):
        raise InputError(
            f"--item-features {source} has {len(ids)} rows; give each {ITEM_ID} from 0 to "
            f"{n_items - 1} once"
        )
    return table.take(pa.array(order))
