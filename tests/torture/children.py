"""Commands in forks of one interpreter: their end, their output, and what they leave."""

import contextlib
import importlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.support.signals import wait_until_handled

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
        quiet = ("benchmark", "ucfrec: note")  # notes and lines of counting
        lines = sum(not line.startswith(quiet) for line in printed.splitlines())
        if self.status in (2, 130, 143) and lines != 1:
            return f"{lines} lines: {printed[:150]}"
        return ""


class Running:
    """A function in a fork; its stderr goes to a file, its stdout to nowhere.

    With `memory`, the fork gets no more than that many bytes beyond what this process has.
    """

    def __init__(self, work: Callable[[], int], memory: int | None = None) -> None:
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


def run(*arguments: object) -> End:
    """One command from its beginning to its end."""
    return Running(command(*arguments)).wait()


def run_first(*arguments: object) -> End:
    """`run`, after which this interpreter imports what the command imported.

    Forks then spend their time on what the command does, not on its imports.
    """
    with tempfile.NamedTemporaryFile("r") as names:

        def work() -> int:
            try:
                return command(*arguments)()
            finally:
                Path(names.name).write_text("\n".join(sys.modules))

        end = Running(work).wait()
        for name in names.read().splitlines():
            with contextlib.suppress(Exception):
                importlib.import_module(name)
    return end


def run_fresh(*arguments: object, number: int, moment: float) -> End:
    """One command in a new interpreter, which gets the signal `number` after `moment` seconds."""
    words, start = [sys.executable, "-m", "ucfrec", *map(str, arguments)], time.monotonic()
    to = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    started = subprocess.Popen(words, text=True, **to)
    if number != signal.SIGKILL:
        # Before that, Python's own handlers answer. TERM has a handler first of all in ucfrec.
        wait_until_handled(started.pid, signal.SIGTERM)
    time.sleep(moment)
    started.send_signal(number)
    try:
        _, printed = started.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        started.kill()
        return End(1, "", time.monotonic() - start, hung=True)
    return End(started.returncode, printed, time.monotonic() - start)


def leftovers(*folders: Path) -> list[str]:
    """Locks and scratch in the folders."""
    from ucfrec.files.atomic import LOCK, SCRATCH

    hidden = [path for folder in folders for path in folder.rglob(".*")]
    return [str(path) for path in hidden if path.name.endswith((LOCK, SCRATCH))]
