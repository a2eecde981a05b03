"""What the operating system refuses, and Parquet files that are more than they seem."""

import ctypes
import os
import resource
import shutil
import signal
import subprocess
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.torture.children import Running, command, leftovers
from tests.torture.inputs import Inputs, Job

_BY_A_LIBRARY = (127, -signal.SIGABRT, -signal.SIGSEGV)
"""How libraries in C++ and the C library end a process that gets no memory, without asking us."""


def limits(inputs: Inputs, folder: Path) -> Counter[str]:
    """Every command on a read-only and a full disk, without rights, room or memory."""
    counts, place = Counter[str](), folder / "limits"
    place.mkdir()
    (place / "file").write_text("")
    for job in inputs.jobs():
        taken = "folder for a file" if job.suffix else "exists"
        outs = {"path through a file": place / "file" / "out", taken: place}
        for name, out in (outs | {"name too long": place / ("n" * 254)}).items():
            _expect(counts, job, name, Running(command(*job.arguments(out))))
        out = place / f"small-{job.name}{job.suffix}"
        _expect(counts, job, "file too large", Running(_limited(job, out)))
        for megabytes in (60, 200, 1000):
            out = place / f"memory-{job.name}-{megabytes}{job.suffix}"
            started = Running(command(*job.arguments(out)), memory=megabytes * 2**20)
            _expect(counts, job, f"{megabytes} MB of memory", started, (0, 2, *_BY_A_LIBRARY))
        closed = place / "closed"
        closed.mkdir(mode=0o500, exist_ok=True)
        out = closed / f"out{job.suffix}"
        _expect(counts, job, "no permission", Running(_without_rights(job, out)))
        for name, options in (("read-only disk", "ro"), ("full disk", "size=8k")):
            _expect(counts, job, name, Running(_mounted(job, place / "disk", options)), (0, 2, 75))
    _vanishing(counts, inputs, place)
    for path in leftovers(place):
        counts[f"left: {path}"] += 1
    shutil.rmtree(place, ignore_errors=True)
    return counts


def _expect(
    counts: Counter[str], job: Job, name: str, started: Running, allowed: tuple[int, ...] = (2,)
) -> None:
    end = started.wait()
    counts["cases"] += 1
    if end.status == 75:
        counts["skipped"] += 1
        return
    if fault := end.fault(allowed):
        counts[f"{job.name}, {name}: {fault}"] += 1
    counts["refused"] += end.status == 2
    counts["ended by a library"] += end.status in _BY_A_LIBRARY


def _limited(job: Job, out: Path) -> Callable[[], int]:
    """The command where no file may have more than one byte."""

    def work() -> int:
        log, limit = os.dup(2), resource.RLIMIT_FSIZE
        # The log of stderr would be too large as well.
        reader, writer = os.pipe()
        os.dup2(writer, 2)
        most = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (1, most))
        try:
            return command(*job.arguments(out))()
        finally:
            resource.setrlimit(limit, (most, most))
            os.dup2(log, 2)
            os.close(writer)
            os.write(2, os.read(reader, 60_000))

    return work


def _without_rights(job: Job, out: Path) -> Callable[[], int]:
    """The command without the capabilities by which root may do what permissions forbid."""

    def work() -> int:
        header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3 of the interface, this process
        none = (ctypes.c_uint32 * 6)()
        if ctypes.CDLL(None).capset(header, none) or os.access(out.parent, os.W_OK):
            return 75
        return command(*job.arguments(out))()

    return work


def _mounted(job: Job, disk: Path, options: str) -> Callable[[], int]:
    """The command on a disk of its own, which only its process sees."""

    def work() -> int:
        disk.mkdir(exist_ok=True)
        if ctypes.CDLL(None).unshare(0x00020000):  # CLONE_NEWNS; Python has it from 3.12 on
            return 75
        quiet: dict[str, Any] = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
        for arguments in (["--make-rprivate", "/"], ["-t", "tmpfs", "-o", options, "tmpfs", disk]):
            if subprocess.run(["mount", *arguments], check=False, **quiet).returncode:
                return 75
        return command(*job.arguments(disk / f"out{job.suffix}"))()

    return work


def _vanishing(counts: Counter[str], inputs: Inputs, place: Path) -> None:
    """Inputs that are removed before or while a command reads them."""
    for job in inputs.jobs():
        if job.name in ("collect", "evaluate"):
            continue
        for name in ("store", "run", "logs"):
            copy = place / "copy"
            shutil.rmtree(copy, ignore_errors=True)
            copy.mkdir()
            own = [str(part) for part in job.arguments(place / f"vanished-{job.name}{job.suffix}")]
            source = f"{inputs.folder}/{name}"
            moved = [part.replace(source, f"{copy}/{name}") for part in own]
            if moved == own:
                continue
            shutil.copytree(inputs.folder / name, copy / name)
            started = Running(command(*moved))
            shutil.rmtree(copy)
            _expect(counts, job, f"{name} vanishes", started, (0, 2))


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
