"""What is learned from and what is judged in: a store, and the worlds that its policies play."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pyarrow as pa

from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.simulated_store import simulated_store
from ucfrec.evaluation.world import World
from ucfrec.logs.mapping import Dataset, LogMapping, log_files
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.plugins import load_plugin
from ucfrec.schema import SESSION_ID
from ucfrec_simulators.folders import data_folder
from ucfrec_simulators.kuai.completion import complete
from ucfrec_simulators.kuai.environment import EXITS
from ucfrec_simulators.kuai.kuairand import read_tags
from ucfrec_simulators.kuai.kuairec import read_categories
from ucfrec_simulators.kuai.logs import cut_by_exit, window, write_log

_LOG_SEED: Final = 0
# Midnight in China. The column `date` will not do: it changes as much as an hour too early.
_APRIL_22, _APRIL_28 = 1_650_556_800_000, 1_651_075_200_000


@dataclass(frozen=True)
class BenchmarkTask:
    """One environment of the table."""

    store: Path
    worlds: tuple[World, ...]
    """Where its policies play; the first is the table's."""
    behaviors: tuple[str, ...]
    """Built-in policies of the worlds that are judged beside."""


def virtual_taobao(folder: Path, sessions: int) -> BenchmarkTask:
    """The original networks, logged by the mixture of behaviors."""
    world = World("virtual-taobao")
    store = simulated_store(world, folder, sessions, _LOG_SEED)
    return BenchmarkTask(store, (world,), ("random", "mixture", "best-constant"))


def synthetic_taobao(folder: Path, sessions: int) -> BenchmarkTask:
    """Built-in shoppers, logged by the mixture of behaviors; the optimum is known."""
    world = World("synthetic-taobao")
    store = simulated_store(world, folder, sessions, _LOG_SEED)
    return BenchmarkTask(store, (world,), ("random", "mixture", "best-constant", "optimal"))


def synthetic_catalog(folder: Path, sessions: int) -> BenchmarkTask:
    """Tagged items and boredom, logged by the mixture of behaviors; the optimum is known."""
    world = World("synthetic-catalog")
    store = simulated_store(world, folder, sessions, _LOG_SEED)
    return BenchmarkTask(store, (world,), ("random", "mixture", "optimal"))


def kuairand(folder: Path, sessions: int) -> BenchmarkTask:
    """KuaiRand's logs: what came first to learn from, cut by the exit rule; what came after filled
    in to judge.

    With the random exposure at hand the standard log up to 21 April is learned from and the random
    rows judge, as the public experiments do; else the log is parted at 28 April.
    """
    source = data_folder("kuairand")
    files = log_files([source])
    logs = [file for file in files if file.name.startswith("log_")]
    if any(file.name.startswith("log_random_") for file in logs):
        learn, judge = f"is_rand = 0 AND time_ms < {_APRIL_22}", "is_rand = 1"
    else:
        learn, judge = f"time_ms < {_APRIL_28}", f"time_ms >= {_APRIL_28}"
    basic = [file for file in files if file.name.startswith("video_features_basic_")]
    features = [*basic, *(file for file in files if file.name.startswith("user_features_"))]
    tags = {video: own for file in basic for video, own in read_tags(file).items()}
    store, filled = folder / "store", folder / "world"
    if not store.exists():
        rows = cut_by_exit(window(logs, "time_ms", learn), tags, EXITS["easyrl4rec-kuairand"])
        _prepare("kuairand", rows, folder / "log_standard_learn.parquet", features, store)
    if not filled.exists():
        judged = folder / "judge"
        if not judged.exists():
            rows = window(logs, "time_ms", judge)
            _prepare("kuairand", rows, folder / "log_standard_judge.parquet", features, judged)
        complete(EpisodeStore.open(judged), tags, filled)
    worlds = ("kuairand", "kuairand-nx0", "kuairand-nx10")
    return BenchmarkTask(store, tuple(World(name, filled) for name in worlds), ("random", "oracle"))


def kuairec(folder: Path, sessions: int) -> BenchmarkTask:
    """KuaiRec: the big matrix to learn from, cut by the exit rule; the small one to judge."""
    source = data_folder("kuairec")
    files = log_files([source])
    logs = [file for file in files if file.name.startswith("big_matrix")]
    features = [file for file in files if not file.name.startswith(("big_", "small_"))]
    store = folder / "store"
    if not store.exists():
        rows = window(logs, "timestamp", "timestamp IS NOT NULL")
        rows = cut_by_exit(rows, read_categories(source), EXITS["easyrl4rec-kuairec"])
        _prepare("kuairec", rows, folder / "big_matrix_cut.parquet", features, store)
    worlds = ("kuairec", "kuairec-nx0", "kuairec-nx10")
    return BenchmarkTask(store, tuple(World(name, source) for name in worlds), ("random", "oracle"))


def _prepare(dataset: str, rows: pa.Table, log: Path, features: list[Path], store: Path) -> None:
    """A window as a log, and as a store; sessions are those it was cut into, else users."""
    write_log(rows, log)
    adapter: Dataset = load_plugin("datasets", dataset)
    by = SESSION_ID if SESSION_ID in rows.column_names else "user"
    files, mapping = adapter.resolve([log, *features], LogMapping(session_by=by))
    prepare(files, mapping, store, PrepareOptions())


TASKS: Final[Mapping[str, Callable[[Path, int], BenchmarkTask]]] = {
    "kuairand": kuairand,
    "kuairec": kuairec,
    "virtual-taobao": virtual_taobao,
    "synthetic-taobao": synthetic_taobao,
    "synthetic-catalog": synthetic_catalog,
}
"""By name; each made from (folder to keep it in, sessions to collect where logs are simulated)."""
