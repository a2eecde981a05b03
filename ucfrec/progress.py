"""Progress of long jobs on stderr: a bar on a terminal, plain lines at intervals elsewhere."""

import sys
import time
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
    label = _LABEL.get()
    # Bars of several processes would overwrite each other.
    display_class = _Bar if sys.stderr.isatty() and not label else _Lines
    name = ": ".join(part for part in (label, _PHASE.get(), job) if part)
    display = display_class(total, name, unit, done)
    try:
        yield display
    finally:
        display.close()


@contextmanager
def label_progress(name: str) -> Iterator[None]:
    """Name this job in the progress of all that it does, as one of several at the same time."""
    before = _LABEL.set(name)
    try:
        yield
    finally:
        _LABEL.reset(before)


@contextmanager
def phase(doing: str, number: int, of: int) -> Iterator[None]:
    """Name the phase of a long job, e.g. `Fitting the reward model (2 of 5)`, in its progress."""
    before = _PHASE.set(f"{doing} ({number} of {of})")
    try:
        yield
    finally:
        _PHASE.reset(before)


@contextmanager
def no_progress(total: float | None, job: str, unit: str, done: float = 0) -> Iterator[Progress]:
    """As `progress`, and display nothing: another process does."""
    yield _Nothing()


class _Nothing:
    def update(self, n: float = 1, **metrics: float) -> None:
        pass


class _Bar:
    """On a terminal: a tqdm bar."""

    def __init__(self, total: float | None, job: str, unit: str, done: float) -> None:
        from tqdm import tqdm

        scale = total is None or total >= 100_000
        self._bar: tqdm[Any] = tqdm(
            total=total, desc=job, unit=f" {unit}", initial=done, unit_scale=scale
        )

    def update(self, n: float = 1, **metrics: float) -> None:
        if metrics:
            self._bar.set_postfix(metrics, refresh=False)
        self._bar.update(n)

    def close(self) -> None:
        self._bar.close()


class _Lines:
    """Without a terminal: plain lines, so that a long job can be followed in a log file."""

    def __init__(self, total: float | None, job: str, unit: str, done: float) -> None:
        self._total, self._job, self._unit = total, job, unit
        self._initial = self._done = done
        self._start = time.monotonic()
        self._next = self._start + FIRST_LINE
        self._metrics: dict[str, float] = {}

    def update(self, n: float = 1, **metrics: float) -> None:
        self._done += n
        self._metrics |= metrics
        now = time.monotonic()
        if now >= self._next:
            self._next = now + NEXT_LINE
            self._print(now - self._start)

    def close(self) -> None:
        seconds = time.monotonic() - self._start
        if seconds >= FIRST_LINE:
            line = f"{self._job}: {self._done:,.0f} {self._unit} done, {_duration(seconds)}"
            print(line, file=sys.stderr, flush=True)

    def _print(self, seconds: float) -> None:
        rate = (self._done - self._initial) / seconds
        if self._total:
            share = self._done / self._total
            parts = [f"{self._done:,.0f} of {self._total:,.0f} {self._unit} ({share:.0%})"]
        else:
            parts = [f"{self._done:,.0f} {self._unit}"]
        parts.append(_rate(rate, self._unit))
        if self._total and rate > 0:
            parts.append(f"{_duration(max(self._total - self._done, 0) / rate)} left")
        parts += [f"{name} {value:.4g}" for name, value in self._metrics.items()]
        print(f"{self._job}: {', '.join(parts)}", file=sys.stderr, flush=True)


def _rate(per_second: float, unit: str) -> str:
    """A rate in the shortest time unit in which it is at least 1, at most hours: `3 steps/min`."""
    for span, seconds in (("s", 1), ("min", 60), ("h", 3600)):
        rate = per_second * seconds
        if rate >= 1 or span == "h":
            break
    return f"{rate:,.0f} {unit}/{span}" if rate >= 100 else f"{rate:.3g} {unit}/{span}"


def _duration(seconds: float) -> str:
    """A duration in its two largest units: `42 s`, `3 min 20 s`, `5 h 12 min`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
