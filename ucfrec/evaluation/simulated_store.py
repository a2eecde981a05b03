"""Stores of sessions that a simulator played: collected, then prepared as anybody's logs are."""

from pathlib import Path

from ucfrec.evaluation.collect import collect
from ucfrec.evaluation.world import World
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.schema import ITEM_ID, SESSION_ID


def simulated_store(
    world: World, folder: Path, sessions: int, seed: int, behavior: str = "mixture"
) -> Path:
    """Play a behavior policy into `folder/logs`, prepare `folder/store`; what exists is kept.

    Returns:
        The store.
    """
    logs, store = folder / "logs", folder / "store"
    simulator = world.simulator()
    if not logs.exists():
        env = simulator.make(256, world.folder)
        actor = simulator.behaviors[behavior](env, seed)
        collect(simulator, env, actor, sessions, seed, logs, env_name=world.name, behavior=behavior)
    if not store.exists():
        items = logs / "items.parquet"
        features = (FeatureTable((items,), ITEM_ID),) if items.exists() else ()
        mapping = LogMapping(session_by=SESSION_ID, item_features=features)
        options = PrepareOptions(reward=simulator.feedback)
        prepare([logs / "sessions.parquet"], mapping, store, options)
    return store
