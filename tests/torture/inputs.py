"""Small inputs of every kind, the commands that use them, and digests of their outputs."""

import hashlib
import json
import os
import shutil
import signal
import socket
import tempfile
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pandas as pd

from tests.torture.children import command, run_first

TINY = (
    *("train.steps=30", "train.validate_every=10", "policy.dim=8", "policy.context=4"),
    *("crm.epochs=1", "crm.hidden=16", "csg.epochs=1", "rule.sessions=10", "rule.quantiles=[1.0]"),
    *("rule.temperatures=[0.0,1.0]", "rule.reward_weights=[0.0,1.0]", "rule.tag_windows=[0]"),
)
SETTINGS = [part for setting in TINY for part in ("--set", setting)]
_TIMED = ("seconds", "wall_time_s", "checksum", "per_second", "memory", "commit", "command")


@dataclass(frozen=True)
class Job:
    """A command that writes something."""

    name: str
    arguments: Callable[[Path], list[object]]
    """Arguments of the command that writes to the given path."""
    out: str
    """Name of what it writes."""
    second: str
    """What a second process does: it is "refused", "resumes", "waits" and writes again, or
    "serves", which adds a file."""


def require_done(*arguments: object) -> None:
    if (end := run_first(command(*arguments))).status:
        raise SystemExit(f"{arguments[0]}: {end.printed}")


class Inputs:
    """Logs, a store, a run and small files of other kinds, made once."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.texts = folder, folder / "texts"
        self.logs, self.store, self.run = folder / "logs", folder / "store", folder / "run"
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        for job, out in zip(self.jobs(), (self.logs, self.store, self.run), strict=False):
            require_done(*job.arguments(out))
        self.single_run = folder / "single-run"
        # Readers of a run with a refit read the files of the refit.
        shutil.copytree(self.run, self.single_run, ignore=shutil.ignore_patterns("refit"))
        self.texts.mkdir()
        self._write_texts()
        self._write_logs()

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
        write_hdf5(self.texts / "hopper.hdf5", hopper_like())

    def _write_logs(self) -> None:
        """A log as CSV and as Parquet, one of later sessions, and exposures with their feedback."""
        count = np.arange(40)
        frame = pd.DataFrame({"user_id": count % 5, "item_id": (count % 7).astype(str)})
        frame["timestamp"], frame["reward"] = 1_700_000_000_000 + count, count % 2
        frame.to_csv(self.texts / "log.csv", index=False)
        frame.to_parquet(self.texts / "log.parquet")
        later = pd.read_parquet(self.log)
        later["timestamp"] += np.ptp(later["timestamp"]) + 86_400_000
        later.to_parquet(self.texts / "later.parquet")
        shown = self.texts / "shown.parquet"
        options = ("--out", self.texts / "lists.parquet", "--exposures", shown)
        require_done("recommend", self.run, self.log, *options)
        clicks = pd.read_parquet(shown)[["user_id", "item_id", "timestamp"]]
        clicks = clicks.assign(timestamp=clicks.timestamp + 1000, is_click=1)
        clicks[::3].to_parquet(self.texts / "clicks.parquet")

    @property
    def log(self) -> Path:
        return self.logs / "sessions.parquet"

    def jobs(self) -> list[Job]:
        """Every command that writes; the first make what the others read."""
        run, log, texts = self.run, self.log, self.texts
        simulator, trials = ("--env", "synthetic-catalog"), ("--trials", 1, "--no-pruning")
        joined = (texts / "shown.parquet", texts / "clicks.parquet", "--within", "1h")
        served = (run, "--port", self.port, "--threads", 1)
        options: dict[str, tuple[str, str, tuple[object, ...]]] = {
            "collect": ("out", "refused", (*simulator, "--sessions", 60, "--out")),
            "prepare": ("out", "refused", (log, "--reward", "is_click", "--out")),
            "train": ("out", "resumes", (self.store, *SETTINGS, "--out")),
            "update": ("out", "resumes", (run, texts / "later.parquet", "--out")),
            "tune": ("out", "resumes", (self.store, *SETTINGS, *trials, "--out")),
            "join": ("out.parquet", "waits", (*joined, "--out")),
            "recommend": ("out.parquet", "waits", (run, log, "--out")),
            "score": ("out.parquet", "waits", (run, log, "--out")),
            "ope": ("out.json", "waits", (run, log, "--json")),
            "evaluate": ("out.json", "waits", (run, *simulator, "--episodes", 20, "--json")),
            "report": ("out.html", "waits", (run, "--out")),
            "serve": ("out", "serves", (*served, "--exposures")),
        }
        return [
            *(
                Job(name, lambda out, n=name, o=own: [n, *o, out], file, second)
                for name, (file, second, own) in options.items()
            ),
            Job("promote", self._promote, "promoted.json", "waits"),
        ]

    def _promote(self, out: Path) -> list[object]:
        """The command writes beside the run, so `out` gets one."""
        with suppress(OSError):
            shutil.copytree(self.single_run, out.parent / "promotable", copy_function=os.link)
        return ["promote", out.parent / "promotable"]

    def work(self, job: Job, out: Path) -> Callable[[], int]:
        """The command, for a fork; a thread asks a server, and ends it."""

        def work() -> int:
            if job.second == "serves":
                Thread(target=self._ask, daemon=True).start()
            return command(*job.arguments(out))()

        return work

    def _ask(self) -> None:
        address = f"http://127.0.0.1:{self.port}/recommendations"
        rows = pd.read_parquet(self.log).head(1)
        history = rows.drop(columns="user_id").to_json(orient="records")
        for user in range(5):
            body = f'{{"user_id": {user}, "request_id": "{user}", "history": {history}}}'.encode()
            for _ in range(2000):
                with suppress(OSError):
                    urllib.request.urlopen(address, body, timeout=60).close()
                    break
                time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)


def digest_output(path: Path) -> str:
    """A digest of an output, without times and names of folders; raises if a file is not whole."""
    from ucfrec.files.atomic import LOCK, SCRATCH

    contents = {b"": _content(path)} if path.is_file() else dict[bytes, bytes]()
    for file in filter(Path.is_file, path.rglob("*")):
        name, parts = file.relative_to(path).as_posix(), file.relative_to(path).parts
        if not any(part.endswith((LOCK, SCRATCH)) for part in parts) and "events" not in name:
            content = _content(file)
            # Files of exposures have names of their own; a search tries other settings each time.
            if not name.startswith(("trial-", "stages", "best", "study.db", "tuning.md")):
                contents[content if name.startswith("exposures-") else name.encode()] = content
    return hashlib.sha256(repr(sorted(contents.items())).encode()).hexdigest()


def _content(file: Path) -> bytes:
    """What a file says that is the same each time."""
    from ucfrec.fitting.checkpoint import load_tensors, read_metrics

    if not file.stat().st_size and file.name != "metrics.jsonl":
        raise ValueError(f"{file.name} is empty")
    if file.name.startswith("exposures-"):
        shown = pd.read_parquet(file).drop(columns="timestamp").drop_duplicates()
        return shown.sort_values(["user_id", "position"]).to_csv(index=False).encode()
    if file.suffix == ".parquet":
        pd.read_parquet(file)
    if file.suffix == ".safetensors":
        tensors, _ = load_tensors(file)
        parts = ((k.encode(), v.contiguous().numpy().tobytes()) for k, v in sorted(tensors.items()))
        return b"".join(name + values for name, values in parts)
    if file.name == "metrics.jsonl":
        return repr(read_metrics(file.parent).get("validation_loss")).encode()
    if file.suffix == ".json":
        value = json.loads(file.read_text())
        if file.name == "meta.json":
            return str(value["fingerprint"]).encode()
        return b"" if file.name in ("run.json", "collect.json") else repr(_numbers(value)).encode()
    # A page has times of training and the name of its run.
    return file.read_bytes() if file.suffix != ".html" else b""


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _numbers(v) for k, v in value.items() if not any(t in k for t in _TIMED)}
    if isinstance(value, list):
        return [_numbers(entry) for entry in value]
    return value if isinstance(value, int | float) else None


def use_temporary(folder: Path) -> None:
    """Make a folder inside `folder` the one for temporary files."""
    tempfile.tempdir = None
    os.environ["TMPDIR"] = str(folder / "tmp")
    (folder / "tmp").mkdir()
