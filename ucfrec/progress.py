"""Progress of long jobs: a bar on a terminal, a plain line now and then in a log file."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

FIRST_LINE = 10.0
"""Seconds without a terminal before the first line; a shorter job prints nothing."""
NEXT_LINE = 30.0
"""Seconds between two lines."""


class Progress(Protocol):
    """What `progress` yields."""

    def update(self, n: float = 1, **shown: float) -> None:
        """Count `n` more units as done; `shown` are values to print beside, e.g. `loss=0.3`."""


@contextmanager
def progress(total: float | None, what: str, unit: str, done: float = 0) -> Iterator[Progress]:
    """Show on stderr how far a job is, how fast it goes and how long it will still take.

    Args:
        total: units of the whole job; None where that is unknown.
        what: the job, e.g. "train".
        unit: what is counted, in the plural, e.g. "steps".
        done: units that an earlier start of the same job left done.
    """
    bar = _Bar if sys.stderr.isatty() else _Lines
    shown = bar(total, what, unit, done)
    try:
        yield shown
    finally:
        shown.close()


class _Bar:
    """On a terminal: tqdm, imported only here."""

    def __init__(self, total: float | None, what: str, unit: str, done: float) -> None:
        from tqdm import tqdm

        scale = total is None or total >= 100_000
        self._bar: tqdm[Any] = tqdm(
            total=total, desc=what, unit=f" {unit}", initial=done, unit_scale=scale
        )

    def update(self, n: float = 1, **shown: float) -> None:
        if shown:
            self._bar.set_postfix(shown, refresh=False)
        self._bar.update(n)

    def close(self) -> None:
        self._bar.close()


class _Lines:
    """In a log file: lines, so that a job of a night can be followed."""

    def __init__(self, total: float | None, what: str, unit: str, done: float) -> None:
        self._total, self._what, self._unit = total, what, unit
        self._before = self._done = done
        self._start = time.monotonic()
        self._next = self._start + FIRST_LINE
        self._shown: dict[str, float] = {}

    def update(self, n: float = 1, **shown: float) -> None:
        self._done += n
        self._shown |= shown
        now = time.monotonic()
        if now >= self._next:
            self._next = now + NEXT_LINE
            self._print(now - self._start)

    def close(self) -> None:
        seconds = time.monotonic() - self._start
        if seconds >= FIRST_LINE:
            line = f"{self._what}: {self._done:,.0f} {self._unit} done, {_duration(seconds)}"
            print(line, file=sys.stderr, flush=True)

    def _print(self, seconds: float) -> None:
        rate = (self._done - self._before) / seconds
        if self._total:
            share = self._done / self._total
            parts = [f"{self._done:,.0f} of {self._total:,.0f} {self._unit} ({share:.0%})"]
        else:
            parts = [f"{self._done:,.0f} {self._unit}"]
        parts.append(_rate(rate, self._unit))
        if self._total and rate > 0:
            parts.append(f"{_duration(max(self._total - self._done, 0) / rate)} left")
        parts += [f"{name} {value:.4g}" for name, value in self._shown.items()]
        print(f"{self._what}: {', '.join(parts)}", file=sys.stderr, flush=True)


def _rate(per_second: float, unit: str) -> str:
    """A rate in the time unit that makes it at least one, where there is one."""
    for span, seconds in (("s", 1), ("min", 60), ("h", 3600)):
        rate = per_second * seconds
        if rate >= 1 or span == "h":
            break
    return f"{rate:,.0f} {unit}/{span}" if rate >= 100 else f"{rate:.3g} {unit}/{span}"


def _duration(seconds: float) -> str:
    """Two neighbouring units of time: `42 s`, `3 min 20 s`, `5 h 12 min`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
