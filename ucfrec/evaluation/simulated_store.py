"""Stores of simulated sessions: collected as logs, then prepared like any other logs."""

from pathlib import Path

from ucfrec.evaluation.collect import collect
from ucfrec.evaluation.environment import Environment
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.schema import ITEM_ID, SESSION_ID


def simulated_store(
    environment: Environment, folder: Path, sessions: int, seed: int, behavior: str | None = None
) -> Path:
    """Collect logs in `folder/logs` and prepare `folder/store`; existing folders are reused.

    Args:
        seed: seed of the environments and of the behavior policy.
        behavior: name of one of the simulator's built-in policies; None for its
            `logging_behavior`.
    """
    logs, store = folder / "logs", folder / "store"
    simulator = environment.simulator()
    if not logs.exists():
        env = simulator.started(256, environment.folder)
        chosen = behavior or simulator.logging_behavior
        actor = simulator.behaviors[chosen](env, seed)
        collect(
            simulator, env, actor, sessions, seed, logs, env_name=environment.title, behavior=chosen
        )
    if not store.exists():
        items = logs / "items.parquet"
        features = (FeatureTable((items,), ITEM_ID),) if items.exists() else ()
        mapping = LogMapping(session_by=SESSION_ID, item_features=features)
        options = PrepareOptions(reward=simulator.feedback)
        prepare([logs / "sessions.parquet"], mapping, store, options)
    return store
