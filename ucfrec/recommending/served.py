"""What a server answers with: one run or several that share the users, replaced as it runs."""

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import xxhash

from ucfrec.errors import InputError
from ucfrec.recommending.requests import Limits, Request
from ucfrec.recommending.responder import Answer, Mean, Responder
from ucfrec.runs.promoted import POINTER, promoted
from ucfrec.runs.trained_policy import TrainedPolicy

SECONDS: Final = 2.0
"""Time between two looks at which run is current."""
_UNITS: Final = 2**32


@dataclass(frozen=True)
class _Current:
    """What the pointer file says."""

    name: str
    """Of the current run."""
    fingerprint: str
    written_ns: int
    """When the file was written: a run is tried again once it is promoted again."""


@dataclass(frozen=True)
class Arm:
    """A run with its share of the users."""

    name: str
    share: float
    responder: Responder


def arm_of(user_id: int | str, shares: Sequence[float]) -> int:
    """Index of a user's arm: users are divided by a hash of their identifier, the same for ever.

    Args:
        shares: of the arms, which add up to 1.
    """
    place = xxhash.xxh3_64_intdigest(f"arm {user_id}".encode()) % _UNITS / _UNITS
    for number, share in enumerate(shares):
        place -= share
        if place < 0:
            return number
    return len(shares) - 1


def parse_split(text: str) -> dict[str, float]:
    """Read `A=0.9,B=0.1`: names of runs and their shares of the users.

    Raises:
        InputError: it is written otherwise, or the shares do not add up to 1.
    """
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            shares[name.strip()] = float(share)
        except ValueError:
            raise InputError(f"--split {text}: write RUN=SHARE,RUN=SHARE") from None
    if not all(0 < share <= 1 for share in shares.values()) or abs(sum(shares.values()) - 1) > 1e-6:
        raise InputError(f"--split {text}: shares are above 0 and add up to 1")
    return shares


class Served:
    """Answers requests with the current run, or with runs that share the users.

    With `follow`, a thread loads a run that became current beside the one that answers, tries it,
    and replaces that one between two batches of requests.
    """

    def __init__(
        self, make: Callable[[Path], Responder], folder: Path, shares: Mapping[str, float] | None
    ) -> None:
        """
        Args:
            make: loads a run and checks its files.
            shares: name of each arm's run to its share of the users; None for the current run.

        Raises:
            InputError: a run cannot be used, or no run of the folder was promoted.
        """
        self._make, self._folder = make, folder
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._refused: tuple[str, str] | None = None
        self._known: _Current | None = None
        if shares is None:
            self._known = self._current()
            shares = {self._known.name: 1.0}
        self._arms = [Arm(name, share, make(folder / name)) for name, share in shares.items()]
        for arm in self._arms[1:]:
            _require_alike(arm.responder.trained, self.trained)

    @property
    def trained(self) -> TrainedPolicy:
        """The policy of the first arm."""
        return self._arms[0].responder.trained

    @property
    def limits(self) -> Limits:
        """Of a request."""
        return self._arms[0].responder.limits

    def answers(self, requests: Sequence[Request]) -> list[Answer | InputError]:
        """Answer requests, each with the arm of its user; see `Responder.answers`."""
        with self._lock:
            if len(self._arms) == 1:
                return self._arms[0].responder.answers(requests)
            shares = [arm.share for arm in self._arms]
            places = [arm_of(request.user_id, shares) for request in requests]
            answers: dict[int, Answer | InputError] = {}
            for number, arm in enumerate(self._arms):
                rows = [row for row, place in enumerate(places) if place == number]
                outcomes = arm.responder.answers([requests[row] for row in rows]) if rows else []
                for row, outcome in zip(rows, outcomes, strict=True):
                    if isinstance(outcome, Answer):
                        outcome = outcome._replace(arm=arm.name)
                    answers[row] = outcome
            return [answers[row] for row in range(len(requests))]

    def described(self) -> dict[str, Any]:
        """What answers, for the health page."""
        arms = self._arms
        page: dict[str, Any] = {**arms[0].responder.described(), "name": arms[0].name}
        if len(arms) > 1:
            page["arms"] = {
                arm.name: {**arm.responder.described(), "share": arm.share} for arm in arms
            }
        if self._refused is not None:
            page["refused"] = dict(zip(("name", "error"), self._refused, strict=True))
        return page

    def drift(self) -> dict[str, Mean]:
        """See `Responder.drift`; of the first arm."""
        return self._arms[0].responder.drift()

    def check(self) -> None:
        """Answer with the current run from now on, if it is another one and passes a trial.

        Raises:
            InputError: no run is current.
        """
        current = self._current()
        if current == self._known:
            return
        self._known = current
        active = self._arms[0].name, self.trained.fingerprint
        if current.name != active[0] or current.fingerprint not in ("", active[1]):
            self._replace(current.name)
        else:
            self._refused = None

    def follow(self, seconds: float = SECONDS) -> None:
        """Look every so many seconds whether another run is current, in a thread of its own."""
        self._thread = threading.Thread(
            target=self._run, args=(seconds,), name="promoted", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the thread, and release what the runs hold."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join()
        with self._lock:
            for arm in self._arms:
                arm.responder.close()

    def _current(self) -> _Current:
        pointer = promoted(self._folder)
        if pointer is None:
            raise InputError(
                f"{self._folder} is not a run folder, and no run in it was promoted; name a run, "
                "or ucfrec promote one"
            )
        written = (self._folder / POINTER).stat().st_mtime_ns
        return _Current(pointer.run(self._folder).name, pointer.fingerprint, written)

    def _run(self, seconds: float) -> None:
        message = ""
        while not self._closed.wait(seconds):
            try:
                self.check()
            except Exception as error:
                # Whatever is wrong with the pointer file, the run that answers goes on.
                if str(error) != message:
                    message = str(error)
                    _say(message)
                self._refused = POINTER, message
                self._known = None
            else:
                message = ""

    def _replace(self, name: str) -> None:
        """Load a run, try it, and answer with it from the next batch on; or say why not."""
        began = time.perf_counter()
        try:
            responder = self._make(self._folder / name)
            _require_alike(responder.trained, self.trained)
            _try(responder)
        except Exception as error:
            # Whatever is wrong with the new run, the old one goes on.
            self._refused = name, str(error) or type(error).__name__
            _say(f"{name} is not used: {self._refused[1]}; {self._arms[0].name} goes on")
            return
        with self._lock:
            old, self._arms = self._arms, [Arm(name, 1.0, responder)]
        self._refused = None
        for arm in old:
            arm.responder.close()
        _say(f"{name} answers from now on, loaded in {time.perf_counter() - began:.1f} s")


def _try(responder: Responder) -> None:
    """Answer a request of a user without history.

    Raises:
        InputError: there is no answer.
    """
    (outcome,) = responder.answers([Request(user_id="")])
    if isinstance(outcome, InputError) and not responder.trained.record.observation_size:
        raise outcome


def _require_alike(new: TrainedPolicy, old: TrainedPolicy) -> None:
    """Check that exposures of both can be in one file.

    Raises:
        InputError: items are text in one run and numbers in the other.
    """
    of_new, of_old = (trained.items.ids.dtype.kind in "iu" for trained in (new, old))
    if of_new != of_old:
        raise InputError(f"{new.folder}: items are not of the same type as in {old.folder}")


def _say(message: str) -> None:
    print(f"ucfrec serve: {message}", file=sys.stderr, flush=True)
