"""Every reader on files with flipped bits and with other content, in a copy of the folder.

A flipped bit must be found, or change nothing that is read. After a mutation the record of the
folder is sealed again: its checksums would find every change. The first mutant is no file of any
kind; a reader that does not refuse it reads another file."""

import errno
import json
import os
import pickle
import random
import resource
import shutil
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.torture.children import Running
from tests.torture.inputs import Inputs

BATCH, SECONDS, MEMORY = 200, 20, 24 * 2**30
"""Cases of a process; seconds after which reading one file counts as hung; bytes."""
WORDS = (
    *(b"\x00", b"\xff\xfe", b"\n", b"\r\n", b'"', b"{", b"}", b"[" * 3000, b"null", b"NaN", b"'"),
    *(b"1e999", b"-1", b"9" * 5000, b"4294967296", b"true", b"../../etc/passwd", b"\x1b[31m"),
    *(b"\x89HDF\r\n\x1a\n", b"\xff" * 8, b"\x00" * 64, b"\xe2\x80\xa8", b"int64", b"'|O'"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 10**12, 10**400, 1.5, float("nan"), float("inf"), "", "a\nb", "../x", "1"),
    *([], [[]], [1, "a"], {}, {"a": {}}, "\ud800", "\x1b[2J", [0] * 1000),
)
SHAPES = ((0,), (0, 0), (1,), (7,), (3, 5), (1, 2, 3), (10_000,), (300, 300))
DTYPES = ("float64", "float16", "int64", "uint8", "bool", "int32")


@dataclass(frozen=True)
class Reader:
    """A file, and the code that reads it."""

    name: str
    folder: Path
    file: str
    """Path in the folder."""
    read: Callable[[Path], object]
    """Reads the folder."""
    slow: bool = False
    named: str = ""
    """How messages name the file, if not by its name."""

    def fuzz(self, folder: Path, cases: int, seed: int) -> Counter[str]:
        """Read the file, one that is none, and `cases` mutated ones."""
        return _run_batches(partial(_fuzz_batch, self, folder / "fuzz", seed), folder, cases)

    def flip(self, folder: Path, cases: int, seed: int) -> Counter[str]:
        """Flip single bits of all files of the folder, and read everything of it."""
        return _run_batches(partial(_flip_batch, self, folder / "flips", seed), folder, cases)


def _run_batches(work: Callable[[range], Counter[str]], folder: Path, cases: int) -> Counter[str]:
    """The counts of `work` for so many cases, in processes of their own."""
    counts, answer = Counter[str](), folder / "counts.json"
    for begin in range(0, cases, BATCH):

        def count(numbers: range) -> int:
            answer.write_text(json.dumps(work(numbers)))
            return 0

        answer.unlink(missing_ok=True)
        batch = partial(count, range(begin, min(begin + BATCH, cases)))
        end = Running(batch).wait(SECONDS * 60)
        if answer.exists():
            counts.update(json.loads(answer.read_text()))
        if end.status:
            last = end.printed.strip().splitlines()[-1:] or [""]
            counts[f"a process ended with {end.status}: {last[0][:150]}"] += 1
    return counts


def _copy_folder(reader: Reader, place: Path) -> None:
    """Get this process ready to read files that the reader may choke on."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.signal(signal.SIGALRM, _raise_hung)
    warnings.simplefilter("ignore")
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(reader.folder, place, copy_function=os.link)


def _fuzz_batch(reader: Reader, place: Path, seed: int, numbers: range) -> Counter[str]:
    _copy_folder(reader, place)
    path, content = place / reader.file, (reader.folder / reader.file).read_bytes()
    counts = Counter[str]()
    if (outcome := _read(reader, place)[0]) != "harmless":
        counts[f"the file as it was written is {outcome}"] += 1
    _write_file(path, b"\xff[{\n\x00".ljust(len(content), b"\x00"))
    _reseal(place, reader.file)
    outcome, said = _read(reader, place)
    if outcome != "found" or (reader.named or path.name) not in said:
        counts[f"no file of any kind is {outcome}: {said!s:.80}"] += 1
    for number in numbers:
        generator = random.Random(f"{seed} {reader.name} {number}")
        _write_file(path, _mutate(generator, content, path, number))
        _reseal(place, reader.file)
        counts[_read(reader, place)[0]] += 1
    return counts


def _raise_hung(*_: object) -> None:
    raise TimeoutError


def _read(reader: Reader, place: Path) -> tuple[str, Any]:
    """What came of reading: "found" with the message, "harmless" with the content, or a fault."""
    from ucfrec.errors import InputError

    signal.alarm(SECONDS)
    try:
        return "harmless", reader.read(place)
    except InputError as error:
        return "found" if str(error).isprintable() else "not one printable line", str(error)
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
            return "found", str(error)  # a name that the file gives; commands explain it
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "ucfrec" in f.filename]
        return f"{type(error).__name__} {(ours or [''])[-1]}: {error!s:.80}", None
    finally:
        signal.alarm(0)


def _flip_batch(reader: Reader, place: Path, seed: int, numbers: range) -> Counter[str]:
    expected, counts = pickle.dumps(reader.read(reader.folder)), Counter[str]()
    _copy_folder(reader, place)
    files = sorted(path for path in place.rglob("*") if path.is_file() and path.stat().st_size)
    for number in numbers:
        generator = random.Random(f"{seed} {reader.name} {number}")
        path = generator.choice(files)
        written = path.read_bytes()
        flipped = bytearray(written)
        flipped[generator.randrange(len(flipped))] ^= 1 << generator.randrange(8)
        _write_file(path, bytes(flipped))
        outcome, content = _read(reader, place)
        if outcome == "harmless" and pickle.dumps(content) != expected:
            outcome = "silently another content"
        fault = f"{path.relative_to(place).as_posix()}: {outcome}"
        counts[outcome if outcome in ("found", "harmless") else fault] += 1
        _write_file(path, written)
    return counts


def _write_file(path: Path, content: bytes) -> None:
    """Write a new file: the old one may be a link, or still mapped."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)


def _reseal(place: Path, file: str) -> None:
    """Put the checksum of a changed file into the record of its folder, if that lists it."""
    from ucfrec.files.atomic import read_json, write_json
    from ucfrec.files.record import file_checksum

    for record in (place / "run.json", place / "meta.json"):
        if record.exists() and record.name != file:
            value = read_json(record)
            if file in value["files"]:
                path = place / file
                value["files"][file] = [path.stat().st_size, file_checksum(path)]
                record.unlink()
                write_json(record, value, seal=True)


def _mutate(generator: random.Random, content: bytes, path: Path, number: int) -> bytes:
    if number % 4:
        if path.suffix == ".safetensors":
            return _mutate_tensors(generator, content, path)
        if path.suffix == ".json":
            return _mutate_json(generator, content)
        if path.suffix == ".jsonl":
            lines = content.splitlines()
            at = generator.randrange(len(lines))
            lines[at] = _mutate_json(generator, lines[at]).replace(b"\n", b" ")
            return b"\n".join(lines) + b"\n"
    return _mutate_bytes(generator, content)


def _mutate_json(generator: random.Random, content: bytes) -> bytes:
    """JSON in which values are other ones, without its own checksum."""
    value = json.loads(content)
    if isinstance(value, dict):
        value.pop("checksum", None)
    for _ in range(generator.choice((1, 1, 1, 2, 5))):
        place, inner = None, value
        while isinstance(inner, dict | list) and inner:
            place = inner
            key = generator.choice([*inner] if isinstance(inner, dict) else range(len(inner)))
            inner = place[key]
            if generator.random() < 0.4:
                break
        if place is None:
            return json.dumps(generator.choice(VALUES)).encode()
        if generator.random() < 0.2:
            del place[key]
        else:
            place[key] = deepcopy(generator.choice(VALUES))
    return json.dumps(value).encode()


def _mutate_tensors(generator: random.Random, content: bytes, path: Path) -> bytes:
    """Safetensors with other tensors and metadata, as ucfrec would write them."""
    import torch

    from ucfrec.fitting.checkpoint import load_tensors, save_tensors

    copy = path.with_name("original.safetensors")
    _write_file(copy, content)
    tensors, metadata = load_tensors(copy)
    for _ in range(generator.choice((1, 1, 2, 4))):
        name = generator.choice([*tensors] or ["new"])
        was, shape = tensors.pop(name, torch.zeros(3)), generator.choice(SHAPES)
        number = generator.choice((-1, 0, 100, float("nan"), float("inf")))
        changes: tuple[dict[str, Any], ...] = (
            {},
            {name: was, f"{name}s": was.clone()},
            {name: was.to(getattr(torch, generator.choice(DTYPES)))},
            {name: was.reshape(-1)},
            {name: was[: len(was) // 2] if was.dim() else was.unsqueeze(0)},
            {name: (was * 0 + number).to(was.dtype)},
            {name: torch.zeros(shape, dtype=was.dtype)},
        )
        tensors |= generator.choice(changes)
    tensors = {name: tensor.clone() for name, tensor in tensors.items()}
    if generator.random() < 0.4:
        changed = json.loads(_mutate_json(generator, json.dumps(metadata).encode()))
        metadata = changed if isinstance(changed, dict) else {"changed": changed}
    save_tensors(copy, tensors, metadata)
    mutant = copy.read_bytes()
    copy.unlink()
    return mutant


def _mutate_bytes(generator: random.Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(generator.choice((1, 1, 2, 4, 16))):
        at = generator.randrange(len(changed) + 1)
        if generator.random() < 0.5:
            at = min(at, generator.randrange(256))  # headers lie at the beginning
        word = generator.choice((*WORDS, bytes([generator.randrange(256)]), b""))
        removed = generator.choice((0, 1, 4, 100, len(word), len(changed)))
        changed[at : at + removed] = word
    return bytes(changed)


def list_readers(inputs: Inputs) -> list[Reader]:
    """The readers of every kind of file."""
    from ucfrec.files.parquet import read_ids
    from ucfrec.fitting.checkpoint import load_tensors, read_metrics
    from ucfrec.logs.mapping import read_mapping
    from ucfrec.logs.prepare import validate
    from ucfrec.reporting.page import write_report
    from ucfrec.results.rows import read_results, read_rows
    from ucfrec.runs.config import resolve_config
    from ucfrec_control.data.d4rl import read_d4rl

    store, run, texts = inputs.store, inputs.single_run, inputs.texts

    def report(folder: Path) -> object:
        return write_report(folder.with_name("out.html"), [folder])

    def report_results(file: Path) -> object:
        return write_report(file.with_name("out.html"), [inputs.run], [file])

    def read_setting(file: Path) -> object:
        return resolve_config(overrides=[file.read_bytes().decode("utf-8", "replace")])

    def read_log(file: Path) -> object:
        return validate([file], read_mapping(file.with_name("empty.toml")))

    def lone(folder: Path, file: str, read: Callable[[Path], object], slow: bool = False) -> Reader:
        """What reads one file, whatever lies beside it."""
        return Reader(f"{Path(file).name} alone", folder, file, lambda at: read(at / file), slow)

    of_store = ("meta.json", "item_states.safetensors", "users.parquet", "items.parquet")
    of_store += ("shard-00000/reward.npy", "shard-00000/offsets.npy")
    of_run = ("run.json", "decision_rule.json", "policy/best.safetensors", "items.parquet")
    of_run += ("reward_model/item_reward.safetensors", "item_states.safetensors")
    of_run += ("training_counts.safetensors", "training_returns.safetensors")
    return [
        *(Reader(file, store, file, read_store) for file in of_store),
        *(Reader(f"run: {file}", run, file, read_run, slow=True) for file in of_run),
        Reader("report: run.json", run, "run.json", report, slow=True),
        Reader("report: samples.json", run, "samples.json", report, slow=True),
        lone(run, "policy/last.safetensors", load_tensors),
        lone(run, "policy/metrics.jsonl", lambda file: read_metrics(file.parent)),
        lone(run, "items.parquet", lambda file: read_ids(file, "item_id")),
        lone(texts, "rows.jsonl", read_rows),
        lone(texts, "evaluations.json", read_results),
        replace(lone(texts, "evaluations.json", report_results, True), name="report: evaluations"),
        lone(texts, "mapping.toml", read_mapping),
        lone(texts, "config.toml", lambda file: resolve_config(file=file)),
        replace(lone(texts, "setting.txt", read_setting), named="--set"),
        lone(texts, "log.csv", read_log, slow=True),
        lone(texts, "log.parquet", read_log, slow=True),
        lone(texts, "hopper.hdf5", read_d4rl),
    ]


def read_store(path: Path) -> list[Any]:
    """All that ucfrec reads of a store."""
    from ucfrec import schema
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.files.parquet import read_ids
    from ucfrec.files.record import SMALL

    store = EpisodeStore.open(path)
    columns = [store.step_values(name, *store.all_steps()) for name in store.record.columns]
    episodes = [store.episode_values(name) for name in schema.EPISODE_DTYPES]
    states = store.item_states
    store.record.require(path, small=SMALL)
    ids = [read_ids(path / f"{name}.parquet", f"{name[:-1]}_id") for name in ("users", "items")]
    used = ("n_steps", "n_episodes", "reward", "fingerprint", "source", "splits")
    meta = {name: getattr(store.record, name) for name in used}
    return [*columns, *episodes, states.embeddings.numpy(), states.reward_high, *ids, repr(meta)]


def read_run(path: Path) -> list[Any]:
    """All that ucfrec reads of a run, and how its policy acts."""
    from ucfrec.fitting.checkpoint import read_metrics
    from ucfrec.runs.trained_policy import TrainedPolicy

    parts: list[Any] = []
    for checkpoint in ("last", "best"):
        trained = TrainedPolicy.load(path, checkpoint)
        parts += [tensor.numpy() for tensor in trained.policy.state_dict().values()]
        parts += [trained.item_ids, trained.user_ids]
    observations = np.zeros((2, trained.record.observation_size), dtype=np.float32)
    parts.append(trained.actor(2).act(observations, np.array([True, False])))
    used = ("config", "sizes", "return_quantiles", "reward", "fingerprint", "train_steps")
    parts.append(repr({name: getattr(trained.record, name) for name in used}))
    return [*parts, repr(read_metrics(path / "policy"))]
