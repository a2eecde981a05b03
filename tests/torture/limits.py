"""What the operating system refuses, and Parquet files that are more than they seem."""

import ctypes
import shutil
import signal
import subprocess
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tests.torture.children import Running, command, leftovers
from tests.torture.inputs import Inputs, Job

_SKIPPED = 75
"""Status where this system cannot do what a case needs."""
_BY_A_LIBRARY = (127, -signal.SIGABRT, -signal.SIGSEGV)
"""How libraries in C++ and the C library end a process that gets no memory, without asking us."""


def limits(inputs: Inputs, job: Job, folder: Path) -> Counter[str]:
    """The command on a read-only and a full disk, without room or memory, and without its input."""
    counts, place = Counter[str](), folder / "limits"
    (place / "there").mkdir(parents=True)
    (place / "file").write_text("")

    def expect(name: str, started: Running, *allowed: int) -> None:
        end = started.wait()
        counts["skipped" if end.status == _SKIPPED else "cases"] += 1
        # A server that loses rows is still ended by TERM.
        ended = (143,) if job.name == "serve" else ()
        if fault := end.fault((*allowed, *ended, 2, _SKIPPED)):
            counts[f"{name}: {fault}"] += 1
        counts["refused"] += end.status == 2
        counts["ended by a library"] += end.status in _BY_A_LIBRARY

    work = partial(inputs.work, job)
    # A search and a server take a folder that is there; `promote` names its file itself.
    wrong = [place / "file" / "out", place / ("n" * 254), place / "there"]
    wrong = wrong[: {"tune": 2, "serve": 1, "promote": 0}.get(job.name, 3)]
    for out in wrong:
        expect(f"out is {out.name[:20]}", Running(work(out)))
    expect("file too large", Running(work(place / "small" / job.out), largest=1000), 0)
    for megabytes in (60, 200, 1000):
        started = Running(work(place / "memory" / job.out), memory=megabytes * 2**20)
        expect(f"{megabytes} MB of memory", started, 0, *_BY_A_LIBRARY)
    for name, options in (("read-only disk", "ro"), ("full disk", "size=8k")):
        expect(name, Running(_mounted(inputs, job, place / "disk", options)), 0)
    words = [str(part) for part in job.arguments(place / "vanished" / job.out)]
    for name in ("store", "run", "logs"):
        copy, source = place / "copy" / name, f"{inputs.folder}/{name}"
        if (moved := [part.replace(source, str(copy)) for part in words]) != words:
            shutil.copytree(inputs.folder / name, copy)
            # A server that finds all it needs would answer for ever.
            started = Running(command(*moved))
            shutil.rmtree(copy)
            started.send(signal.SIGTERM) if job.name == "serve" else None
            expect(f"{name} vanishes", started, 0, 143, -signal.SIGTERM)
    for path in leftovers(place):
        counts[f"left: {path}"] += 1
    shutil.rmtree(place, ignore_errors=True)
    return counts


def _mounted(inputs: Inputs, job: Job, disk: Path, options: str) -> Callable[[], int]:
    """The command on a disk of its own, which only its process sees."""

    def work() -> int:
        disk.mkdir(exist_ok=True)
        if ctypes.CDLL(None).unshare(0x00020000):  # CLONE_NEWNS; Python has it from 3.12 on
            return _SKIPPED
        quiet: dict[str, Any] = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
        for arguments in (["--make-rprivate", "/"], ["-t", "tmpfs", "-o", options, "tmpfs", disk]):
            if subprocess.run(["mount", *arguments], check=False, **quiet).returncode:
                return _SKIPPED
        return inputs.work(job, disk / job.out)()

    return work


def hostile_parquet(folder: Path) -> Counter[str]:
    """Parquet files that unfold, nest, or carry what no log has."""
    counts, place = Counter[str](), folder / "hostile"
    place.mkdir()
    Running(lambda: _write_hostile(place)).wait()
    for path in sorted(place.glob("*.parquet")):
        work = command("prepare", path, "--out", place / "store", "--memory-limit", "200MB")
        end = Running(work, memory=4 * 2**30).wait(60)
        counts["cases"] += 1
        counts["refused"] += end.status == 2
        if fault := end.fault((0, 2)):
            counts[f"{path.name}: {fault}"] += 1
        if end.seconds > 30:
            counts[f"{path.name}: {end.seconds:.0f} s"] += 1
        shutil.rmtree(place / "store", ignore_errors=True)
    return counts


def _write_hostile(place: Path) -> int:
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = 200
    count = np.arange(rows)
    plain = {"user_id": pa.array(count % 7), "item_id": pa.array(count % 5)}
    plain |= {"timestamp": pa.array(1_700_000_000_000 + count), "reward": pa.array(count % 2)}

    def table(**changes: Any) -> pa.Table:
        return pa.table({**plain, **changes})

    nested = pa.array([[1.0]] * rows)
    for _ in range(60):
        nested = pa.ListArray.from_arrays(pa.array(np.arange(rows + 1), pa.int32()), nested)
    tables = {
        "plain": table(),
        "nested": table(observation=nested),
        "no columns": pa.table({}),
        "many columns": table(**{f"c{i}": plain["reward"] for i in range(5000)}),
        "names": table(**dict.fromkeys(("a\nb", "\x1b[31m", ""), plain["reward"])),
        "nulls": table(user_id=pa.nulls(rows)),
        "long text": table(item_id=pa.array(["x" * 1_000_000 + str(i % 5) for i in count])),
        "wide": table(observation=pa.array([[0.5] * 20_000] * rows)),
        "unequal": table(observation=pa.array([[0.5] * (i % 3 + 1) for i in count])),
        "structs": table(reward=pa.array([{"a": 1}] * rows)),
        "extremes": table(timestamp=pa.array([2**63 - 1, -(2**63)] * (rows // 2))),
        "infinite": table(reward=pa.array([float("inf"), 1.0] * (rows // 2))),
        "binary ids": table(user_id=pa.array([b"\xff\x00"] * rows)),
    }
    for name, table_of_name in tables.items():
        pq.write_table(table_of_name, place / f"{name}.parquet")
    unfolds = pa.table({k: np.full(10_000_000, int(v[0].as_py())) for k, v in plain.items()})
    pq.write_table(unfolds, place / "unfolds.parquet", row_group_size=10_000_000)
    return 0
