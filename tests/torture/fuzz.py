"""Every reader on files that were cut, spliced, and filled with other values."""

import json
import os
import random
import resource
import shutil
import signal
import struct
import warnings
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

from tests.torture.children import Running
from tests.torture.made import Inputs

_BATCH = 500
_SECONDS = 20
"""Seconds after which reading one file counts as hung."""
_MEMORY = 24 * 2**30
_WORDS = [
    *(
        b"\x00",
        b"\xff\xfe",
        b"\n",
        b"\r\n",
        b'"',
        b"{",
        b"}",
        b"[" * 3000,
        b"null",
        b"NaN",
        b"1e999",
    ),
    *(b"1e999", b"-1", b"9" * 5000, b"4294967296", b"true", b"../../etc/passwd", b"\x1b[31m"),
    *(b"\x89HDF\r\n\x1a\n", b"\xff" * 8, b"\x00" * 64, b"\xe2\x80\xa8", b"int64", b"'|O'", b"'"),
]
_VALUES: list[Any] = [
    *(None, True, -1, 0, 10**12, 10**400, 1.5, float("nan"), float("inf"), "", "a\nb", "../x", "1"),
    *([], [[]], [1, "a"], {}, {"a": {}}, "\ud800", "\x1b[2J", [0] * 1000),
]
_SHAPES = [(0,), (0, 0), (1,), (7,), (3, 5), (1, 2, 3), (10_000,), (300, 300)]
_DTYPES = ("float64", "float16", "int64", "uint8", "bool", "int32")
_SLOW = (
    *("run.json", "run.json in a report", "samples in a report", "augmentation in a report"),
    *("evaluations in a report", "log.csv", "log.parquet", "decision rule", "policy"),
    *("reward model", "item states of a run", "training counts", "training returns"),
    "items of a run",
)
"""Readers that take longest: they draw charts, start a database, or build a policy."""
Reader = Callable[[Path], object]


def shares(cases: int, inputs: Inputs) -> dict[str, int]:
    """Number of cases of each reader; the slow ones have a tenth of the others' share."""
    weights = {name: 1 if name in _SLOW else 10 for name in _targets(inputs)} if cases else {}
    total = sum(weights.values())
    return {name: -(-cases * weight // total) for name, weight in weights.items()}


def fuzz(inputs: Inputs, name: str, folder: Path, cases: int, seed: int) -> Counter[str]:
    """Give one reader `cases` files."""
    counts = Counter[str]()
    place = folder / "fuzz"
    for begin in range(0, cases, _BATCH):
        numbers = range(begin, min(begin + _BATCH, cases))
        answer = folder / "fuzz.json"
        answer.unlink(missing_ok=True)
        work = partial(_batch, inputs, place, name, numbers, seed, answer)
        end = Running(work).wait(_SECONDS * 60)
        if answer.exists():
            counts.update(json.loads(answer.read_text()))
        if end.status:
            last = end.printed.strip().splitlines()[-1:] or [""]
            counts[f"a process ended with {end.status}: {last[0][:150]}"] += 1
    return counts


class _HungError(Exception):
    pass


def _alarm(*_: object) -> None:
    raise _HungError


def _batch(inputs: Inputs, place: Path, name: str, numbers: range, seed: int, answer: Path) -> int:
    from ucfrec.errors import InputError

    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    signal.signal(signal.SIGALRM, _alarm)
    source, changed, read = _targets(inputs)[name]
    warnings.simplefilter("ignore")
    counts = Counter[str]()
    shutil.rmtree(place, ignore_errors=True)
    if source.is_dir():
        shutil.copytree(source, place, copy_function=os.link)
    else:
        place.mkdir()
    path = place / changed
    content = (source / changed if source.is_dir() else source).read_bytes()
    for number in numbers:
        generator = random.Random(f"{seed} {name} {number}")
        path.unlink(missing_ok=True)
        path.write_bytes(_mutated(generator, content, path.suffix, number))
        signal.alarm(_SECONDS)
        try:
            read(path)
        except InputError as error:
            counts["found"] += 1
            if not str(error).isprintable():
                counts["not one printable line"] += 1
        except _HungError:
            counts["hung"] += 1
        except MemoryError:
            counts["MemoryError"] += 1
        except Exception as error:
            where = _where(error)
            counts[f"{type(error).__name__} {where}: {str(error)[:80]}"] += 1
        else:
            counts["harmless"] += 1
        finally:
            signal.alarm(0)
    answer.write_text(json.dumps(counts))
    return 0


def _where(error: BaseException) -> str:
    """The last place in ucfrec that the error passed."""
    place, step = "", error.__traceback__
    while step is not None:
        file = step.tb_frame.f_code.co_filename
        if "ucfrec" in file:
            place = f"{Path(file).name}:{step.tb_lineno}"
        step = step.tb_next
    return place


def _mutated(generator: random.Random, content: bytes, suffix: str, number: int) -> bytes:
    if suffix == ".safetensors" and number % 4:
        return _other_tensors(generator, content)
    if suffix == ".json" and number % 4:
        return _other_values(generator, content)
    if suffix == ".jsonl" and number % 4:
        lines = content.splitlines()
        at = generator.randrange(len(lines))
        lines[at] = _other_values(generator, lines[at]).replace(b"\n", b" ")
        return b"\n".join(lines) + b"\n"
    return _other_bytes(generator, content)


def _other_values(generator: random.Random, content: bytes) -> bytes:
    """JSON in which values are other ones, without checksums, which would find every change."""
    value = json.loads(content)
    if isinstance(value, dict):
        value.pop("checksum", None)
        if generator.random() < 0.7:
            value.pop("files", None)
    for _ in range(generator.choice((1, 1, 1, 2, 5))):
        place, key = _place(generator, value)
        if place is None:
            return json.dumps(generator.choice(_VALUES)).encode()
        if generator.random() < 0.2:
            del place[key]
        else:
            place[key] = deepcopy(generator.choice(_VALUES))
    return json.dumps(value).encode()


def _place(generator: random.Random, value: Any) -> tuple[Any, Any]:
    place, key = None, None
    while isinstance(value, dict | list) and value:
        place = value
        key = generator.choice([*value] if isinstance(value, dict) else range(len(value)))
        value = place[key]
        if generator.random() < 0.4:
            break
    return place, key


def _other_tensors(generator: random.Random, content: bytes) -> bytes:
    """Safetensors with other tensors and numbers, and the checksum of these."""
    import torch
    from safetensors.torch import load, save

    from ucfrec.fitting.checkpoint import _checksum

    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    about, _, _ = header["__metadata__"]["about"].partition("\n")
    tensors = load(content)
    for _ in range(generator.choice((1, 1, 2, 4))):
        name = generator.choice([*tensors] or ["new"])
        tensor = tensors.pop(name, torch.zeros(3))
        match generator.randrange(8):
            case 0:
                continue
            case 1:
                tensors[name + "s"] = tensor
            case 2:
                tensor = tensor.to(getattr(torch, generator.choice(_DTYPES)))
            case 3:
                tensor = tensor.reshape(-1)
            case 4:
                tensor = tensor[: len(tensor) // 2] if tensor.dim() else tensor.unsqueeze(0)
            case 5:
                tensor = torch.cat([tensor, tensor]) if tensor.dim() else tensor
            case 6:
                value = generator.choice((-1, 0, 100, float("nan"), float("inf")))
                if tensor.is_floating_point() or isinstance(value, int):
                    tensor = torch.full_like(
                        tensor, value != 0 if tensor.dtype == torch.bool else value
                    )
            case 7:
                tensor = torch.zeros(generator.choice(_SHAPES), dtype=tensor.dtype)
        tensors[name] = tensor.contiguous()
    if generator.random() < 0.4:
        about = _other_values(generator, about.encode()).decode()
    plain = {name: tensor.clone() for name, tensor in tensors.items()}
    return save(plain, {"about": f"{about}\n{_checksum(plain, about)}"})


def _other_bytes(generator: random.Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(generator.choice((1, 1, 2, 4, 16))):
        at = generator.randrange(len(changed) + 1)
        if generator.random() < 0.5:
            at = min(at, generator.randrange(256))  # headers lie at the beginning
        match generator.randrange(6):
            case 0:
                changed[at : at + 1] = bytes([generator.randrange(256)])
            case 1:
                changed[at:at] = generator.choice(_WORDS)
            case 2:
                del changed[at : at + generator.choice((1, 4, 100))]
            case 3:
                del changed[at:]
            case 4:
                word = generator.choice(_WORDS)
                changed[at : at + len(word)] = word
            case 5:
                begin = generator.randrange(len(changed) + 1)
                changed[at:at] = changed[begin : begin + generator.randrange(64)]
    return bytes(changed)


def _targets(inputs: Inputs) -> dict[str, tuple[Path, str, Reader]]:
    """Name of a reader to (file or folder, the file in it that is changed, the reader)."""
    texts = _texts(inputs)
    found = {**_of_stores(inputs), **_of_runs(inputs)}
    for name, (file, reader) in _of_texts(inputs, texts).items():
        found[name] = (texts / file, file, reader)
    return found


def _of_stores(inputs: Inputs) -> dict[str, tuple[Path, str, Reader]]:
    from tests.torture.damage import read_store

    unsealed = _unsealed(inputs)

    def read(levels: int) -> Reader:
        return lambda path: read_store(path.parents[levels - 1])

    return {
        "meta.json": (inputs.store, "meta.json", read(1)),
        "column.npy": (unsealed, "shard-00000/reward.npy", read(2)),
        "offsets.npy": (unsealed, "shard-00000/offsets.npy", read(2)),
        "item states": (unsealed, "item_states.safetensors", read(1)),
    }


def _acts(levels: int) -> Reader:
    """Loads the policy of the run so many folders above, and lets it act."""

    def read(path: Path) -> object:
        import numpy as np

        from ucfrec.runs.trained_policy import TrainedPolicy

        trained = TrainedPolicy.load(path.parents[levels - 1])
        observations = np.zeros((2, trained.record.observation_size), dtype=np.float32)
        return trained.actor(2).act(observations, np.array([True, False]))

    return read


def _of_runs(inputs: Inputs) -> dict[str, tuple[Path, str, Reader]]:
    from tests.torture.damage import read_run
    from ucfrec.episodes.windows import Overlay
    from ucfrec.files.parquet import read_ids
    from ucfrec.fitting.checkpoint import load_tensors
    from ucfrec.fitting.metrics_log import read_metrics
    from ucfrec.reporting.page import write_report

    run, unsealed = inputs.run, _unsealed_run(inputs)

    def page(path: Path) -> object:
        return write_report(path.parent / "out.html", [path.parent])

    return {
        "run.json": (run, "run.json", lambda path: read_run(path.parent)),
        "run.json in a report": (run, "run.json", page),
        "samples in a report": (unsealed, "samples.json", page),
        "augmentation in a report": (unsealed, "augmentation.json", page),
        "decision rule": (unsealed, "decision_rule.json", _acts(1)),
        "policy": (unsealed, "policy/best.safetensors", _acts(2)),
        "reward model": (unsealed, "reward_model/item_reward.safetensors", _acts(2)),
        "item states of a run": (unsealed, "item_states.safetensors", _acts(1)),
        "training counts": (unsealed, "training_counts.safetensors", _acts(1)),
        "training returns": (unsealed, "training_returns.safetensors", _acts(1)),
        "items of a run": (unsealed, "items.parquet", _acts(1)),
        "copies": (run, "overlay.safetensors", Overlay.load),
        "checkpoint": (run, "policy/best.safetensors", load_tensors),
        "metrics.jsonl": (run, "policy/metrics.jsonl", lambda path: read_metrics(path.parent)),
        "ids.parquet": (run, "items.parquet", lambda path: read_ids(path, "item_id")),
    }


def _of_texts(inputs: Inputs, texts: Path) -> dict[str, tuple[str, Reader]]:
    from ucfrec.logs.mapping import read_mapping
    from ucfrec.logs.prepare import validate
    from ucfrec.reporting.page import write_report
    from ucfrec.results.rows_file import read_results, read_rows
    from ucfrec.runs.config import resolve_config
    from ucfrec_control.data.d4rl import read_d4rl

    def one_setting(path: Path) -> object:
        return resolve_config(overrides=[path.read_bytes().decode("utf-8", "replace")])

    def validated(path: Path) -> object:
        return validate([path], read_mapping(texts / "empty.toml"))

    def page(path: Path) -> object:
        return write_report(path.parent / "out.html", [inputs.run], [path])

    return {
        "rows.jsonl": ("rows.jsonl", read_rows),
        "evaluations": ("evaluations.json", read_results),
        "evaluations in a report": ("evaluations.json", page),
        "mapping.toml": ("mapping.toml", read_mapping),
        "config.toml": ("config.toml", lambda path: resolve_config(file=path)),
        "a setting": ("setting.txt", one_setting),
        "log.csv": ("log.csv", validated),
        "log.parquet": ("log.parquet", validated),
        "D4RL": ("hopper.hdf5", read_d4rl),
    }


def _unsealed(inputs: Inputs) -> Path:
    """The store without checksums, which would find every change."""
    return _without(inputs.store, "meta.json")


def _unsealed_run(inputs: Inputs) -> Path:
    return _without(inputs.run, "run.json")


def _without(source: Path, record: str) -> Path:
    from ucfrec.files.atomic import read_json, write_json

    copy = source.with_name(f"{source.name}-unsealed")
    if not copy.exists():
        shutil.copytree(source, copy)
        value = read_json(copy / record)
        del value["files"]
        write_json(copy / record, value)
    return copy


def _texts(inputs: Inputs) -> Path:
    """Small files of every other kind."""
    folder = inputs.folder / "texts"
    if folder.exists():
        return folder
    from tests.support.control_files import hopper_like, write_hdf5
    from tests.torture.children import run

    folder.mkdir()
    row = {"suite": "s", "table": "t", "task": "a", "method": "m", "policy": "p", "metric": "r"}
    row |= {"metrics": {"r": 1.0}, "interval": [0.5, 1.5], "conditions": {"b": 1}}  # type: ignore[dict-item]
    (folder / "rows.jsonl").write_text(f"{json.dumps(row)}\n" * 3)
    evaluations = folder / "evaluations.json"
    environment = ("--env", "synthetic-catalog", "--episodes", 20, "--json", evaluations)
    if end := run("evaluate", inputs.run, *environment).status:
        raise SystemExit(f"evaluate ended with {end}")
    (folder / "mapping.toml").write_text(
        'reward = "is_click"\nsession_by = "gap"\n[columns]\nuser_id = "uid"\n'
        'timestamp = "seconds * 1000"\n[[item_features]]\nfiles = ["items.csv"]\n'
        'key = "iid"\ncolumns = ["ln(1 + price)"]\n'
    )
    (folder / "empty.toml").write_text("")
    (folder / "config.toml").write_text(
        "[train]\nsteps = 20\nlearning_rate = 1e-3\n[policy]\ndim = 16\n[csg]\nband = [0.2, 0.5]\n"
    )
    (folder / "setting.txt").write_text("train.steps=200")
    lines = [f"{i % 5},{i % 7},{1_700_000_000_000 + i},{i % 2}" for i in range(40)]
    (folder / "log.csv").write_text("\n".join(["user_id,item_id,timestamp,reward", *lines]) + "\n")
    write_hdf5(folder / "hopper.hdf5", hopper_like())
    import numpy as np
    import pandas as pd

    count = np.arange(40)
    frame = pd.DataFrame({"user_id": count % 5, "item_id": (count % 7).astype(str)})
    frame["timestamp"], frame["reward"] = 1_700_000_000_000 + count, count % 2
    frame.to_parquet(folder / "log.parquet")
    return folder
