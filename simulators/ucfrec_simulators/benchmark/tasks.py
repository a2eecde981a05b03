"""The benchmark tasks: a store to train on, and the environments to evaluate in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec.benchmark.cells import Task
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.collect import collect_store
from ucfrec.evaluation.simulator import Environment
from ucfrec.files.atomic import atomic_file
from ucfrec.logs.mapping import Dataset, LogMapping, log_files
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.plugins import load_plugin
from ucfrec.schema import SESSION_ID
from ucfrec_simulators.kuai.behaviors import BEHAVIORS
from ucfrec_simulators.kuai.completion import complete
from ucfrec_simulators.kuai.environment import EXITS
from ucfrec_simulators.kuai.kuairand import read_tags
from ucfrec_simulators.kuai.kuairec import read_categories
from ucfrec_simulators.kuai.logs import cut_by_exit, part_of, window
from ucfrec_simulators.session_env import data_folder

EXIT_PRESETS: Final = ("", "-nx0", "-nx10", "-n4", "-n4-nx0", "-n1", "-n1-nx0")
"""What follows the name of a Kuaishou environment: repeats allowed or not, ten steps without an
exit, and exit rules that look back four items and one instead of ten."""
KUAIRAND: Final = tuple(f"kuairand{preset}" for preset in EXIT_PRESETS)
KUAIREC: Final = tuple(f"kuairec{preset}" for preset in EXIT_PRESETS)
REFERENCES: Final = tuple(BEHAVIORS)
_REFERENCES: Final = {
    "virtual-taobao": ("random", "mixture", "best-constant"),
    "synthetic-taobao": ("random", "mixture", "best-constant", "optimal"),
    "synthetic-catalog": ("random", "mixture", "optimal"),
}
"""Built-in policies that are evaluated beside those trained on the mixture of an environment."""
# Midnight in China (ms). The column `date` changes up to an hour too early, so it is not used.
_APRIL_22, _APRIL_28 = 1_650_556_800_000, 1_651_075_200_000


@dataclass(frozen=True)
class Log:
    """Which log of a task methods are trained on."""

    sessions: int
    """Sessions to collect where the log is simulated."""
    seed: int
    """Seed of these."""
    part: int = 0
    """Part of a given log; its sessions are dealt out among the parts."""
    parts: int = 1
    """Number of parts of a given log; 1 for all of it."""


def sardine(name: str, folder: Path, log: Log) -> Task:
    """An environment of SARDINE, with logs of its mixture of oracles; a twelfth of the sessions are
    collected, because they have 100 steps."""
    return simulated(Environment(name), folder, replace(log, sessions=max(1, log.sessions // 12)))


def simulated(
    environment: Environment, folder: Path, log: Log, behaviors: Sequence[str] = ()
) -> Task:
    """Any environment that needs no files, with logs of its mixture or, without one, of random
    actions, and the built-in policies that are evaluated as references (all if empty). InputError
    if the environment cannot be made."""
    behaviors = tuple(behaviors or environment.simulator().behaviors)
    store = collect_store(environment, folder, log.sessions, log.seed)
    return Task(environment.title, store, (environment,), behaviors)


def kuairand(folder: Path, log: Log) -> Task:
    """KuaiRand: trained on the earlier logs, evaluated in environments completed from the later
    logs.

    The training logs are cut into sessions by the exit rule. If the data folder has the random
    exposures, training uses the standard log up to 21 April and the environments are made from the
    random rows, as in the public experiments. Otherwise the log is split at 28 April. InputError if
    the data folder lacks the official files.
    """
    source = data_folder("kuairand")
    files = log_files([source])
    logs = [file for file in files if file.name.startswith("log_")]
    if any(file.name.startswith("log_random_") for file in logs):
        training, later = f"is_rand = 0 AND time_ms < {_APRIL_22}", "is_rand = 1"
    else:
        training, later = f"time_ms < {_APRIL_28}", f"time_ms >= {_APRIL_28}"
    basic = [file for file in files if file.name.startswith("video_features_basic_")]
    features = [*basic, *(file for file in files if file.name.startswith("user_features_"))]
    tags = {video: tag for file in basic for video, tag in read_tags(file).items()}
    store, filled = folder / "store", folder / "environment"
    if not store.exists():
        rows = cut_by_exit(window(logs, "time_ms", training), tags, EXITS["easyrl4rec-kuairand"])
        rows = part_of(rows, log.part, log.parts)
        _prepare("kuairand", rows, folder / "log_standard_learn.parquet", features, store)
    if not filled.exists():
        played = folder / "environment-store"
        if not played.exists():
            rows, log_file = window(logs, "time_ms", later), "log_standard_environment.parquet"
            _prepare("kuairand", rows, folder / log_file, features, played)
        complete(EpisodeStore.open(played), tags, filled)
    environments = tuple(Environment(name, filled) for name in KUAIRAND)
    return Task("kuairand", store, environments, REFERENCES)


def kuairec(folder: Path, log: Log) -> Task:
    """KuaiRec: trained on the big matrix, cut by the exit rule; evaluated on the small matrix.
    InputError if the data folder lacks the official files."""
    source = data_folder("kuairec")
    files = log_files([source])
    logs = [file for file in files if file.name.startswith("big_matrix")]
    features = [file for file in files if not file.name.startswith(("big_", "small_"))]
    store = folder / "store"
    if not store.exists():
        rows = window(logs, "timestamp", "timestamp IS NOT NULL")
        rows = cut_by_exit(rows, read_categories(source), EXITS["easyrl4rec-kuairec"])
        rows = part_of(rows, log.part, log.parts)
        _prepare("kuairec", rows, folder / "big_matrix_cut.parquet", features, store)
    return Task("kuairec", store, tuple(Environment(name, source) for name in KUAIREC), REFERENCES)


def _prepare(dataset: str, rows: pa.Table, log: Path, features: list[Path], store: Path) -> None:
    """Write `rows` to `log` and as a store; an episode is a session, or a user without sessions."""
    with atomic_file(log) as scratch:
        pq.write_table(rows, scratch)
    adapter: Dataset = load_plugin("datasets", dataset)
    by = SESSION_ID if SESSION_ID in rows.column_names else "user"
    files, mapping = adapter.resolve([log, *features], LogMapping(session_by=by))
    prepare(files, mapping, store, PrepareOptions())


TASKS: Final[Mapping[str, Callable[[Path, Log], Task]]] = {
    "kuairand": kuairand,
    "kuairec": kuairec,
    **{n: partial(simulated, Environment(n), behaviors=b) for n, b in _REFERENCES.items()},
    "sardine-static": partial(sardine, "sardine-static"),
    "sardine-boredinf": partial(sardine, "sardine-boredinf"),
}
"""Makers of the tasks by name. Arguments: the folder to keep it in, and which log."""
LOGGED: Final[Mapping[str, tuple[str, ...]]] = {"kuairand": KUAIRAND, "kuairec": KUAIREC}
"""Environments of the tasks whose logs are given; any other task has the one environment of its
name."""
