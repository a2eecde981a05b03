"""Small inputs of every kind, the commands that use them, and digests of their outputs."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from tests.torture.children import run_first

TINY = (
    *("train.steps=30", "train.validate_every=10", "policy.dim=8", "policy.context=4"),
    *("crm.epochs=1", "crm.hidden=16", "csg.epochs=1", "rule.sessions=10", "rule.quantiles=[1.0]"),
    *("rule.temperatures=[0.0,1.0]", "rule.reward_weights=[0.0,1.0]", "rule.tag_windows=[0]"),
)
SETTINGS = [part for setting in TINY for part in ("--set", setting)]


@dataclass(frozen=True)
class Job:
    """A command that writes something."""

    name: str
    arguments: Callable[[Path], list[object]]
    """Arguments of the command that writes to the given path."""
    suffix: str = ""
    waits: bool = False
    """Whether the second of two processes waits for the first, instead of being refused."""


def require_done(*arguments: object) -> None:
    end = run_first(*arguments)
    if end.status:
        raise SystemExit(f"{arguments[0]}: {end.printed}")


class Inputs:
    """Logs, a store, a run and small files of other kinds, made once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.logs, self.store, self.run = folder / "logs", folder / "store", folder / "run"
        for job, out in zip(self.jobs(), (self.logs, self.store, self.run), strict=False):
            require_done(*job.arguments(out))
        self.single_run, self.texts = folder / "single-run", folder / "texts"
        # Readers of a run with a refit read the files of the refit.
        shutil.copytree(self.run, self.single_run, ignore=shutil.ignore_patterns("refit"))
        self.texts.mkdir()
        self._write_texts()

    def _write_texts(self) -> None:
        from tests.support.control_files import hopper_like, write_hdf5

        def write(name: str, text: str) -> None:
            (self.texts / name).write_text(text)

        row = {"suite": "s", "table": "t", "task": "a", "method": "m", "policy": "p"}
        values = {"metric": "r", "metrics": {"r": 1.0}, "interval": [0.5, 1.5]}
        write("rows.jsonl", f"{json.dumps({**row, **values, 'conditions': {'b': 1}})}\n" * 3)
        options = ("--episodes", 20, "--json", self.texts / "evaluations.json")
        require_done("evaluate", self.run, "--env", "synthetic-catalog", *options)
        mapping = 'reward = "is_click"\nsession_by = "gap"\n[columns]\nuser_id = "uid"\n'
        mapping += 'timestamp = "seconds * 1000"\n[[item_features]]\nfiles = ["items.csv"]\n'
        write("mapping.toml", f'{mapping}key = "iid"\ncolumns = ["ln(1 + price)"]\n')
        write("empty.toml", "")
        train = "[train]\nsteps = 20\nlearning_rate = 1e-3\n"
        write("config.toml", f"{train}[policy]\ndim = 16\n[csg]\nband = [0.2, 0.5]\n")
        write("setting.txt", "train.steps=200")
        count = np.arange(40)
        frame = pd.DataFrame({"user_id": count % 5, "item_id": (count % 7).astype(str)})
        frame["timestamp"], frame["reward"] = 1_700_000_000_000 + count, count % 2
        frame.to_csv(self.texts / "log.csv", index=False)
        frame.to_parquet(self.texts / "log.parquet")
        write_hdf5(self.texts / "hopper.hdf5", hopper_like())

    @property
    def log(self) -> Path:
        return self.logs / "sessions.parquet"

    def jobs(self) -> list[Job]:
        environment = ("--env", "synthetic-catalog")
        of_run: dict[str, tuple[str, list[object]]] = {
            "recommend": (".parquet", [self.log, "--out"]),
            "score": (".parquet", [self.log, "--out"]),
            "ope": (".json", [self.log, "--json"]),
            "evaluate": (".json", [*environment, "--episodes", 20, "--json"]),
            "report": (".html", ["--out"]),
        }
        return [
            Job("collect", lambda out: ["collect", *environment, "--sessions", 60, "--out", out]),
            Job("prepare", lambda out: ["prepare", self.log, "--out", out, "--reward", "is_click"]),
            Job("train", lambda out: ["train", self.store, "--out", out, *SETTINGS]),
            *(
                Job(name, lambda out, n=name, o=own: [n, self.run, *o, out], suffix, waits=True)
                for name, (suffix, own) in of_run.items()
            ),
        ]


def digest_output(path: Path) -> str:
    """A digest of an output, without times and names of folders."""
    digest = hashlib.sha256()
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    for file in filter(Path.is_file, files):
        if file.name not in ("run.json", "collect.json") and "events" not in str(file):
            name = file.relative_to(path).as_posix() if path.is_dir() else ""
            digest.update(f"{name}:".encode() + _content(file))
    return digest.hexdigest()


def _content(file: Path) -> bytes:
    if file.suffix == ".safetensors":
        from ucfrec.fitting.checkpoint import load_tensors

        tensors, _ = load_tensors(file)
        parts = ((k.encode(), v.contiguous().numpy().tobytes()) for k, v in sorted(tensors.items()))
        return b"".join(name + values for name, values in parts)
    if file.name == "meta.json":
        return json.dumps(json.loads(file.read_text())["fingerprint"]).encode()
    if file.name == "metrics.jsonl":
        rows = [json.loads(line) for line in file.read_text().splitlines()]
        last = {row["step"]: row.get("validation_loss") for row in rows}
        return json.dumps(sorted(last.items())).encode()
    if file.suffix == ".json":
        return json.dumps(_numbers(json.loads(file.read_text()))).encode()
    if file.suffix == ".html":
        return b""  # has times of training and the name of its run
    return file.read_bytes()


def _numbers(value: object) -> object:
    if isinstance(value, dict):
        timed = ("seconds", "wall_time_s", "checksum", "per_second", "memory", "commit", "command")
        return {k: _numbers(v) for k, v in value.items() if not any(t in k for t in timed)}
    if isinstance(value, list):
        return [_numbers(entry) for entry in value]
    return value if isinstance(value, int | float) else None


def use_temporary(folder: Path) -> None:
    """Make a folder inside `folder` the one for temporary files."""
    tempfile.tempdir = None
    os.environ["TMPDIR"] = str(folder / "tmp")
    (folder / "tmp").mkdir()
