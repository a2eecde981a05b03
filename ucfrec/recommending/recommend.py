"""Recommend next items to users of logs, also to new ones; similar items; an approximate search."""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule, best_items
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.logs.candidates import name_set
from ucfrec.logs.histories import HISTORIES, Histories
from ucfrec.logs.rows import mix_bits
from ucfrec.logs.summary import note_unknown
from ucfrec.recommending.requests import TIME_FORMS, parse_time
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import require_ids, require_whole

RANK = "rank"
SCORE = "score"
SIMILAR_ITEM = "similar_item_id"
_LAST_MS = 2**48  # in the year 10889
_USERS_AT_ONCE = 128
"""Most users of a forward pass; scores of more leave the processor's cache."""
_SCORES = 2**23
"""Most scores of a forward pass of several users, users × items: 32 MiB, as memory for more is
given back after every pass, and asking for it anew takes as long as the product."""
_LARGE, _SPARSE = 2**16, 16
"""Candidates are scored without the other items of catalogues from this size on, if they are at
most one item in so many; in smaller ones, the product with all is as fast."""
_ITEMS_AT_ONCE = 1024
_NEGLIGIBLE = 80.0
"""Nats below the best score from which on an item counts nothing, in float32."""
_FEWEST = 1_000
"""Items below which one list of an index would hold few of them."""
_SHARE = 16
"""One in so many lists of an index is searched."""
_AT_LEAST = 8
"""Lists that are searched at least."""
_MORE = 256
"""Candidates that are scored beside four times those requested."""
_SAMPLE = 32
"""One in so many sessions is also searched exactly."""


def decide(
    trained: TrainedPolicy,
    batches: Iterable[Histories],
    k: int,
    *,
    rule: DecisionRule | None = None,
    filter_seen: bool = True,
    candidates: Iterable[Any] | None = None,
    skip_unknown: bool = False,
    new_session: bool = False,
    at: str | float | None = None,
    seed: int = 0,
    index: "ItemIndex | None" = None,
) -> Iterator[tuple[pd.DataFrame, IntArray]]:
    """`k` next items of every user, by the decision rule.

    A user's latest session is assumed to continue: items are scored at its next step, and the
    rewards that the session has had lower the target as in acting; with `new_session`, items are
    scored at the first step of a new one. A rule with a temperature draws the items one after the
    other; otherwise they are the `k` best. Of unknown users, the rows alone make the state.

    Args:
        batches: the users' histories.
        k: number of items per user, at least 1.
        rule: the decision rule; None for the run's own.
        filter_seen: exclude every item that the user has seen.
        candidates: the only item_ids to recommend, for all users; None for all items.
        skip_unknown: ignore rows of items that are not in the training data, and such candidates
            where others are left.
        new_session: whether users begin a new session.
        at: time of the requests, ISO 8601 or ms: items that are not available then are not
            recommended; None for now.
        seed: of the draws of a rule with a temperature, or that explores. They also depend on the
            user, the candidates, the time of the user's last row, and `at` or, where items come and
            go, the time: the same request gives the same items, and a later one draws anew.
        index: finds the items approximately, by the same rule; None to find them exactly.

    Returns:
        One frame per batch: `user_id`, `rank` (from 1), `item_id`, `score` (log-probability at
        temperature 1 among the items that are left, nats; with an index, less that of the user's
        best item), `propensity` (probability of the item at its position, given those before it),
        `request_id` (the same for all items of a user); k rows per user, in the order shown, fewer
        if fewer items remain. Beside it, for each row, when the user's session began, ms; −1 for
        now.

    Raises:
        InputError: an argument is wrong, the policy's actions are vectors, or an item of the logs
            or of the candidates is not in the training data. Items of the logs are checked when
            their batch is read.
    """
    at_ms = read_time(at)
    if at_ms is None and trained.offers is not None:
        at_ms = round(time.time() * 1000)
    chooser = Chooser(trained, trained.item_scorer(rule), seed, index, at_ms)
    k, allowed, remaining = require_whole("k", k), None, iter(batches)
    told_apart = "" if at_ms is None else f"-{at_ms}"
    if candidates is not None:
        ids = require_ids("candidates", candidates, schema.ITEM_ID)
        allowed = np.sort(candidate_numbers(trained.items, ids, skip_unknown))
        told_apart += f"-{name_set(trained.items.ids[allowed])}"
    _require_available(trained, chooser.request_times(1), allowed)

    def make_frame(batch: Histories) -> tuple[pd.DataFrame, IntArray]:
        histories = batch.with_numbers(trained.items, filter_seen)
        if not (skip_unknown or (histories.item_ids >= 0).all()):
            raise _refuse_unknown(trained.items, [batch, *remaining])
        # A replay of the same request draws the same.
        last = np.zeros(len(batch.users), dtype=np.int64)
        np.maximum.at(last, batch.owner, batch.timestamps)
        requests = np.asarray([f"{seed}-{ms}{told_apart}" for ms in last.tolist()], dtype=object)
        new = np.full(len(histories.users), new_session)
        candidates = [allowed] * len(new)
        items, scores, propensities, began = chooser.choose(histories, requests, k, new, candidates)
        left = np.isfinite(scores)
        counts = left.sum(1)
        frame = pd.DataFrame(
            {
                schema.USER_ID: np.repeat(histories.users, counts),
                RANK: np.cumsum(left, axis=1)[left],
                schema.ITEM_ID: trained.items.ids[items[left]],
                SCORE: scores[left],
                schema.PROPENSITY: propensities[left],
                schema.REQUEST_ID: np.repeat(requests, counts),
            }
        )
        return frame, np.repeat(began, counts)

    def make_frames() -> Iterator[tuple[pd.DataFrame, IntArray]]:
        count = unknown = 0
        for batch in remaining:
            count += len(batch.users)
            unknown += int((trained.users.numbers(batch.users) < 0).sum())
            yield make_frame(batch)
        if len(trained.user_ids):
            note_unknown(HISTORIES, schema.USER_ID, unknown, count, "the run was trained on")

    return make_frames()


def _require_available(trained: TrainedPolicy, time: Tensor, allowed: IntArray | None) -> None:
    """Check that some item, or candidate, is available at a time (1,) in ms."""
    if trained.offers is None:
        return
    offered = trained.offers.at(time).mask()[0]
    if not (offered if allowed is None else offered[allowed]).any():
        clock = pd.Timestamp(int(time), unit="ms")
        none = "no item" if allowed is None else f"none of {len(allowed)} candidates"
        raise InputError(
            f"{trained.folder}: {none} is available at {clock:%Y-%m-%d %H:%M} UTC; give the time "
            "of requests with --at (at=... in Python), or a newer table of items to ucfrec update"
        )


def read_time(at: str | float | datetime | None) -> int | None:
    """Milliseconds since 1970 of the time of requests; InputError if it is no time."""
    if at is None:
        return None
    written = at.isoformat() if isinstance(at, datetime) else at
    with suppress(TypeError, ValueError, OverflowError):
        time_ms = round(parse_time(written))
        if abs(time_ms) < _LAST_MS and not isinstance(at, bool):
            return time_ms
    raise InputError(f"the time of the requests is {at!r:.60}; {TIME_FORMS}")


@dataclass(frozen=True)
class Chooser:
    """Chooses items for the next step of users under a decision rule."""

    trained: TrainedPolicy
    scorer: Scorer
    seed: int
    index: "ItemIndex | None" = None
    at_ms: int | None = None
    """Time at which items must be available, ms; None for that of each call."""

    def request_times(self, count: int) -> Tensor:
        """(count,) int64 ms, all the same."""
        at_ms = 1000 * time.time() if self.at_ms is None else self.at_ms
        return torch.full((count,), round(at_ms))

    def choose(
        self,
        histories: Histories,
        requests: Array,
        k: int,
        new: BoolArray,
        candidates: Sequence[IntArray | None],
    ) -> tuple[Array, Array, Array, IntArray]:
        """Items (U, k) in the order shown, their log-probabilities at temperature 1, −∞ where no
        more may be shown, their propensities, and when the sessions (U,) began, ms, −1 for now.

        Args:
            histories: of U users, of `with_numbers`; what they have seen is not recommended.
            requests: (U,) text that tells a user's requests apart.
            k: number of items; of a smaller catalogue, all.
            new: (U,) users who begin a new session.
            candidates: of every user the only items to recommend, sorted; None for all.
        """
        in_catalogue = histories.item_ids >= 0
        histories = histories if in_catalogue.all() else histories.with_rows(in_catalogue)
        latest = histories.latest_session(self.trained.record.session_gap_ms, new)
        n_items = len(self.trained.items)
        k = min(k, n_items)
        # Sessions of about the same length share a pass, which costs as much as the longest.
        limited = np.array([some is not None for some in candidates], dtype=bool)
        order = np.lexsort((np.bincount(latest.owner, minlength=len(new)), limited))
        parts = []
        for group in np.split(order, [len(order) - int(limited.sum())]):
            lists = [some for user in group.tolist() if (some := candidates[user]) is not None]
            width = max(k, max(map(len, lists), default=0))
            alone = self.scorer.is_product and n_items >= max(_LARGE, _SPARSE * width)
            count = _SPARSE * width if lists and alone else n_items
            at_once = _USERS_AT_ONCE
            if lists or self.index is None:
                at_once = max(1, min(at_once, _SCORES // count))
            for first in range(0, len(group), at_once):
                users = group[first : first + at_once]
                part = latest if len(order) == 1 else latest.of_users(users)
                some = _pad_lists(lists[first : first + at_once], width) if lists else None
                parts.append(self._choose_together(part, requests[users], k, some, alone))
        back = np.argsort(order, kind="stable")
        items, scores, propensities = (
            np.concatenate(arrays)[back] for arrays in zip(*parts, strict=True)
        )
        began = np.full(len(new), -1)
        starts = np.flatnonzero(np.diff(latest.owner, prepend=-1))
        began[latest.owner[starts]] = latest.timestamps[starts]
        return items, scores, propensities, began

    def _choose_together(
        self,
        latest: Histories,
        requests: Array,
        k: int,
        candidates: Tensor | None,
        alone: bool,
    ) -> tuple[Array, Array, Array]:
        """`choose` with one forward pass, of latest sessions and candidates (U, C), −1 for none,
        which may be scored alone, without the other items."""
        rule = self.scorer.rule
        n_items = len(self.trained.items)
        excluded = None
        sessions = sessions_of(self.trained, latest, self.scorer.length)
        if self.trained.offers is not None:
            offer = self.trained.offers.at(self.request_times(len(requests)))
            sessions = replace(sessions, offer=offer)
        # What was seen, and what the latest sessions have shown, if the rule excludes it.
        in_catalogue = latest.seen_ids >= 0
        rows = latest.seen_owner[in_catalogue]
        seen = latest.seen_ids[in_catalogue]
        if rule.exclude_seen:
            rows = np.concatenate([rows, latest.owner])
            seen = np.concatenate([seen, latest.item_ids])
        left_out = torch.from_numpy(rows), torch.from_numpy(seen)
        if candidates is None and self.index is not None:
            best, values = self.index.best(sessions, left_out, k)
            return best.numpy(), values.numpy(), np.ones(best.shape)
        if candidates is not None and alone:
            query = self.scorer.query(sessions)
            part = self.scorer.weigh(query)
            scores = self.scorer.scores_of_some(query, part, candidates, left_out)
        else:
            if candidates is not None:
                excluded = torch.ones(len(candidates), n_items + 1, dtype=torch.bool)
                excluded[torch.arange(len(candidates)).unsqueeze(1), candidates] = False
                candidates, excluded = None, excluded[:, :-1]  # the last column is that of −1
            scores = self.scorer.scores(sessions, left_out, excluded, empty=True)
        draws = None
        if rule.draws:
            counters = torch.arange(n_items + 1).unsqueeze(0)
            if candidates is not None:
                counters = F.pad(candidates, (0, 1), value=n_items)
            draws = uniforms(latest.users, requests, counters.numpy(), self.seed)
        with torch.inference_mode():
            highest = scores.amax(-1, keepdim=True)
            none = torch.isneginf(highest)
            if none.any():
                scores[none[:, 0]] = highest[none] = 0.0
            items, propensities = rule.rank_items(scores, k, draws, self.scorer.list_term)
            values = scores.gather(1, items)
            # In place, as memory for another copy of the scores takes longer than their sums.
            # Exponentials that underflow take long; what is lower adds nothing to a sum from 1 on.
            totals = scores.sub_(highest).clamp_(min=-_NEGLIGIBLE).exp_().sum(-1, keepdim=True)
            values = values.sub_(totals.log_().add_(highest)).masked_fill_(none, -torch.inf)
            items = items if candidates is None else candidates.gather(1, items)
            return items.numpy(), values.numpy(), propensities.numpy()


def _pad_lists(lists: Sequence[IntArray], width: int) -> Tensor:
    """The numbers of each list (U, width), and −1."""
    padded = pad_sequence(list(map(torch.from_numpy, lists)), batch_first=True, padding_value=-1)
    return F.pad(padded, (0, width - padded.shape[1]), value=-1)


def candidate_numbers(index: IdLookup, ids: Array, skip_unknown: bool) -> IntArray:
    """Numbers (N,) of named items. InputError if the policy does not know one of them; with
    `skip_unknown`, which leaves unknown ones out, only if it knows none."""
    numbers = index.numbers(ids)
    in_catalogue = numbers >= 0
    if not (in_catalogue.any() if skip_unknown else in_catalogue.all()):
        unknown = ids[~in_catalogue].tolist()
        raise InputError(
            f"{len(unknown)} of {len(ids)} named items are not known to the policy "
            f"({name_some(unknown)}); name items of its catalogue"
        )
    return numbers[in_catalogue]


def _refuse_unknown(index: IdLookup, batches: Iterable[Histories]) -> InputError:
    unknown = [ids[index.numbers(ids) < 0] for ids in (batch.item_ids for batch in batches)]
    rows = np.concatenate(unknown).tolist()
    items = sorted(set(rows))
    return InputError(
        f"{len(rows)} rows have an item_id that the policy does not know ({len(items)} items: "
        f"{name_some(items)}); prepare and train on logs with them, or leave those rows out with "
        "--skip-unknown (skip_unknown=True in Python)"
    )


def name_some(values: Sequence[Any]) -> str:
    """The first of the values, for a message."""
    return ", ".join(f"{v!s:.60}" for v in values[:3]) + (", …" if len(values) > 3 else "")


def sessions_of(trained: TrainedPolicy, histories: Histories, length: int) -> Sessions:
    """The sessions of users, each before the step for which items are scored, from the rows of
    their latest sessions, of `with_numbers`, of which `length` items are read. InputError if the
    policy needs observations that the histories lack."""
    expected, observations = trained.record.observation_size, None
    if expected:
        logged = histories.observations
        size = 0 if logged is None else logged.shape[1]
        if logged is None or size != expected:
            raise InputError(
                f"the policy was trained with observations of {expected} numbers; those of the "
                f"histories have {size}"
            )
        context = trained.policy.config.context
        observations = torch.tensor(logged).unsqueeze(1).expand(-1, context, -1)
    users = trained.users.numbers(histories.users)
    owner = histories.owner
    items = histories.item_ids
    rewards = histories.rewards
    sessions = Sessions.from_rows(owner, items, rewards, users, length, observations)
    if (model := trained.reward_model) is None:
        return sessions
    counts = model.interests.count_trained(sessions.users, owner, histories.timestamps)
    return replace(sessions, trained_steps=counts)


def uniforms(
    users: Array,
    requests: Array,
    counters: IntArray,
    seed: int,
) -> Tensor:
    """Draws (B, C) from [0, 1), float64, that depend on the user, the request, the seed and the
    counters (B or 1, C): the same in any batch. They are SplitMix64's (Steele et al., 2014)."""
    of_users, of_requests = (
        pd.util.hash_array(np.asarray(ids).astype(str).astype(object)) for ids in (users, requests)
    )
    step = np.uint64(0x9E3779B97F4A7C15)
    with np.errstate(over="ignore"):
        key = of_users + mix_bits(of_requests) - step
        state = mix_bits(key + np.uint64(seed % 2**64) * np.uint64(0xD1B54A32D192ED03))[:, None]
        state = mix_bits(state + counters.astype(np.uint64) * step)
    return torch.from_numpy((state >> np.uint64(11)).astype(np.float64) / 2**53)


class ItemIndex:
    """Looks for the best items of large catalogues in some lists of similar ones (faiss's IVF), and
    scores these exactly.

    Lists are chosen by the product with the items' vectors. What was shown (repetition, shared
    tags) counts among the candidates found, not in finding them. Sessions of which too few are left
    are scored exactly.
    """

    def __init__(self, scorer: Scorer, kind: str) -> None:
        """Index the items of a policy, whose weights must not change; InputError if faiss is
        missing, or the rule or the policy need scores of all items."""
        try:
            import faiss
        except ModuleNotFoundError:
            raise InputError(
                "the approximate search needs faiss, which is not installed; install ucfrec[faiss]"
            ) from None
        if scorer.rule.draws:
            raise InputError(
                f"the rule draws items ({scorer.rule}), which needs all scores; leave "
                "--approximate out, or give --temperature 0 --explore 0"
            )
        if not scorer.is_product:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own under this rule; "
                "leave --approximate out"
            )
        self._scorer = scorer
        self._rng = np.random.default_rng(0)
        vectors = scorer.vectors()
        size = vectors.shape[1]
        lists = max(1, round(len(vectors) ** 0.5)) if len(vectors) >= _FEWEST else 1
        faiss.omp_set_num_threads(torch.get_num_threads())
        self._index = faiss.IndexIVFFlat(
            faiss.IndexFlatIP(size), size, lists, faiss.METRIC_INNER_PRODUCT
        )
        self._index.cp.seed = 0
        self._index.nprobe = max(_AT_LEAST, lists // _SHARE)
        self._index.train(vectors)
        self._index.add(vectors)
        self.found = self.wanted = 0
        """Of the best items of the sampled sessions: those found, and all."""
        self.sampled = 0
        """Sessions that were also searched exactly."""

    def best(
        self,
        sessions: Sessions,
        left_out: tuple[Tensor, Tensor],
        k: int,
    ) -> tuple[Tensor, Tensor]:
        """`k` items (B, k) of sessions, best first, without what is `left_out` (see
        `Scorer.scores`), and their scores (B, k) less that of the best, nats; −∞ where fewer are
        left."""
        scorer, n_items = self._scorer, self._index.ntotal
        query = scorer.query(sessions)
        part = scorer.weigh(query)
        count = min(n_items, 4 * k + _MORE)
        factors = F.pad(part.factors, (0, 1), value=1.0).numpy()
        products, numbers = map(torch.from_numpy, self._index.search(factors, count))
        # Of equal scores, the lowest number comes first.
        candidates, order = numbers.sort()
        products = products.gather(1, order)
        scores = scorer.scores_of_some(query, part, candidates, left_out, products)
        best = best_items(scores, k)
        items, scores = candidates.gather(1, best), scores.gather(1, best)
        short = torch.isneginf(scores[:, -1])
        sampled = torch.zeros(len(short), dtype=torch.bool)
        sampled[self._rng.choice(len(short), size=-(-len(short) // _SAMPLE), replace=False)] = True
        for row in torch.nonzero(short | sampled)[:, 0].tolist():
            items_out = left_out[1][left_out[0] == row]
            row_out = torch.zeros_like(items_out), items_out
            session = sessions.at(torch.tensor([row]))
            exact = scorer.scores(session, row_out, empty=True)
            best = best_items(exact, k)[0]
            if short[row]:
                items[row], scores[row] = best, exact[0, best]
            if sampled[row]:
                best = best[~torch.isneginf(exact[0, best])]
                self.found += int(torch.isin(best, items[row]).sum())
                self.wanted += len(best)
                self.sampled += 1
        highest = scores[:, :1].masked_fill(torch.isneginf(scores[:, :1]), 0.0)
        return items, scores - highest


def similar_items(
    trained: TrainedPolicy, items: Iterable[Any] | None = None, k: int = 10
) -> pd.DataFrame:
    """The `k` most similar other items of each item, by the cosine of the items' vectors.

    The vectors are those by which the policy scores items; of a policy that scores items in a way
    of its own, such as `item-knn`, the store's embeddings of the items. InputError if the policy's
    actions are vectors, an item is not known, or `items` or `k` is something else.

    Args:
        items: item_ids; None for all.

    Returns:
        `item_id`, `rank` (from 1), `similar_item_id`, `score` (cosine, −1 to 1).
    """
    k, ids = require_whole("k", k), trained.items.ids
    chosen = ids if items is None else require_ids("items", items, schema.ITEM_ID)
    scorer = trained.item_scorer(replace(trained.rule, reward_weight=0.0, lookahead=0.0))
    assert scorer.states is not None
    vectors = scorer.states.embeddings
    if scorer.has_factors:
        vectors = torch.from_numpy(scorer.vectors()[:, :-1])
    vectors = F.normalize(vectors, dim=1)
    numbers = candidate_numbers(trained.items, chosen, skip_unknown=False)
    k = min(k, len(ids) - 1)
    parts = []
    for some in torch.split(torch.from_numpy(numbers), _ITEMS_AT_ONCE):
        cosines = (vectors[some] @ vectors.T).scatter(1, some.unsqueeze(1), -torch.inf)
        best = best_items(cosines, k)
        parts.append((best, cosines.gather(1, best)))
    similar, scores = (torch.cat(values).flatten().numpy() for values in zip(*parts, strict=True))
    return pd.DataFrame(
        {
            schema.ITEM_ID: ids[numbers.repeat(k)],
            RANK: np.tile(np.arange(1, k + 1), len(numbers)),
            SIMILAR_ITEM: ids[similar],
            SCORE: scores,
        }
    )
