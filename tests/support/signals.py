"""Waiting for a process to be ready for a signal."""

import signal
import time
from pathlib import Path


def wait_until_handled(process: int, number: signal.Signals, seconds: float = 60) -> None:
    """Return once a process has its own handler of a signal, or has ended."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            status = Path(f"/proc/{process}/status").read_text()
        except OSError:
            return
        fields = dict(line.split(":", 1) for line in status.splitlines())
        handled = int(fields.get("SigCgt", "0"), 16) >> (number - 1) & 1
        if handled or fields["State"].strip().startswith("Z"):
            return
        time.sleep(0.01)
    raise TimeoutError(f"process {process} does not handle {number.name}")
