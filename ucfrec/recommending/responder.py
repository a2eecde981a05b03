"""Answers to requests of several users at once, equal to those of `ucfrec recommend`; by one run,
or by several that share the users, replaced as the server runs."""

import math
import sys
import threading
import time
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import xxhash

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError
from ucfrec.logs.histories import Histories
from ucfrec.recommending.exposures import exposure_schema
from ucfrec.recommending.recommend import Chooser, candidate_numbers, name_some
from ucfrec.recommending.requests import HistoryReader, Limits, Request, RowRewards, id_array
from ucfrec.runs.later_logs import reward_of
from ucfrec.runs.promoted import POINTER, Promoted, promoted
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.schema import SESSION_ID

ONNXRUNTIME = "onnxruntime"
_LARGEST_EXACT = 2**53 - 1
"""Largest integer that JavaScript holds exactly."""
SECONDS = 2.0
"""Time between two looks at which run is current."""
_UNITS = 2**32


class Answer(NamedTuple):
    """Items for one user, in the order shown."""

    items: list[int | str]
    scores: list[float]
    """Log-probabilities at temperature 1 among the items that are left, nats."""
    propensities: list[float]
    """Probability of each item at its position, given those before it."""
    request_id: str
    run: str
    """Fingerprint of the run."""
    rule: str
    """Hash of the decision rule."""
    arm: str = ""
    """Run of the user's arm, where runs share the users."""
    session_began: int = -1
    """Time of the session's first row, ms; −1 for the time of the answer."""
    excludes_seen: bool = False
    """Whether items of the history could not be shown."""
    candidates: Array | None = None
    """Ids that it was chosen from, in any order; None for all items."""

    def as_dict(self, user_id: int | str) -> dict[str, Any]:
        """The answer to a request of a user, as a JSON object."""
        columns = zip(self.items, self.scores, self.propensities, strict=True)
        items = [
            {"item_id": exact_id(item), "score": score, "propensity": propensity}
            for item, score, propensity in columns
        ]
        arm = {"arm": self.arm} if self.arm else {}
        return {
            "user_id": exact_id(user_id),
            "request_id": self.request_id,
            "run": self.run,
            "rule": self.rule,
            **arm,
            "items": items,
        }


class Mean(NamedTuple):
    """A mean that can be pooled with those of other processes."""

    total: float
    weight: float

    @property
    def value(self) -> float:
        """The mean; 0 if nothing was counted."""
        return self.total / self.weight if self.weight else 0.0


def exact_id(value: int | str) -> int | str:
    """An identifier for JSON: as text if a client that reads numbers as doubles would round it."""
    return str(value) if isinstance(value, int) and abs(value) > _LARGEST_EXACT else value


class _Question(NamedTuple):
    """A request that can be answered, with its history and candidates as numbers of items."""

    request: Request
    request_id: str
    k: int
    history: Histories
    candidates: IntArray | None

    def begins_session(self, ended_ms: float) -> bool:
        """Whether the request says so or, if it does not say, its last row is before a time."""
        stated = self.request.new_session
        if stated is None:
            return bool(self.history.timestamps.max(initial=0) < ended_ms)
        return stated


class Responder:
    """A trained policy under its rule, which answers requests; for one thread at a time.

    It keeps nothing of a request.
    """

    def __init__(
        self,
        trained: TrainedPolicy,
        limits: Limits,
        *,
        rule: DecisionRule | None = None,
        k: int = 10,
        filter_seen: bool = True,
        skip_unknown: bool = False,
        seed: int = 0,
        engine: str = "torch",
    ) -> None:
        """As `recommend`; draws depend on user and request_id. InputError if the policy's actions
        are vectors, the rule does not fit the policy, `k` is beyond the limits, or the engine is
        not installed or cannot compute the policy.

        Args:
            k: items for requests that do not say how many.
            engine: "torch" or "onnxruntime", which computes the scores of single requests.
        """
        scorer = trained.item_scorer(rule)
        if not 1 <= k <= limits.k:
            raise InputError(f"k is {k}; give a whole number from 1 to {limits.k:,}")
        if engine == ONNXRUNTIME:
            from ucfrec.recommending.export import compile_scores

            scorer.engine = compile_scores(scorer, trained.name)
        self.trained = trained
        self.limits = limits
        self.rule = scorer.rule
        self._chooser = Chooser(trained, scorer, seed)
        self._k = k
        self._filter_seen = filter_seen
        self._skip_unknown = skip_unknown
        self._source = trained.fingerprint, self.rule.hash
        self._reader = HistoryReader(
            trained.record.data.duplicates,
            trained.record.session_by == SESSION_ID,
            trained.record.observation_size,
            RowRewards(reward_of(trained)),
        )
        self._means = dict.fromkeys(("unknown_items", "unknown_users", "new_sessions"), Mean(0, 0))

    def drift(self) -> dict[str, Mean]:
        """Share of unknown items among rows of histories, and of unknown users and new sessions
        among requests, so far; and the drift that the run's update found, as `update_…`."""
        update = self.trained.record.update
        drift = (update and update.drift) or {}
        means = {f"update_{name}": Mean(float(value), 1.0) for name, value in drift.items()}
        return means | self._means

    def _add_to_mean(self, name: str, count: int, of: int) -> None:
        total, weight = self._means[name]
        self._means[name] = Mean(total + count, weight + of)

    def described(self) -> dict[str, Any]:
        """What answers, for the health page."""
        return {
            "policy": self.trained.record.summary,
            "rule": str(self.rule),
            "rule_hash": self.rule.hash,
            "run": self.trained.fingerprint,
        }

    def close(self) -> None:
        """Release what reading rewards holds."""
        self._reader.rewards.close()

    def answers(self, requests: Sequence[Request]) -> list[Answer | InputError]:
        """The answers, or what is wrong, in as few forward passes as memory allows, in order."""
        outcomes = [self._read_or_refuse(request) for request in requests]
        questions = [question for question in outcomes if isinstance(question, _Question)]
        answers = self._answer(questions) if questions else iter(())
        return [
            outcome if isinstance(outcome, InputError) else next(answers) for outcome in outcomes
        ]

    def _read_or_refuse(self, request: Request) -> _Question | InputError:
        items, candidates = self.trained.items, None
        try:
            history = self._reader.read(request.history, request.user_id)
            numbered = history.with_numbers(items, self._filter_seen)
            unknown = numbered.item_ids < 0
            count, rows = int(unknown.sum()), len(unknown)
            self._add_to_mean("unknown_items", count, rows)
            if count and not self._skip_unknown:
                names = name_some(sorted(set(history.item_ids[unknown].tolist())))
                raise InputError(
                    f"history: the policy does not know the item_id of {count} of {rows} rows "
                    f"({names}); leave them out"
                )
            if request.candidates is not None:
                ids = id_array(request.candidates)
                candidates = np.sort(candidate_numbers(items, ids, self._skip_unknown))
        except InputError as error:
            return error
        k = self._k if request.k is None else request.k
        return _Question(request, request.request_id or uuid4().hex, k, numbered, candidates)

    def _answer(self, questions: Sequence[_Question]) -> Iterator[Answer]:
        histories = Histories.joined([question.history for question in questions])
        unknown = int((self.trained.users.numbers(histories.users) < 0).sum())
        self._add_to_mean("unknown_users", unknown, len(questions))
        ended_ms = 1000 * time.time() - (self.trained.record.session_gap_ms or math.inf)
        new = np.asarray([question.begins_session(ended_ms) for question in questions])
        self._add_to_mean("new_sessions", int(new.sum()), len(questions))
        items, scores, propensities, began = self._chooser.choose(
            histories,
            np.asarray([question.request_id for question in questions], dtype=object),
            max(question.k for question in questions),
            new,
            [question.candidates for question in questions],
        )
        # Items that may not be recommended come last.
        counts = np.isfinite(scores).sum(1)
        columns = counts, began, self.trained.items.ids[items], scores, propensities
        for question, count, start, *lists in zip(questions, *columns, strict=True):
            ids, logs, chances = (values[: min(count, question.k)].tolist() for values in lists)
            numbers = question.candidates
            yield Answer(
                ids,
                logs,
                chances,
                question.request_id,
                *self._source,
                session_began=int(start),
                excludes_seen=self._filter_seen,
                candidates=None if numbers is None else self.trained.items.ids[numbers],
            )


class _Arm(NamedTuple):
    """A run with its share of the users."""

    name: str
    share: float
    responder: Responder


def arm_of(user_id: int | str, shares: Sequence[float]) -> int:
    """Index of a user's arm of those with the shares, which add up to 1: users are divided by a
    hash of their identifier, the same for ever."""
    place = xxhash.xxh3_64_intdigest(f"arm {user_id}".encode()) % _UNITS / _UNITS
    return bisect(list(accumulate(shares[:-1])), place)


def parse_split(text: str) -> dict[str, float]:
    """Read `A=0.9,B=0.1`: names of runs and their shares of the users; or raise InputError."""
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            shares[name.strip()] = float(share)
        except ValueError:
            raise InputError(f"{text} are no shares of arms: write RUN=SHARE,RUN=SHARE") from None
    total = sum(shares.values())
    if not all(0 < share <= 1 for share in shares.values()) or abs(total - 1) > 1e-6:
        raise InputError(f"{text}: shares are above 0 and add up to 1")
    return shares


class Served:
    """Answers requests with the current run, or with runs that share the users.

    With `follow`, a thread loads a run that became current beside the one that answers, tries it,
    and replaces that one between two batches of requests.
    """

    def __init__(
        self,
        make: Callable[[Path], Responder],
        folder: Path,
        shares: Mapping[str, float] | None,
    ) -> None:
        """InputError if a run cannot be used, or no run of the folder was promoted.

        Args:
            make: loads a run and checks its files.
            shares: name of each arm's run to its share of the users; None for the current run.
        """
        self._make, self._folder = make, folder
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._refused: tuple[str, str] | None = None
        self._known: tuple[Promoted, int] | None = None
        if shares is None:
            pointer, _ = self._known = self._current()
            shares = {pointer.current: 1.0}
        self._arms = [_Arm(name, share, make(folder / name)) for name, share in shares.items()]
        if self._known is not None:
            pointer.require_same(self.trained)
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
            outcomes = []
            for number, arm in enumerate(self._arms):
                of_arm = [r for r, place in zip(requests, places, strict=True) if place == number]
                outcomes.append(iter(arm.responder.answers(of_arm)))
            answers = ((self._arms[place].name, next(outcomes[place])) for place in places)
            return [a._replace(arm=name) if isinstance(a, Answer) else a for name, a in answers]

    def described(self) -> dict[str, Any]:
        """What answers, for the health page."""
        arms = self._arms
        page: dict[str, Any] = {**arms[0].responder.described(), "name": arms[0].name}
        if len(arms) > 1:
            page["arms"] = {a.name: {**a.responder.described(), "share": a.share} for a in arms}
        if self._refused is not None:
            page["refused"] = dict(zip(("name", "error"), self._refused, strict=True))
        return page

    def drift(self) -> dict[str, Mean]:
        """`Responder.drift` of the first arm."""
        return self._arms[0].responder.drift()

    def check(self) -> None:
        """Change to the current run if it passes a trial; InputError if none is current."""
        current = self._current()
        if current == self._known:
            return
        self._known, (pointer, _) = current, current
        answering = self._arms[0].name, self.trained.fingerprint
        if (pointer.current, pointer.fingerprint) == answering:
            self._refused = None
        else:
            self._replace(pointer)

    def follow(self, seconds: float = SECONDS) -> None:
        """Look every so many seconds whether another run is current, in a thread of its own."""
        self._thread = threading.Thread(target=self._run, args=(seconds,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and release what the runs hold."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join()
        with self._lock:
            for arm in self._arms:
                arm.responder.close()

    def _current(self) -> tuple[Promoted, int]:
        """What the pointer says, and when it was written: a run promoted again is tried again."""
        pointer = promoted(self._folder)
        if pointer is None:
            raise InputError(
                f"{self._folder} is not a run folder, and no run in it was promoted; name a run, "
                "or ucfrec promote one"
            )
        return pointer, (self._folder / POINTER).stat().st_mtime_ns

    def _run(self, seconds: float) -> None:
        while not self._closed.wait(seconds):
            try:
                self.check()
            except Exception as error:
                # Whatever is wrong with the pointer file, the run that answers goes on.
                refused = POINTER, str(error)
                if refused != self._refused:
                    _say(refused[1])
                self._refused, self._known = refused, None

    def _replace(self, pointer: Promoted) -> None:
        """Load a run, try it, and answer with it from the next batch on; or say why not."""
        began, name = time.perf_counter(), pointer.current
        try:
            responder = self._make(self._folder / name)
            pointer.require_same(responder.trained)
            _require_alike(responder.trained, self.trained)
            (outcome,) = responder.answers([Request(user_id="")])
            if isinstance(outcome, InputError) and not responder.trained.record.observation_size:
                raise outcome
        except Exception as error:
            # Whatever is wrong with the new run, the old one goes on.
            self._refused = name, str(error) or type(error).__name__
            _say(f"{name} is not used: {self._refused[1]}; {self._arms[0].name} goes on")
            return
        with self._lock:
            old, self._arms = self._arms, [_Arm(name, 1.0, responder)]
        self._refused = None
        for arm in old:
            arm.responder.close()
        _say(f"{name} answers from now on, loaded in {time.perf_counter() - began:.1f} s")


def _require_alike(new: TrainedPolicy, old: TrainedPolicy) -> None:
    """Check that exposures of both can be in one file: that items are text in both, or numbers."""
    if exposure_schema(new) != exposure_schema(old):
        raise InputError(f"{new.folder}: items are not of the same type as in {old.folder}")


def _say(message: str) -> None:
    print(f"ucfrec serve: {message}", file=sys.stderr, flush=True)
