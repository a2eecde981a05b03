"""Recommend next items to the users of a log, also to users who are not in the training logs."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import Decider, DecisionRule
from ucfrec.acting.logged_decisions import seen_before, session_scores
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.recommending.histories import Histories
from ucfrec.runs.trained_policy import TrainedPolicy

RANK, SCORE = "rank", "score"
_USERS_AT_ONCE = 1024

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]


def recommend(
    trained: TrainedPolicy,
    batches: Iterable[Histories],
    k: int,
    *,
    rule: DecisionRule | None = None,
    filter_seen: bool = True,
    candidates: Sequence[Any] | None = None,
    skip_unknown: bool = False,
    seed: int = 0,
) -> Iterator[pd.DataFrame]:
    """`k` next items of every user, by the decision rule.

    A user's latest session is assumed to continue: items are scored at its next step, and the
    rewards that the session has earned lower the target as in acting. A rule with a temperature
    draws the items one after the other, without repetition; otherwise they are the `k` best. For
    users who are not in the training logs, the state is made of their rows alone.

    Args:
        trained: a policy of items.
        batches: the users' histories.
        k: number of items per user, at least 1.
        rule: the decision rule; None for the run's own.
        filter_seen: leave out every item that the user has seen.
        candidates: the only item_ids to recommend, for all users; None for all items.
        skip_unknown: ignore rows of items that are not in the training data.
        seed: of the draws of a rule with a temperature.

    Returns:
        One frame per batch: `user_id`, `rank` (from 1), `item_id`, `score` (log-probability at
        temperature 1 among the items that are left, nats); k rows per user, fewer if fewer items
        remain.

    Raises:
        InputError: an argument is wrong, the policy's actions are vectors, or an item of the logs
            or of the candidates is not in the training data. Items of the logs are checked when
            their batch is read.
    """
    if trained.item_states is None or trained.item_ids is None:
        raise InputError(
            "this policy's actions are vectors; recommending needs a policy trained on items"
        )
    _require_whole(k)
    index = trained.item_index
    excluded = None if candidates is None else _all_but(index, candidates)
    decider = trained.decider(rule)

    def frames() -> Iterator[pd.DataFrame]:
        remaining = iter(batches)
        for batch in remaining:
            known = positions(index, batch.item_ids) >= 0
            if not (known.all() or skip_unknown):
                raise _unknown(index, [batch, *remaining])
            latest = batch.rows(known).latest_session(trained.record["session_gap_ms"])
            users = positions(trained.user_index, latest.users)
            store = next_steps(trained, latest, positions(index, latest.item_ids), users)
            seen = positions(index, batch.seen_ids) if filter_seen else None
            chosen = _Choice(decider, k, seen, excluded, seed)
            yield _recommended(trained, store, batch, chosen)

    return frames()


def _require_whole(k: int) -> None:
    if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or k < 1:
        raise InputError(f"k is {k!r}; give a whole number, 1 or more")


@dataclass(frozen=True)
class _Choice:
    """How the items of one batch are chosen."""

    decider: Decider
    k: int
    seen: IntArray | None
    """(M,) index of each item of `Histories.seen_ids`, which its user is not recommended; −1 for
    items without an index."""
    excluded: Tensor | None
    """(n_items,) true for items that no user is recommended."""
    seed: int


def _recommended(
    trained: TrainedPolicy, store: EpisodeStore, batch: Histories, choice: _Choice
) -> pd.DataFrame:
    """Items for the last step of every episode of `store`."""
    item_ids, frames = trained.item_ids, []
    assert item_ids is not None
    rule = choice.decider.rule
    decider = replace(choice.decider, rule=replace(rule, exclude_seen=False))
    for first in range(0, len(batch.users), _USERS_AT_ONCE):
        rows = np.arange(first, min(first + _USERS_AT_ONCE, len(batch.users)))
        left_out = torch.zeros(len(rows), len(item_ids), dtype=torch.bool)
        if choice.seen is not None:
            of_rows = slice(*np.searchsorted(batch.seen_owner, [rows[0], rows[-1] + 1]))
            known = choice.seen[of_rows] >= 0
            left_out[batch.seen_owner[of_rows][known] - first, choice.seen[of_rows][known]] = True
        if choice.excluded is not None:
            left_out |= choice.excluded
        last = store.lengths[rows] - 1
        if rule.exclude_seen:
            left_out |= seen_before(store, rows, last)
        # A user without any item left gets no row.
        some = ~left_out.all(1)
        left_out[~some] = False
        scores = session_scores(decider, store, rows, last, left_out)
        frames.append(_ranked(batch.users[rows], item_ids, scores, some, choice))
    return pd.concat(frames, ignore_index=True)


def positions(index: "pd.Index[Any]", ids: Array) -> IntArray:
    """Position of each of `ids` (N,) in `index`, −1 for ids that it lacks."""
    wanted = pd.Index(ids)
    if pd.api.types.is_integer_dtype(index.dtype) != pd.api.types.is_integer_dtype(wanted.dtype):
        # Integers of one log may be text in another, as for `prepare(like=...)`.
        index, wanted = index.astype(str), wanted.astype(str)
    return np.asarray(index.get_indexer(wanted), dtype=np.int64)


def _all_but(index: "pd.Index[Any]", candidates: Sequence[Any]) -> Tensor:
    """(n_items,) true for the items that are not among the candidates."""
    if isinstance(candidates, str) or not pd.api.types.is_list_like(candidates):
        raise InputError(f"candidates is {candidates!r}; give a list of item_ids")
    ids = np.asarray(list(candidates))
    if ids.ndim != 1 or len(ids) == 0:
        raise InputError("candidates is empty or nested; give a list of item_ids, or None for all")
    numbers = positions(index, ids)
    if (numbers < 0).any():
        unknown = ids[numbers < 0].tolist()
        raise InputError(
            f"{len(unknown)} of {len(ids)} candidates are items that the policy does not know "
            f"({_some(unknown)}); leave them out"
        )
    excluded = torch.ones(len(index), dtype=torch.bool)
    excluded[torch.from_numpy(numbers)] = False
    return excluded


def _unknown(index: "pd.Index[Any]", batches: Iterable[Histories]) -> InputError:
    rows, items = 0, set[Any]()
    for batch in batches:
        unknown = batch.item_ids[positions(index, batch.item_ids) < 0]
        rows += len(unknown)
        items |= set(unknown.tolist())
    return InputError(
        f"{rows} rows have an item_id that the policy does not know ({len(items)} items: "
        f"{_some(sorted(items))}); prepare and train on logs with them, or leave those rows out "
        "with --skip-unknown (skip_unknown=True in Python)"
    )


def _some(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values[:3])) + (", …" if len(values) > 3 else "")


def next_steps(
    trained: TrainedPolicy, histories: Histories, known: IntArray, users: IntArray
) -> EpisodeStore:
    """One episode per user: the session's steps and the next step, for which items are scored.

    Args:
        trained: the policy.
        histories: U users with the N rows of their latest sessions.
        known: (N,) index of each row's item in the store.
        users: (U,) index of each user in the training store, −1 for others.

    Raises:
        InputError: the policy needs observations that the histories lack.
    """
    n_users = len(histories.users)
    # Shifting each row by its user index leaves a free row at the end of every episode.
    places = np.arange(len(histories.owner)) + histories.owner
    lengths = np.bincount(histories.owner, minlength=n_users) + 1
    items = np.zeros(int(lengths.sum()), dtype=np.int64)
    rewards = np.zeros(len(items), dtype=np.float32)
    items[places], rewards[places] = known, histories.rewards
    columns: dict[str, Array] = {schema.ITEM: items, schema.REWARD: rewards}
    expected = trained.logged_observation_size
    if expected:
        observations = histories.observations
        size = 0 if observations is None else observations.shape[1]
        if observations is None or size != expected:
            raise InputError(
                f"the policy was trained with observations of {expected} numbers; those of the "
                f"histories have {size}"
            )
        seen = np.delete(observations, trained.dropped, axis=1)
        columns[schema.OBSERVATION] = np.repeat(seen, lengths, axis=0)
    return EpisodeStore.from_arrays(columns, lengths, {schema.USER: users}, trained.item_states)


def uniforms(users: Array, n_items: int, seed: int) -> Tensor:
    """Draws (B, n_items) from [0, 1), float64, that depend on the user, the item and the seed only.

    A user is recommended the same in any batch. The numbers are SplitMix64's (Steele et al., 2014),
    from a counter of users' hashes and items.
    """
    of_users = pd.util.hash_array(np.asarray(users).astype(str).astype(object))
    with np.errstate(over="ignore"):
        state = of_users[:, None] + np.arange(1, n_items + 1, dtype=np.uint64) * np.uint64(
            0x9E3779B97F4A7C15
        )
        state = state + np.uint64(seed) * np.uint64(0xD1B54A32D192ED03)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return torch.from_numpy((state >> np.uint64(11)).astype(np.float64) / 2**53)


def _ranked(
    users: Array, item_ids: Array, scores: Tensor, some: Tensor, choice: _Choice
) -> pd.DataFrame:
    """Rows of the users (B,) where `some` (B,) is true, from their scores (B, n_items)."""
    k = min(choice.k, scores.shape[1])
    rule, n_items = choice.decider.rule, scores.shape[1]
    drawn = uniforms(users, n_items, choice.seed) if rule.temperature > 0 else None
    items = rule.ranked(scores, k, drawn)
    values = scores.log_softmax(-1).gather(1, items)
    kept = (torch.isfinite(values) & some[:, None]).numpy()
    rank = np.cumsum(kept, axis=1)
    return pd.DataFrame(
        {
            schema.USER_ID: np.repeat(users, kept.sum(1)),
            RANK: rank[kept],
            schema.ITEM_ID: item_ids[items.numpy()[kept]],
            SCORE: values.numpy()[kept],
        }
    )
