"""Answers to requests of several users at once, equal to those of `ucfrec recommend`."""

import threading
from collections.abc import Sequence
from typing import Any, Final, NamedTuple
from uuid import uuid4

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import IntArray
from ucfrec.errors import InputError
from ucfrec.recommending.histories import Histories
from ucfrec.recommending.recommend import (
    best_of,
    candidate_numbers,
    left_out_of,
    sessions_of,
    some_of,
    uniforms,
    users_at_once,
)
from ucfrec.recommending.requests import HistoryReader, Limits, Request, UserHistory, id_array
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


def exact_id(given: int | str) -> int | str:
    """An identifier for JSON: as text if a client that reads numbers as doubles would round it."""
    return str(given) if isinstance(given, int) and abs(given) > _LARGEST_EXACT else given


class _Prepared(NamedTuple):
    """A request that can be answered."""

    number: int
    """Of the request in its batch."""
    request: Request
    request_id: str
    k: int
    history: UserHistory
    known: IntArray
    """(n,) index of each item of the history, −1 for items that the policy does not know."""
    seen: IntArray
    """(m,) index of items that are not recommended; −1 as above."""
    allowed: IntArray | None
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
            rule: the decision rule; None for the run's own.
            k: items for requests that do not say how many.
            filter_seen: exclude every item that the user has seen.
            skip_unknown: ignore rows of items that are not in the training data, and such
                candidates where others are left.
            seed: of the draws of a rule with a temperature, or that explores; they also depend on
                user and request_id.
            engine: what computes the scores of a request that comes alone, one of `ENGINES`.

        Raises:
            InputError: the policy's actions are vectors, the rule does not fit the policy, `k` is
                beyond the limits, or the engine is not installed or cannot compute the policy.
        """
        self._scorer = trained.item_scorer(rule)
        if not 1 <= k <= limits.k:
            raise InputError(f"k is {k}; give a whole number from 1 to {limits.k:,}")
        if engine not in ENGINES:
            raise InputError(f"the engine is {engine!r}; give one of {', '.join(ENGINES)}")
        if engine == ONNXRUNTIME:
            from ucfrec.recommending.export_graph import ScoreGraph

            graph = ScoreGraph(self._scorer, trained.name)
            self._scorer = self._scorer.answering_one_with(graph)
        self.trained, self.limits = trained, limits
        self._k, self._filter_seen, self._skip_unknown, self._seed = (
            k,
            filter_seen,
            skip_unknown,
            seed,
        )
        self.rule = self._scorer.rule
        self._source = trained.fingerprint, self.rule.hash
        self._items, self._users = trained.items, trained.users
        self._reader = HistoryReader.of(trained)
        self._busy = threading.Lock()
        self._requests, self._rows = [0, 0], [0, 0]

    def drift(self) -> dict[str, Mean]:
        """Share of unknown items among rows of histories, and of unknown users among requests, so
        far; and the drift that the run's update found, as `update_…`."""
        update = self.trained.record.update
        found = {
            f"update_{name}": Mean(float(value), 1.0)
            for name, value in ((update and update.drift) or {}).items()
        }
        return found | {"unknown_items": Mean(*self._rows), "unknown_users": Mean(*self._requests)}

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
            outcomes: list[Answer | InputError | None] = [None] * len(requests)
            prepared = []
            for number, request in enumerate(requests):
                try:
                    prepared.append(self._prepared(number, request))
                except InputError as error:
                    outcomes[number] = error
            at_once = users_at_once(len(self._items))
            for first in range(0, len(prepared), at_once):
                batch = prepared[first : first + at_once]
                for one, answer in zip(batch, self._scored(batch), strict=True):
                    outcomes[one.number] = answer
            return [outcome for outcome in outcomes if outcome is not None]

    def _prepared(self, number: int, request: Request) -> _Prepared:
        history = self._reader.read(request.history, request.user_id)
        known = self._items.numbers(history.item_ids)
        self._rows[0] += int((known < 0).sum())
        self._rows[1] += len(known)
        if (known < 0).any() and not self._skip_unknown:
            unknown = sorted(set(history.item_ids[known < 0].tolist()))
            raise InputError(
                f"history: the policy does not know the item_id of {int((known < 0).sum())} of "
                f"{len(known)} rows ({some_of(unknown)}); leave them out"
            )
        seen = self._items.numbers(history.seen) if self._filter_seen else np.empty(0, np.int64)
        allowed = (
            None
            if request.candidates is None
            else candidate_numbers(self._items, id_array(request.candidates), self._skip_unknown)
        )
        k = self._k if request.k is None else request.k
        request_id = request.request_id or uuid4().hex
        return _Prepared(number, request, request_id, k, history, known, seen, allowed)

    def _scored(self, prepared: Sequence[_Prepared]) -> list[Answer]:
        latest = self._latest(prepared)
        users = self._users.numbers(latest.users)
        self._requests[0] += int((users < 0).sum())
        self._requests[1] += len(users)
        sessions = sessions_of(self.trained, latest, users, self._scorer.length)
        left_out = left_out_of(self.rule, latest)
        scores = self._scorer.scores(sessions, left_out, self._excluded(prepared), empty=True)
        return self._best(prepared, scores)

    def _excluded(self, prepared: Sequence[_Prepared]) -> Tensor | None:
        """(B, n_items) true for items that are not candidates; None if all may be recommended."""
        if all(one.allowed is None for one in prepared):
            return None
        excluded = torch.zeros(len(prepared), len(self._items), dtype=torch.bool)
        for row, one in enumerate(prepared):
            if one.allowed is not None:
                excluded[row] = True
                excluded[row, one.allowed] = False
        return excluded

    def _latest(self, prepared: Sequence[_Prepared]) -> Histories:
        """The latest sessions of the requests, with the policy's numbers of items."""
        histories, rows = [one.history for one in prepared], np.arange(len(prepared))
        observations = None
        if self.trained.logged_observation_size:
            observations = np.asarray([each.observation for each in histories], dtype=np.float32)
        sessions = None
        if histories[0].session_ids is not None:
            sessions = np.concatenate([each.session_ids for each in histories])
        batch = Histories(
            users=id_array([one.request.user_id for one in prepared]),
            owner=np.repeat(rows, [len(one.known) for one in prepared]),
            item_ids=np.concatenate([one.known for one in prepared]),
            rewards=np.concatenate([each.rewards for each in histories]),
            timestamps=np.concatenate([each.timestamps for each in histories]),
            session_ids=sessions,
            seen_owner=np.repeat(rows, [len(one.seen) for one in prepared]),
            seen_ids=np.concatenate([one.seen for one in prepared]),
            observations=observations,
        )
        known = batch.item_ids >= 0
        return (batch if known.all() else batch.rows(known)).latest_session(
            self.trained.record.session_gap_ms,
            np.asarray([one.request.new_session for one in prepared]),
        )

    def _best(self, prepared: Sequence[_Prepared], scores: Tensor) -> list[Answer]:
        n_items, drawn = scores.shape[1], None
        if self.rule.draws:
            users = id_array([one.request.user_id for one in prepared])
            requests = id_array([one.request_id for one in prepared])
            drawn = uniforms(users, requests, n_items + 1, self._seed)
        answers: dict[int, Answer] = {}
        sizes = [min(one.k, n_items) for one in prepared]
        for k in set(sizes):
            rows = [n for n, size in enumerate(sizes) if size == k]
            whole = len(rows) == len(prepared)
            of_rows = scores if whole else scores[rows]
            draws = drawn if drawn is None or whole else drawn[rows]
            found = best_of(self.rule, of_rows, k, draws)
            numbers, values, chances = (each.numpy() for each in found)
            # Items that may not be recommended come last.
            counts = np.isfinite(values).sum(1).tolist()
            columns = (each.tolist() for each in (self._items.ids[numbers], values, chances))
            for row, count, items, logs, shares in zip(rows, counts, *columns, strict=True):
                shown = items[:count], logs[:count], shares[:count]
                answers[row] = Answer(*shown, prepared[row].request_id, *self._source)
        return [answers[row] for row in range(len(prepared))]
