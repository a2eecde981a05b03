"""Flipped bits: every one is found by who reads the file, or changes nothing that is read."""

import json
import random
import shutil
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.torture.children import Running
from tests.torture.made import Inputs

_BATCH = 50


def flips(inputs: Inputs, source: Path, folder: Path, cases: int, seed: int) -> Counter[str]:
    """Flip single bits of a store or a run, and read everything of it."""
    counts = Counter[str]()
    for begin in range(0, cases, _BATCH):
        answer = folder / "flips.json"
        answer.unlink(missing_ok=True)
        numbers = range(begin, min(begin + _BATCH, cases))
        read = read_store if source == inputs.store else read_run
        end = Running(partial(_batch, source, read, folder, numbers, seed, answer)).wait()
        if end.status or not answer.exists():
            counts[f"a process ended with {end.status}: {end.printed[-200:]}"] += 1
            continue
        counts.update(json.loads(answer.read_text()))
    return counts


def _batch(
    source: Path,
    read: Callable[[Path], list[Any]],
    folder: Path,
    numbers: range,
    seed: int,
    answer: Path,
) -> int:
    from ucfrec.errors import InputError

    counts = Counter[str]()
    expected = read(source)
    copy = folder / f"flipped-{source.name}"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(source, copy)
    files = sorted(path for path in copy.rglob("*") if path.is_file() and path.stat().st_size)
    for number in numbers:
        generator = random.Random(f"{seed} {source.name} {number}")
        path = generator.choice(files)
        whole = path.read_bytes()
        content = bytearray(whole)
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
        _replace(path, content)
        name = path.relative_to(copy).as_posix()
        try:
            found = read(copy)
        except InputError as error:
            counts["found"] += 1
            if "\n" in str(error):
                counts["several lines"] += 1
        except Exception as error:
            counts[f"{name}: {type(error).__name__}: {str(error)[:80]}"] += 1
        else:
            same = _all_same(found, expected)
            counts["harmless" if same else f"{name}: silently another content"] += 1
        _replace(path, whole)
    if not _all_same(read(copy), expected):
        raise AssertionError("the copy was not restored")
    shutil.rmtree(copy)
    answer.write_text(json.dumps(counts))
    return 0


def _replace(path: Path, content: bytes) -> None:
    """Write a new file, as arrays may still map the old one."""
    path.unlink()
    path.write_bytes(content)


def read_store(path: Path) -> list[Any]:
    """All that ucfrec reads of a store."""
    from ucfrec import schema
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.files.parquet import read_ids

    store = EpisodeStore.open(path)
    columns = [store.step_values(name, *store.all_steps()) for name in store.record.columns]
    episodes = [store.episode_values(name) for name in schema.EPISODE_DTYPES]
    states = store.item_states
    store.record.checksums(path).require_small()
    ids = [read_ids(path / f"{name}.parquet", f"{name[:-1]}_id") for name in ("users", "items")]
    used = ("n_steps", "n_episodes", "reward", "fingerprint", "source", "splits")
    meta = {name: getattr(store.record, name) for name in used}
    return [*columns, *episodes, states.embeddings.numpy(), states.reward_high, *ids, repr(meta)]


def read_run(path: Path) -> list[Any]:
    """All that ucfrec reads of a run."""
    from ucfrec.fitting.metrics_log import read_metrics
    from ucfrec.runs.trained_policy import TrainedPolicy

    found: list[Any] = []
    for checkpoint in ("best", "last"):
        trained = TrainedPolicy.load(path, checkpoint)
        found += [tensor.numpy() for tensor in trained.policy.state_dict().values()]
        found += [trained.item_ids, trained.user_ids]
    used = ("config", "sizes", "return_quantiles", "reward", "fingerprint", "train_steps")
    found.append(repr({name: getattr(trained.record, name) for name in used}))
    return [*found, repr(read_metrics(path / "policy"))]


def _all_same(some: list[Any], others: list[Any]) -> bool:
    return len(some) == len(others) and all(map(_same, some, others))


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.tobytes() == other.tobytes()
    return bool(one == other)
