"""Recommend next items to the users of a log, also to users who are not in the training logs."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.item_index import ItemIndex
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.sessions import Sessions
from ucfrec.errors import InputError
from ucfrec.logs.rows import mix_bits
from ucfrec.recommending.histories import Histories
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import require_ids, require_whole

RANK, SCORE = "rank", "score"
_USERS_AT_ONCE = 128
"""Most users of a forward pass; scores of more leave the processor's cache."""
_SCORES = 2**24
"""Most scores of a forward pass of several users, users × items: 64 MiB."""
_NEGLIGIBLE: Final = 80.0
"""Nats below the best score from which on an item counts nothing, in float32."""


def recommend(
    trained: TrainedPolicy,
    batches: Iterable[Histories],
    k: int,
    *,
    rule: DecisionRule | None = None,
    filter_seen: bool = True,
    candidates: Iterable[Any] | None = None,
    skip_unknown: bool = False,
    new_session: bool = False,
    seed: int = 0,
    index: ItemIndex | None = None,
) -> Iterator[pd.DataFrame]:
    """`k` next items of every user, by the decision rule.

    A user's latest session is assumed to continue: items are scored at its next step, and the
    rewards that the session has had lower the target as in acting; with `new_session`, items are
    scored at the first step of a new one. A rule with a temperature
    draws the items one after the other, without repetition; otherwise they are the `k` best. For
    users who are not in the training logs, the state is made of their rows alone.

    Args:
        batches: the users' histories.
        k: number of items per user, at least 1.
        rule: the decision rule; None for the run's own.
        filter_seen: exclude every item that the user has seen.
        candidates: the only item_ids to recommend, for all users; None for all items.
        skip_unknown: ignore rows of items that are not in the training data, and such candidates
            where others are left.
        new_session: whether users begin a new session.
        seed: of the draws of a rule with a temperature, or that explores. They also depend on the
            user and the time of the user's last row: the same history gives the same items, and a
            later one draws anew.
        index: finds the items approximately, by the same rule; None to find them exactly.

    Returns:
        One frame per batch: `user_id`, `rank` (from 1), `item_id`, `score` (log-probability at
        temperature 1 among the items that are left, nats; with an index, less that of the user's
        best item), `propensity` (probability of the item at its position, given those before it),
        `request_id` (the same for all items of a user); k rows per user, in the order shown, fewer
        if fewer items remain.

    Raises:
        InputError: an argument is wrong, the policy's actions are vectors, or an item of the logs
            or of the candidates is not in the training data. Items of the logs are checked when
            their batch is read.
    """
    chooser = Chooser(trained, trained.item_scorer(rule), seed, index)
    k, excluded = require_whole("k", k), None
    if candidates is not None:
        ids = require_ids("candidates", candidates, schema.ITEM_ID)
        allowed = candidate_numbers(trained.items, ids, skip_unknown)
        excluded = torch.ones(len(trained.items), dtype=torch.bool)
        excluded[torch.from_numpy(allowed)] = False

    def to_frame(histories: Histories) -> pd.DataFrame:
        requests = _request_ids(histories, seed)
        new = np.full(len(histories.users), new_session)
        items, scores, propensities = chooser.choose(histories, requests, k, new, excluded)
        left = np.isfinite(scores)
        return pd.DataFrame(
            {
                schema.USER_ID: np.repeat(histories.users, left.sum(1)),
                RANK: np.cumsum(left, axis=1)[left],
                schema.ITEM_ID: trained.items.ids[items[left]],
                SCORE: scores[left],
                schema.PROPENSITY: propensities[left],
                schema.REQUEST_ID: np.repeat(requests, left.sum(1)),
            }
        )

    return map(to_frame, _number_items(trained.items, batches, filter_seen, skip_unknown))


def _number_items(
    known_ids: IdLookup, batches: Iterable[Histories], filter_seen: bool, skip_unknown: bool
) -> Iterator[Histories]:
    """Histories with the numbers of their items, −1 for unknown ones."""
    remaining = iter(batches)
    for batch in remaining:
        numbered = batch.with_numbers(known_ids, filter_seen)
        if not ((numbered.item_ids >= 0).all() or skip_unknown):
            raise _unknown_items(known_ids, [batch, *remaining])
        yield numbered


@dataclass(frozen=True)
class Chooser:
    """Chooses items for the next step of users under a decision rule."""

    trained: TrainedPolicy
    scorer: Scorer
    seed: int
    index: ItemIndex | None = None

    def choose(
        self,
        histories: Histories,
        requests: Array,
        k: int,
        new: BoolArray,
        excluded: Tensor | None = None,
        candidates: Sequence[IntArray | None] = (),
    ) -> tuple[Array, Array, Array]:
        """Items (U, k) in the order shown, their log-probabilities at temperature 1, −∞ where no
        more may be shown, and their propensities.

        Args:
            histories: of U users, of `with_numbers`; what they have seen is not recommended.
            requests: (U,) text that tells a user's requests apart.
            k: number of items; of a smaller catalogue, all.
            new: (U,) users who begin a new session.
            excluded: (n_items,) true for items that no user is recommended.
            candidates: of every user the only items to recommend, None for all; empty for all.
        """
        in_catalogue = histories.item_ids >= 0
        histories = histories if in_catalogue.all() else histories.with_rows(in_catalogue)
        latest = histories.latest_session(self.trained.record.session_gap_ms, new)
        at_once, count = _USERS_AT_ONCE, len(self.trained.items)
        if self.index is None:
            at_once = max(1, min(_USERS_AT_ONCE, _SCORES // count))
        # Sessions of about the same length share a pass, which costs as much as the longest.
        order = np.argsort(np.bincount(latest.owner, minlength=len(new)), kind="stable")
        parts = []
        for first in range(0, len(order), at_once):
            users = order[first : first + at_once]
            part = latest if len(order) == 1 else latest.of_users(users)
            without = excluded
            if any(allowed is not None for allowed in candidates):
                without = _exclude_all_but([candidates[user] for user in users], count)
            parts.append(self._choose_together(part, requests[users], min(k, count), without))
        back = np.argsort(order, kind="stable")
        items, scores, propensities = (
            np.concatenate(arrays)[back] for arrays in zip(*parts, strict=True)
        )
        return items, scores, propensities

    def _choose_together(
        self, latest: Histories, requests: Array, k: int, excluded: Tensor | None
    ) -> tuple[Array, Array, Array]:
        """`choose` with one forward pass, of latest sessions."""
        rule = self.scorer.rule
        sessions = sessions_of(self.trained, latest, self.scorer.length)
        left_out = _left_out(rule, latest)
        if self.index is not None:
            items, values = self.index.best(sessions, left_out, excluded, k)
            return items.numpy(), values.numpy(), np.ones(items.shape)
        scores = self.scorer.scores(sessions, left_out, excluded, empty=True)
        draws = None
        if rule.draws:
            draws = uniforms(latest.users, requests, scores.shape[1] + 1, self.seed)
        items, values, propensities = _choose_best(rule, scores, k, draws)
        return items.numpy(), values.numpy(), propensities.numpy()


def _exclude_all_but(candidates: Sequence[IntArray | None], n_items: int) -> Tensor:
    """(B, n_items) true for items that are not among a user's candidates; none for None."""
    excluded = torch.zeros(len(candidates), n_items, dtype=torch.bool)
    for row, allowed in enumerate(candidates):
        if allowed is not None:
            excluded[row] = True
            excluded[row, allowed] = False
    return excluded


@torch.inference_mode()
def _choose_best(
    rule: DecisionRule, scores: Tensor, k: int, draws: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """`k` items (B, k), their log-probabilities (B, k) at temperature 1 among those left, −∞ for
    items that are excluded, and their propensities (B, k) float64.

    Args:
        scores: (B, n_items) of `Scorer.scores`; may be overwritten.
        k: number of items, at most n_items.
        draws: (B, n_items + 1) of `uniforms`; needed if the rule draws.
    """
    # Exponentials that underflow take long, and what is lower adds nothing to a sum of 1 or more.
    lowest = scores.amax(-1, keepdim=True) - _NEGLIGIBLE
    total = scores.clamp(min=lowest).logsumexp(-1, keepdim=True)
    none = torch.isneginf(total)
    if none.any():
        scores[none[:, 0]] = 0.0
    items, propensities = rule.rank_items(scores, k, draws)
    values = scores.gather(1, items) - total
    return items, values.masked_fill(none, -torch.inf), propensities


def candidate_numbers(index: IdLookup, ids: Array, skip_unknown: bool) -> IntArray:
    """Numbers (N,) of the items that may be recommended.

    Args:
        skip_unknown: leave out those that the policy does not know.

    Raises:
        InputError: the policy does not know some of them, or with `skip_unknown`, any.
    """
    numbers = index.numbers(ids)
    in_catalogue = numbers >= 0
    if not (in_catalogue.any() if skip_unknown else in_catalogue.all()):
        unknown = ids[~in_catalogue].tolist()
        remedy = "name items of its catalogue" if skip_unknown else "leave them out"
        raise InputError(
            f"{len(unknown)} of {len(ids)} candidates are items that the policy does not know "
            f"({name_some(unknown)}); {remedy}"
        )
    return numbers[in_catalogue]


def _unknown_items(index: IdLookup, batches: Iterable[Histories]) -> InputError:
    rows, items = 0, set[Any]()
    for batch in batches:
        unknown = batch.item_ids[index.numbers(batch.item_ids) < 0]
        rows += len(unknown)
        items |= set(unknown.tolist())
    have = "row has" if rows == 1 else "rows have"
    count = "1 item" if len(items) == 1 else f"{len(items)} items"
    return InputError(
        f"{rows} {have} an item_id that the policy does not know ({count}: "
        f"{name_some(sorted(items))}); prepare and train on logs with them, or leave those rows "
        "out with --skip-unknown (skip_unknown=True in Python)"
    )


def name_some(values: Sequence[Any]) -> str:
    """The first of the values, for a message."""
    return ", ".join(map(str, values[:3])) + (", …" if len(values) > 3 else "")


def sessions_of(trained: TrainedPolicy, histories: Histories, length: int) -> Sessions:
    """The sessions of users, each before the step for which items are scored.

    Args:
        histories: U users with the N rows of their latest sessions, of `with_numbers`.
        length: items of a session that are read.

    Raises:
        InputError: the policy needs observations that the histories lack.
    """
    expected, observations = trained.logged_observation_size, None
    if expected:
        logged = histories.observations
        size = 0 if logged is None else logged.shape[1]
        if logged is None or size != expected:
            raise InputError(
                f"the policy was trained with observations of {expected} numbers; those of the "
                f"histories have {size}"
            )
        seen = torch.from_numpy(np.delete(logged, trained.dropped, axis=1))
        observations = seen.unsqueeze(1).expand(-1, trained.policy.config.context, -1)
    users = trained.users.numbers(histories.users)
    rows, rewards = histories.item_ids, histories.rewards
    return Sessions.from_rows(histories.owner, rows, rewards, users, length, observations)


def _left_out(rule: DecisionRule, histories: Histories) -> tuple[Tensor, Tensor]:
    """Rows (N,) and items (N,) of what is not recommended: the known ones of `seen_ids`, and what
    the latest sessions have shown, if the rule excludes it."""
    in_catalogue = histories.seen_ids >= 0
    rows, items = [histories.seen_owner[in_catalogue]], [histories.seen_ids[in_catalogue]]
    if rule.exclude_seen:
        rows.append(histories.owner)
        items.append(histories.item_ids)
    return torch.from_numpy(np.concatenate(rows)), torch.from_numpy(np.concatenate(items))


def _request_ids(batch: Histories, seed: int) -> Array:
    """(U,) text that tells the requests of each user apart: the seed and the time (ms) of the
    user's last row, so that a replay draws the same and later rows draw anew."""
    last = np.zeros(len(batch.users), dtype=np.int64)
    np.maximum.at(last, batch.owner, batch.timestamps)
    return np.asarray([f"{seed}-{time}" for time in last.tolist()], dtype=object)


def uniforms(users: Array, requests: Array, count: int, seed: int) -> Tensor:
    """Draws (B, count) from [0, 1), float64, that depend on the user, the request and the seed.

    A request is answered the same in any batch. The numbers are SplitMix64's (Steele et al., 2014),
    from a counter of hashes and items.
    """
    of_users, of_requests = (
        pd.util.hash_array(np.asarray(ids).astype(str).astype(object)) for ids in (users, requests)
    )
    step = np.uint64(0x9E3779B97F4A7C15)
    with np.errstate(over="ignore"):
        key = of_users + mix_bits(of_requests) - step
        state = mix_bits(key + np.uint64(seed % 2**64) * np.uint64(0xD1B54A32D192ED03))[:, None]
        state = mix_bits(state + np.arange(count, dtype=np.uint64) * step)
    return torch.from_numpy((state >> np.uint64(11)).astype(np.float64) / 2**53)
