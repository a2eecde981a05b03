"""Answers to requests of several users at once, equal to those of `ucfrec recommend`."""

import threading
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple
from uuid import uuid4

import numpy as np

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import IntArray
from ucfrec.errors import InputError
from ucfrec.recommending.histories import Histories
from ucfrec.recommending.recommend import Chooser, candidate_numbers, name_some
from ucfrec.recommending.requests import HistoryReader, Limits, Request, id_array
from ucfrec.runs.trained_policy import TrainedPolicy

TORCH: Final = "torch"
ONNXRUNTIME: Final = "onnxruntime"
_LARGEST_EXACT: Final = 2**53 - 1
"""Largest integer that JavaScript holds exactly."""
ENGINES: Final = (TORCH, ONNXRUNTIME)


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

    def as_dict(self, user_id: int | str) -> dict[str, Any]:
        """The answer to a request of a user, as a JSON object."""
        columns = zip(self.items, self.scores, self.propensities, strict=True)
        items = [
            {"item_id": exact_id(item), "score": score, "propensity": propensity}
            for item, score, propensity in columns
        ]
        names = {"request_id": self.request_id, "run": self.run, "rule": self.rule}
        names |= {"arm": self.arm} if self.arm else {}
        return {"user_id": exact_id(user_id), **names, "items": items}


class Mean(NamedTuple):
    """A mean that can be pooled with those of other processes."""

    total: float
    weight: float

    @property
    def value(self) -> float:
        """The mean; 0 if it is of nothing."""
        return self.total / self.weight if self.weight else 0.0


def exact_id(value: int | str) -> int | str:
    """An identifier for JSON: as text if a client that reads numbers as doubles would round it."""
    return str(value) if isinstance(value, int) and abs(value) > _LARGEST_EXACT else value


class _Question(NamedTuple):
    """A request that can be answered."""

    request: Request
    request_id: str
    k: int
    history: Histories
    """Of its user, with the policy's numbers of items."""
    candidates: IntArray | None
    """(c,) index of the only items to recommend; None for all."""


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
        engine: str = TORCH,
    ) -> None:
        """
        Args:
            k: items for requests that do not say how many.
            engine: what computes the scores of a request that comes alone, one of `ENGINES`. The
                others are as of `recommend`; draws depend on user and request_id.

        Raises:
            InputError: the policy's actions are vectors, the rule does not fit the policy, `k` is
                beyond the limits, or the engine is not installed or cannot compute the policy.
        """
        scorer = trained.item_scorer(rule)
        if not 1 <= k <= limits.k:
            raise InputError(f"k is {k}; give a whole number from 1 to {limits.k:,}")
        if engine not in ENGINES:
            raise InputError(f"the engine is {engine!r}; give one of {', '.join(ENGINES)}")
        if engine == ONNXRUNTIME:
            from ucfrec.recommending.export_graph import ScoreGraph

            scorer = scorer.answering_one_with(ScoreGraph(scorer, trained.name))
        self.trained, self.limits, self.rule = trained, limits, scorer.rule
        self._chooser = Chooser(trained, scorer, seed)
        self._k, self._filter_seen, self._skip_unknown = k, filter_seen, skip_unknown
        self._source = trained.fingerprint, self.rule.hash
        self._reader = HistoryReader.of(trained)
        self._busy = threading.Lock()
        self._unknown_users, self._unknown_items = Mean(0, 0), Mean(0, 0)

    def drift(self) -> dict[str, Mean]:
        """Share of unknown items among rows of histories, and of unknown users among requests, so
        far; and the drift that the run's update found, as `update_…`."""
        update = self.trained.record.update
        drift = (update and update.drift) or {}
        means = {f"update_{name}": Mean(float(value), 1.0) for name, value in drift.items()}
        return means | {
            "unknown_items": self._unknown_items,
            "unknown_users": self._unknown_users,
        }

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
        """Answer requests with as few forward passes as memory allows.

        Returns:
            In the order of the requests: the answer, or what is wrong with the request.
        """
        with self._busy:
            outcomes = [self._read_or_refuse(request) for request in requests]
            questions = [question for question in outcomes if isinstance(question, _Question)]
            answers = self._answer(questions) if questions else iter(())
            return [
                outcome if isinstance(outcome, InputError) else next(answers)
                for outcome in outcomes
            ]

    def _read_or_refuse(self, request: Request) -> _Question | InputError:
        items = self.trained.items
        try:
            history = self._reader.read(request.history, request.user_id)
            numbered = history.with_numbers(items, self._filter_seen)
            unknown = numbered.item_ids < 0
            count, rows = int(unknown.sum()), len(unknown)
            total, weight = self._unknown_items
            self._unknown_items = Mean(total + count, weight + rows)
            if count and not self._skip_unknown:
                names = name_some(sorted(set(history.item_ids[unknown].tolist())))
                raise InputError(
                    f"history: the policy does not know the item_id of {count} of {rows} rows "
                    f"({names}); leave them out"
                )
            candidates = None
            if request.candidates is not None:
                ids = id_array(request.candidates)
                candidates = candidate_numbers(items, ids, self._skip_unknown)
        except InputError as error:
            return error
        k = self._k if request.k is None else request.k
        return _Question(request, request.request_id or uuid4().hex, k, numbered, candidates)

    def _answer(self, questions: Sequence[_Question]) -> Iterator[Answer]:
        histories = Histories.joined([question.history for question in questions])
        total, weight = self._unknown_users
        unknown = int((self.trained.users.numbers(histories.users) < 0).sum())
        self._unknown_users = Mean(total + unknown, weight + len(questions))
        numbers, scores, propensities = self._chooser.choose(
            histories,
            np.asarray([question.request_id for question in questions], dtype=object),
            max(question.k for question in questions),
            np.asarray([question.request.new_session for question in questions]),
            candidates=[question.candidates for question in questions],
        )
        # Items that may not be recommended come last.
        counts = np.isfinite(scores).sum(1).tolist()
        columns = (
            values.tolist() for values in (self.trained.items.ids[numbers], scores, propensities)
        )
        for question, count, *lists in zip(questions, counts, *columns, strict=True):
            items, logs, chances = (values[: min(count, question.k)] for values in lists)
            yield Answer(items, logs, chances, question.request_id, *self._source)
