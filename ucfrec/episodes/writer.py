"""Writing an episode store incrementally, in bounded memory."""

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.episodes.record import Source, StoreRecord
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore

_PART_STEPS = 2**20


class StoreWriter:
    """Writes steps, appended in order, as shards of .npy columns.

    `folder` should be a scratch folder of `ucfrec.files.atomic.atomic_folder`, so that a store
    appears complete or not at all.
    """

    def __init__(
        self,
        folder: Path,
        shard_steps: int = 2**24,
        first_shard: int = 0,
    ) -> None:
        """A shard ends with the first episode that brings it to `shard_steps` steps."""
        self._folder, self._shard_steps = folder, shard_steps
        self._hashes: dict[str, Any] = {}
        self._shapes: dict[str, list[int]] = {}
        self._files: dict[str, _NpyFile] = {}
        self._offsets: list[IntArray] = []
        self._episode_values: dict[str, list[Array]] = {}
        self._split_counts = np.zeros((len(schema.SPLITS), 2), dtype=np.int64)
        self._steps_in_shard, self._shards = 0, first_shard

    def append(
        self,
        steps: Mapping[str, Array],
        first: BoolArray,
        episodes: Mapping[str, Array],
    ) -> None:
        """Append M steps.

        Args:
            steps: step columns of `ucfrec.schema`, each (M,) or, for `action` and `observation`,
                (M, size). `reward`, and one of `item` and `action`, are required.
            first: (M,) true at the first step of an episode.
            episodes: episode columns of `ucfrec.schema`, each (M,), constant within an episode;
                `split` is required.

        Raises:
            InputError: columns differ in length, or rewards are not finite.
        """
        first = np.asarray(first, dtype=bool)
        for name, values in (*steps.items(), *episodes.items()):
            if len(values) != len(first):
                raise InputError(f"column {name!r} has {len(values)} steps instead of {len(first)}")
        require_finite(steps[schema.REWARD])
        starts, begin = np.flatnonzero(first), 0
        while begin < len(first):
            full = begin + self._shard_steps - self._steps_in_shard
            later = starts[np.searchsorted(starts, full) :]
            end = int(later[0]) if len(later) else len(first)
            rows, begins = slice(begin, end), starts[(starts >= begin) & (starts < end)]
            for name, values in steps.items():
                column = np.ascontiguousarray(values[rows], dtype=schema.STEP_DTYPES[name])
                self._shapes.setdefault(name, list(column.shape[1:]))
                if name not in self._files:
                    self._files[name] = _NpyFile(self._shard / f"{name}.npy")
                self._files[name].append(column)
                self._hash(name, column)
            for name, values in episodes.items():
                column = np.asarray(values)[begins].astype(schema.EPISODE_DTYPES[name])
                self._episode_values.setdefault(name, []).append(column)
                self._hash(name, column)
            self._hash("first", first[rows].view(np.uint8))
            self._offsets.append(begins - begin + self._steps_in_shard)
            split = np.asarray(episodes[schema.SPLIT])
            for place, counted in enumerate((split[begins], split[rows])):
                self._split_counts[:, place] += np.bincount(counted, minlength=len(schema.SPLITS))
            self._steps_in_shard += end - begin
            if len(later):
                self._close_shard()
            begin = end

    @property
    def _shard(self) -> Path:
        folder = self._folder / f"shard-{self._shards:05d}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _hash(self, name: str, column: Array) -> None:
        self._hashes.setdefault(name, hashlib.sha256()).update(column.tobytes())

    def _close_shard(self) -> None:
        for file in self._files.values():
            file.close()
        offsets = np.concatenate([*self._offsets, [self._steps_in_shard]]).astype(np.int64)
        np.save(self._shard / f"{schema.OFFSETS}.npy", offsets)
        for name, values in self._episode_values.items():
            np.save(self._shard / f"{name}.npy", np.concatenate(values))
        rewards = np.load(self._shard / f"{schema.REWARD}.npy", mmap_mode="r")
        returns = _NpyFile(self._shard / f"{schema.RETURN_TO_GO}.npy")
        begin = 0
        while begin < len(offsets) - 1:
            end = max(int(np.searchsorted(offsets, offsets[begin] + _PART_STEPS)), begin + 1)
            part = offsets[begin : end + 1]
            of_part = rewards[part[0] : part[-1]]
            returns.append(ReturnToGo().of_logs(of_part, part - part[0]))
            begin = end
        returns.close()
        self._files, self._offsets, self._episode_values = {}, [], {}
        self._shards += 1
        self._steps_in_shard = 0

    def finish(
        self,
        reward: str,
        source: Mapping[str, Any],
        ids: Mapping[str, list[Any]] | None = None,
    ) -> StoreRecord:
        """Close the last shard and write `meta.json`, with the checksums of the files so far.

        Args:
            reward, source: the expression of the rewards, and what the store was made from.
            ids: original identifiers (of items, of users) by name, in the order in which columns
                number them; they enter the fingerprint.

        Raises:
            InputError: no step was appended.
        """
        n_episodes, n_steps = self._split_counts.sum(0).tolist()
        if not n_steps:
            raise InputError(
                "no episode is left to store: every row was dropped or none was read; check the "
                "input and the filters"
            )
        self._close_shard()
        for name, values in (ids or {}).items():
            self._hashes[f"ids {name}"] = hashlib.sha256("\n".join(map(str, values)).encode())
        digests = "".join(f"{k}:{h.hexdigest()};" for k, h in sorted(self._hashes.items()))
        record = StoreRecord(
            files={},
            version=schema.STORE_VERSION,
            n_steps=n_steps,
            n_episodes=n_episodes,
            n_shards=self._shards,
            columns=self._shapes,
            fingerprint=hashlib.sha256(digests.encode()).hexdigest(),
            reward=reward,
            splits={
                name: {"episodes": episodes, "steps": steps}
                for name, (episodes, steps) in zip(
                    schema.SPLITS, self._split_counts.tolist(), strict=True
                )
            },
            source=Source.model_validate(dict(source)),
        )
        return record.seal(self._folder)


def reward_bit(
    store: "EpisodeStore",
    flip: float = 0.0,
    seed: int = 0,
    early: bool = False,
) -> Float32Array:
    """The distractor d_t = I{r_t is high} ⊕ Bernoulli(flip) of every step (paper appendix G.4),
    (n_steps,) float32, 0 or 1, in the order of `all_steps`.

    A reward is high if it exceeds the median of all rewards; if the median equals the largest
    reward (more than half of all steps are clicks), a reward is high if it equals the median. The
    paper's deterministic distractor has `flip` 0, the stochastic one 0.15. An `early` bit is that
    of the next step, d_t = I{r_{t+1} is high}, but for the last step of an episode. InputError if
    `flip` is not a probability, or all rewards are equal.
    """
    if not 0 <= flip <= 1:
        raise InputError(f"flip, the probability of a wrong bit, is {flip}; it must be in [0, 1]")
    episodes, steps = store.all_steps()
    rewards = store.step_values(schema.REWARD, episodes, steps)
    if rewards.min() == rewards.max():
        raise InputError(
            f"all rewards of {store.path} are {rewards[0]:g}, so no distractor can correlate with "
            "them; check the reward expression"
        )
    median = np.median(rewards)
    revealed_steps = np.minimum(steps + 1, store.lengths[episodes] - 1) if early else steps
    revealed = store.step_values(schema.REWARD, episodes, revealed_steps)
    high = revealed > median if median < rewards.max() else revealed >= median
    flipped = np.random.default_rng(seed).random(len(rewards)) < flip
    return np.asarray(high ^ flipped, dtype=np.float32)


def write_observations(
    store: "EpisodeStore",
    out: Path,
    observations: Float32Array,
    source: Mapping[str, Any],
) -> "EpisodeStore":
    """Write a copy of `store` with other observations, atomically.

    Args:
        store: a whole store in a folder, not a view of some episodes.
        observations: (n_steps, O) in the order of `all_steps`.
        source: added to the record of what the store was made from.

    Raises:
        InputError: `out` exists already.
    """
    values = np.ascontiguousarray(observations, dtype=schema.STEP_DTYPES[schema.OBSERVATION])
    digest = hashlib.sha256(store.record.fingerprint.encode() + values.tobytes()).hexdigest()
    with atomic_folder(out) as scratch:
        shutil.copytree(store.path, scratch, dirs_exist_ok=True)
        begin = 0
        for shard in sorted(scratch.glob("shard-*")):
            end = begin + int(np.load(shard / "offsets.npy")[-1])
            np.save(shard / f"{schema.OBSERVATION}.npy", values[begin:end])
            begin = end
        changed = f"{schema.OBSERVATION}.npy"
        files = store.record.files.items()
        store.record.copy_with(
            files={name: entry for name, entry in files if not name.endswith(f"/{changed}")},
            columns={**store.record.columns, schema.OBSERVATION: [values.shape[1]]},
            fingerprint=digest,
            source=Source.model_validate({**store.record.source.model_dump(), **source}),
        ).seal(scratch)
    return type(store).open(out)


def read_observations(store: "EpisodeStore") -> Float32Array:
    """The observations (n_steps, O) in the order of `all_steps`; O is 0 if none were logged."""
    if not store.observation_size:
        return np.zeros((store.n_steps, 0), dtype=np.float32)
    return store.column(schema.OBSERVATION)


def require_steps(path: Path | str, lengths: Array) -> IntArray:
    """The numbers of steps (E,) of episodes as an array; an InputError if one has none."""
    lengths = np.asarray(lengths)
    if np.any(lengths < 1):
        raise InputError(f"{path}: an episode without steps cannot be stored; leave it out")
    return lengths


def require_finite(rewards: Array) -> None:
    """Raise an InputError for rewards (N,) that are NaN or so large that training would overflow:
    one of them would spoil a shard's returns."""
    with np.errstate(over="ignore"):
        stored = np.asarray(rewards, dtype=schema.STEP_DTYPES[schema.REWARD])
    refused = np.count_nonzero(~(np.abs(stored) <= schema.LARGEST_REWARD))
    if refused:
        raise InputError(
            f"{refused} of {len(stored)} rewards are not finite or beyond "
            f"±{schema.LARGEST_REWARD:g}, too large to train with in float32; drop those rows, or "
            "correct the reward expression"
        )


class _NpyFile:
    """A .npy file of growing length; numpy pads the header so that it can be rewritten in place."""

    def __init__(self, path: Path) -> None:
        self._file: IO[bytes] = path.open("wb")
        self._rows = 0

    def append(self, rows: Array) -> None:
        """Append rows, one or more, of the same dtype and shape as all before."""
        if not self._rows:
            self._dtype, self._shape = rows.dtype, rows.shape[1:]
            self._write_header()
        self._file.write(rows.tobytes())
        self._rows += len(rows)

    def _write_header(self) -> None:
        header = {
            "descr": np.lib.format.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (self._rows, *self._shape),
        }
        self._file.seek(0)
        np.lib.format.write_array_header_1_0(self._file, header)

    def close(self) -> None:
        """Write the number of rows."""
        self._write_header()
        self._file.close()
