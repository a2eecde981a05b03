"""Progress of long jobs on stderr: a bar on a terminal, plain lines at intervals elsewhere."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

FIRST_LINE = 10.0
"""Seconds before the first line, without a terminal; a shorter job prints nothing."""
NEXT_LINE = 30.0
"""Seconds between lines."""

_LABEL: ContextVar[str] = ContextVar("label", default="")
"""Which of several jobs at the same time this is; empty for the only one."""
_PHASE: ContextVar[str] = ContextVar("phase", default="")


class Progress(Protocol):
    """The display that `progress` yields."""

    def update(self, n: float = 1, **metrics: float) -> None:
        """Count `n` more units as done, and display `metrics` next to them, e.g. `loss=0.3`."""


@contextmanager
def progress(total: float | None, job: str, unit: str, done: float = 0) -> Iterator[Progress]:
    """Display on stderr the finished share of a job, its rate and the estimated time left.

    Args:
        total: units of the whole job; None if unknown.
        job: name of the job, e.g. "train".
        unit: what is counted, in the plural, e.g. "steps".
        done: units that were finished before this process resumed the job; they do not count
            towards the rate.
    """
    from tqdm import tqdm

    label = _LABEL.get()
    # Bars of several processes would overwrite each other.
    layout: dict[str, Any] = {}
    if label or not sys.stderr.isatty():
        tqdm.monitor_interval = 0  # no thread: every update looks at the clock
        layout = {"delay": FIRST_LINE, "mininterval": NEXT_LINE, "miniters": 1}
        layout |= {"ncols": 0, "file": _Lines()}
    name = ": ".join(part for part in (label, _PHASE.get(), job) if part)
    scale = total is None or total >= 100_000
    with tqdm(
        total=total, desc=name, unit=f" {unit}", initial=done, unit_scale=scale, **layout
    ) as bar:
        yield _Bar(bar)


@contextmanager
def label_progress(name: str) -> Iterator[None]:
    """Name this job in the progress of all that it does, as one of several at the same time."""
    token = _LABEL.set(name)
    try:
        yield
    finally:
        _LABEL.reset(token)


@contextmanager
def phase(doing: str, number: int, of: int) -> Iterator[None]:
    """Name the phase of a long job, e.g. `Fitting the reward model (2 of 5)`, in its progress."""
    token = _PHASE.set(f"{doing} ({number} of {of})")
    try:
        yield
    finally:
        _PHASE.reset(token)


@contextmanager
def no_progress(total: float | None, job: str, unit: str, done: float = 0) -> Iterator[Progress]:
    """As `progress`, and display nothing: another process does."""
    yield _Bar(None)


class _Bar:
    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def update(self, n: float = 1, **metrics: float) -> None:
        if self._bar is None:
            return
        if metrics:
            self._bar.set_postfix(metrics, refresh=False)
        self._bar.update(n)


class _Lines:
    """Stderr of a job without a terminal: every state of tqdm's bar is a line of its own."""

    def write(self, text: str) -> None:
        if text := text.strip("\r\n "):
            print(text, file=sys.stderr)

    def flush(self) -> None:
        sys.stderr.flush()
