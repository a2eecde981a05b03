"""Simulate a behavior policy in a simulator and write its sessions as Parquet logs."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import Actor, Episodes, Step, rollout
from ucfrec.arrays import IntArray
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Catalog, Environment, Simulator, environment_items
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.processes import random_state_kept
from ucfrec.provenance import versions
from ucfrec.schema import ACTION, ITEM_ID, OBSERVATION, PROPENSITY, SESSION_ID, TIMESTAMP, USER_ID

EPOCH_MS = 1_704_067_200_000
"""Start of the first session, 2024-01-01 00:00 UTC, in ms."""
SESSION_MS = 60_000
"""Between the starts of two sessions."""
STEP_MS = 1_000
"""Between two steps of a session."""
ROWS_PER_GROUP = 65_536
"""Rows of a Parquet row group, at least, but for the last."""


@random_state_kept()
def collect(
    simulator: Simulator,
    env: VectorEnv[Any, Any, Any],
    actor: Actor,
    sessions: int,
    seed: int,
    out: Path,
    *,
    env_name: str,
    behavior: str,
) -> Episodes:
    """Simulate `sessions` sessions and write them as logs that `ucfrec prepare` reads.

    `out` contains `sessions.parquet` (one row per step: user, session, time in ms, item or action,
    the simulator's feedback, the observation unless it is empty, and the propensity if it is known;
    sessions simulated in parallel are interleaved), `items.parquet` if the environment describes
    its items, and `collect.json`, the record of the run. Sessions start 60 s apart and their steps
    1 s apart. `env` is made by `simulator`, and its environment i seeded with `seed` + i.
    InputError if `sessions` is below 1, or `out` exists.
    """
    if sessions < 1:
        raise InputError(f"sessions is {sessions}; give 1 or more")
    with atomic_folder(out) as folder:
        log = _SessionLog(folder / "sessions.parquet", env, simulator.feedback)
        played = rollout(env, actor, sessions, seed, log.record, describe="collect")
        log.close()
        environment = env.unwrapped
        if isinstance(environment, Catalog):
            pq.write_table(environment.item_features(), folder / "items.parquet")
        record = {
            "env": env_name,
            "behavior": behavior,
            "seed": seed,
            "sessions": len(played.returns),
            "steps": int(played.lengths.sum()),
            "mean_return": float(played.returns.mean()),
            "mean_length": float(played.lengths.mean()),
            "versions": versions(),
        }
        write_json(folder / "collect.json", record)
    return played


class _SessionLog:
    """Writes steps to a Parquet file, one row group at a time."""

    def __init__(
        self,
        path: Path,
        env: VectorEnv[Any, Any, Any],
        feedback: str,
    ) -> None:
        self._path, self._feedback = path, feedback
        discrete = isinstance(env.single_action_space, spaces.Discrete)
        self._items = environment_items(env) if discrete else None
        self._steps: list[Step] = []
        self._rows = 0
        self._played = np.zeros(env.num_envs, dtype=np.int64)
        self._numbers: list[IntArray] = []
        self._writer: pq.ParquetWriter | None = None

    def record(self, step: Step) -> None:
        """Add one step of all live sessions."""
        number, ends = self._played[step.rows], step.terminated | step.truncated
        self._steps.append(step)
        self._numbers.append(number)
        self._played[step.rows] = np.where(ends, 0, number + 1)
        self._rows += len(number)
        if self._rows >= ROWS_PER_GROUP:
            self._flush()

    def close(self) -> None:
        """Write the remaining steps and close the file."""
        if self._steps:
            self._flush()
        if self._writer is not None:
            self._writer.close()

    def _flush(self) -> None:
        table = pa.table(self._columns())
        if self._writer is None:
            self._writer = pq.ParquetWriter(self._path, table.schema, compression="zstd")
        self._writer.write_table(table)
        self._steps, self._numbers, self._rows = [], [], 0

    def _columns(self) -> dict[str, pa.Array]:
        steps = self._steps
        session = np.concatenate([step.episodes for step in steps])
        # A user's sessions may overlap; the added milliseconds keep their timestamps distinct.
        start = EPOCH_MS + session * SESSION_MS + session % STEP_MS
        users = [step.episodes if step.user_ids is None else step.user_ids for step in steps]
        actions = np.concatenate([step.actions for step in steps])
        columns = {
            USER_ID: pa.array(np.concatenate(users).astype(np.int64)),
            SESSION_ID: pa.array(session.astype(np.int64)),
            TIMESTAMP: pa.array(start + np.concatenate(self._numbers) * STEP_MS),
        }
        if self._items is None:
            columns[ACTION] = pa.array(list(actions.astype(np.float32)))
        else:
            columns[ITEM_ID] = pa.array(self._items[actions])
        columns[self._feedback] = pa.array(np.concatenate([step.rewards for step in steps]))
        observations = np.concatenate([step.observations for step in steps])
        if observations.shape[1]:
            columns[OBSERVATION] = pa.array(list(observations.astype(np.float32)))
        propensities = [step.propensities for step in steps if step.propensities is not None]
        if len(propensities) == len(steps):
            columns[PROPENSITY] = pa.array(np.concatenate(propensities))
        return columns


def collect_store(
    environment: Environment,
    folder: Path,
    sessions: int,
    seed: int,
) -> Path:
    """Collect logs of the `logging_behavior` in `folder/logs` and prepare `folder/store`; existing
    folders are reused."""
    logs, store = folder / "logs", folder / "store"
    simulator = environment.simulator()
    if not logs.exists():
        behavior = simulator.logging_behavior
        env, actor = environment.start(256, behavior, seed)
        names = {"env_name": environment.title, "behavior": behavior}
        collect(simulator, env, actor, sessions, seed, logs, **names)
    if not store.exists():
        items = logs / "items.parquet"
        # Collecting logs needs no DuckDB.
        from ucfrec.logs.mapping import FeatureTable, LogMapping
        from ucfrec.logs.prepare import PrepareOptions, prepare

        features = (FeatureTable((items,), ITEM_ID),) if items.exists() else ()
        mapping = LogMapping(session_by=SESSION_ID, item_features=features)
        options = PrepareOptions(reward=simulator.feedback)
        prepare([logs / "sessions.parquet"], mapping, store, options)
    return store
