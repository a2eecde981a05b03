"""Commands in forks of one interpreter: their end, their output, and what they leave."""

import contextlib
import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

TIMEOUT = 300.0
"""Seconds after which a command counts as hung."""


@dataclass(frozen=True)
class End:
    """How a command ended."""

    status: int
    """Exit status; negative for the signal that killed it."""
    printed: str
    """What it wrote to stderr."""
    seconds: float
    hung: bool = False

    def fault(self, allowed: Sequence[int]) -> str:
        """What is wrong with this end; of the `allowed` statuses 2, 130 and 143 print a line."""
        printed = self.printed.strip()
        if self.hung:
            return "hung"
        if "Traceback (most recent call last)" in printed:
            return "traceback: " + printed.splitlines()[-1][:150]
        if self.status not in allowed:
            return f"status {self.status}: {printed[-150:]}"
        # Notes, lines of counting, and what a server says while it goes on.
        quiet = ("benchmark", "ucfrec: note", "ucfrec: exposures", "ucfrec serve: stopped")
        lines = sum(not line.startswith(quiet) for line in printed.splitlines())
        if self.status in (2, 130, 143) and lines != 1:
            return f"{lines} lines: {printed[:150]}"
        return ""


class Running:
    """A function in a fork; its stderr goes to a file, its stdout to nowhere. `memory` is the most
    bytes beyond what this process has, `largest` the most that a file may have."""

    def __init__(
        self, work: Callable[[], int], memory: int | None = None, largest: int | None = None
    ) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        self._start = time.monotonic()
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            status = 70
            try:
                os.dup2(self._log.fileno(), 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                if memory is not None:
                    limit = _address_space() + memory
                    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
                if largest is not None:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
                status = work()
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else 1
            except BaseException:
                traceback.print_exc()
            finally:
                with contextlib.suppress(BaseException):
                    sys.stderr.flush()
                os._exit(status)

    def send(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def wait(self, timeout: float = TIMEOUT) -> End:
        until, hung, status = time.monotonic() + timeout, False, 0
        while True:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > until:
                hung = True
                self.send(signal.SIGKILL)
                until += 1e9
            time.sleep(0.002)
        self._log.seek(0)
        printed = self._log.read().decode(errors="replace")
        self._log.close()
        code = os.waitstatus_to_exitcode(status)
        return End(code, printed, time.monotonic() - self._start, hung)


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def command(*arguments: object) -> Callable[[], int]:
    """A function that runs one command as its process would."""

    def work() -> int:
        sys.argv = ["ucfrec", *map(str, arguments)]
        from ucfrec.__main__ import main

        return main()

    return work


def run_first(work: Callable[[], int]) -> End:
    """Run in a fork, then import what it imported: later forks spend their time on the command."""
    with tempfile.NamedTemporaryFile("r") as names:

        def listed() -> int:
            try:
                return work()
            finally:
                Path(names.name).write_text("\n".join(sys.modules))

        end = Running(listed).wait()
        for name in names.read().splitlines():
            with contextlib.suppress(Exception):
                importlib.import_module(name)
    return end


def traced(
    work: Callable[[], int], place: Path, answer: Path, at: tuple[int, int] = (-1, -1)
) -> Callable[[], int]:
    """The work, in a fork that kills itself `at` a call after a step: one that opens a file in
    `place` to write it, makes a folder there, renames something, or opens Parquet. If all ends
    well, `answer` lists the steps and the number of calls until the next."""
    steps: list[tuple[str, int]] = []

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "return" and frame.f_code.co_qualname == "ParquetWriter.__init__":
            steps.append(("open", 0))
        path, calls = steps[-1]
        steps[-1] = path, calls + 1
        if (len(steps) - 1, calls + 1) == at:
            os.kill(os.getpid(), signal.SIGKILL)

    def see(event: str, values: Sequence[Any]) -> None:
        steps_here = {
            "open": lambda: values[2] & (os.O_WRONLY | os.O_RDWR),
            "os.mkdir": lambda: not os.path.isdir(values[0]),
            "os.rename": lambda: True,
        }
        if event in steps_here and f"{place}/" in str(values[0]) and steps_here[event]():
            steps.append((f"{event} {values[0]}", 0))
            sys.setprofile(count)

    def traced_work() -> int:
        sys.addaudithook(see)
        try:
            return work()
        finally:
            sys.setprofile(None)
            answer.write_text(json.dumps(steps))

    return traced_work


def leftovers(*folders: Path) -> list[str]:
    """Locks and scratch in the folders."""
    from ucfrec.files.atomic import LOCK, SCRATCH

    hidden = [path for folder in folders for path in folder.rglob(".*")]
    return [str(path) for path in hidden if path.name.endswith((LOCK, SCRATCH))]
