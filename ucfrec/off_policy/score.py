"""Logs read as a policy's training logs were, and its probability of each logged choice."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import sessions_before
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.episodes.windows import seen_before
from ucfrec.errors import InputError
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.logs.sessions import EPISODE_USERS
from ucfrec.logs.summary import note_unknown
from ucfrec.off_policy.further_columns import read_groups, read_measure
from ucfrec.off_policy.guardrails import Groups
from ucfrec.processes import progress
from ucfrec.runs.later_logs import columns_used, reward_of
from ucfrec.runs.trained_policy import TrainedPolicy

SESSION, PROBABILITY, RANK, GREEDY = "session", "probability", "rank", "greedy_item_id"
_STEPS_AT_ONCE = 1024
_LOGITS_AT_ONCE = 2**24
MOST_SEEN = 0.05
"""Largest share of rows seen in training with which an estimate is accepted: with coarse timestamps
rows of other logs may have the same user, item and time."""

HISTORY_LACKING = (
    "the store of the run is gone or has changed: users are ranked without what they were shown "
    "before these logs; move the run together with its store"
)


@dataclass(frozen=True)
class LoggedSessions:
    """Logs with items, users, reward and sessions defined as in a policy's training logs."""

    store: EpisodeStore
    users: Array
    """(E,): identifier of each session's user."""
    report: dict[str, Any]
    """Counts of what was read and dropped (`format_report`); of a split, only "dropped"."""
    rows: UserRows
    """The rows of the users, those of the run's store too."""
    unknown_items: int = 0
    """Number of steps that show an item which the run does not know."""
    measures: Mapping[str, Float64Array] = field(default_factory=dict)
    """(N,) values at the steps, by the expression of a guardrail."""
    groups: Groups | None = None


@dataclass(frozen=True)
class ScoredSteps:
    """B logged steps with the policy's probabilities of all items."""

    episodes: IntArray
    """(B,) number of each step's session."""
    steps: IntArray
    """(B,) position of each step in its session, from 0."""
    items: Tensor
    """(B,) int64; −1 where the run does not know the logged item."""
    states: Tensor
    """(B, S) before the steps."""
    scores: Tensor
    """(B, n_items) what the rule decides by, see `ucfrec.acting.scorer.Scorer.scores`."""
    log_probabilities: Tensor
    """(B, n_items) natural logarithm of the probability that the policy shows each item."""
    returns_left: Tensor
    """(B,) target return less the session's reward before the step."""
    features: Tensor | None
    """(B, d) last-layer features of the policy's window; None of item-knn and crm-greedy."""


@contextmanager
def read_logged_sessions(
    trained: TrainedPolicy,
    files: Sequence[Path],
    mapping: LogMapping,
    keep_unknown: bool = False,
    memory_limit: str = "2GB",
    measures: Sequence[str] = (),
    by: str | None = None,
) -> Iterator[LoggedSessions]:
    """Read logs in the same way as the training logs of a run; they are on disk until the block of
    this context manager ends. InputError if the policy's actions are vectors, the logs cannot be
    used, none of their items is known, or their observations are not those of the training logs.

    What `mapping` leaves open is as in the training logs. Rows whose item the run does not know are
    kept as item −1 if `keep_unknown`, or else dropped and counted in the report. `measures` are
    expressions over the columns of the logs to read, too; `by` is one to group users or items by.
    """
    require_items(trained)
    record, mapping = trained.record, columns_used(trained, mapping)
    options = PrepareOptions(
        reward_of(trained),
        record.session_by,
        duplicates=record.data.duplicates,
        memory_limit=memory_limit,
    )
    if record.session_gap_ms is not None:
        options = replace(options, gap_minutes=record.session_gap_ms / 60_000)
    with scratch_folder(Path(gettempdir()), "logs") as scratch:
        folder, run = scratch / "store", trained.folder
        report = prepare(files, mapping, folder, options, like=run, keep_unknown=keep_unknown)
        store = EpisodeStore.open(folder)
        unknown = sum(int((items < 0).sum()) for (items,) in store.column_batches(schema.ITEM))
        if unknown == store.n_steps:
            raise InputError(
                f"{files[0]}: in all {unknown:,} rows the item is not in the store of the run; "
                "give logs of the same catalogue"
            )
        if len(trained.user_ids):
            numbers = np.unique(store.episode_values(schema.USER))
            strangers = report["users"] - int((numbers >= 0).sum())
            name, where = str(files[0]), "the run was trained on"
            note_unknown(name, schema.USER_ID, strangers, report["users"], where)
        users = np.asarray(pq.read_table(folder / EPISODE_USERS).column(schema.USER_ID))
        values = {
            measure: read_measure(files, mapping, options, run, keep_unknown, measure, store)
            for measure in dict.fromkeys(measures)
        }
        groups = None
        if by is not None:
            user_ids, numbers = np.unique(users, return_inverse=True)
            of_users = user_ids, numbers[store.all_steps()[0]]
            of_items = trained.items.ids, store.column(schema.ITEM).astype(np.int64)
            ids = {schema.USER_ID: of_users, schema.ITEM_ID: of_items}
            groups = read_groups(files, mapping, replace(options, temp_folder=scratch), by, ids)
        store, rows = _add_history(trained, store, users, _readable_store(trained))
        yield LoggedSessions(store, users, report, rows, unknown, values, groups)


def _add_history(
    trained: TrainedPolicy,
    store: EpisodeStore,
    users: Array,
    earlier: EpisodeStore | None,
) -> tuple[EpisodeStore, UserRows]:
    """The sessions and all rows of their users; earlier rows of a session that goes on are a part
    of it, as in `recommend`, but where sessions have ids, which the store does not keep."""
    for log in (store, earlier):
        if log is not None and log.observation_size != trained.record.observation_size:
            raise InputError(
                f"the policy was trained with observations of {trained.record.observation_size} "
                f"numbers; those of the logs have {log.observation_size}"
            )
    rows = UserRows.of(store, users, earlier)
    if trained.record.session_by == schema.SESSION_ID:
        return store, rows
    return rows.continue_sessions(trained.record.session_gap_ms), rows


def score_steps(
    trained: TrainedPolicy,
    store: EpisodeStore,
    users: UserRows,
    rule: DecisionRule | None = None,
) -> Iterator[ScoredSteps]:
    """Compute the policy's probabilities at every step of `store`, in order and in batches, under
    its own rule or another; without what the `users` were shown before, where the logs say that it
    was not on offer. Rows of one decision are drawn one after the other, given those before them.
    """
    n_items, total, scorer = len(trained.items), store.n_steps, trained.scorer(rule)
    at_once = max(1, min(_STEPS_AT_ONCE, _LOGITS_AT_ONCE // n_items))
    with progress(total, "score", "steps") as bar:
        for begin in range(0, total, at_once):
            numbers = np.arange(begin, min(begin + at_once, total))
            episodes, steps = store.locate(numbers)
            # Rows of one decision share what was known, and are drawn one after the other.
            starts = store.decision_starts(episodes, steps)
            begins = np.append(True, (np.diff(episodes) != 0) | (np.diff(starts) != 0))
            first, decision = np.flatnonzero(begins), np.cumsum(begins) - 1
            owners, begins_at = episodes[first], starts[first]
            sessions = sessions_before(scorer, store, owners, begins_at)
            earlier = seen_before(store, owners, begins_at) if scorer.rule.exclude_seen else None
            windows = scorer.windows(sessions)
            query = scorer.query(sessions, windows)
            excluded = None
            if schema.EXCLUDES_SEEN in store.record.columns:
                rows, seen_items = users.seen(numbers[first])
                excludes = store.step_values(schema.EXCLUDES_SEEN, owners, begins_at)[rows] > 0
                pairs = np.unique((rows * n_items + seen_items)[excludes & (seen_items < n_items)])
                rows, seen_items = np.divmod(pairs, n_items)
                # A decision that would have no item left excludes none.
                offered = torch.ones(len(first), n_items, dtype=torch.bool)
                offered = offered if sessions.offer is None else sessions.offer.mask()
                offered[rows, seen_items] = False
                left = offered.any(1).numpy()[rows]
                excluded = torch.from_numpy(rows[left]), torch.from_numpy(seen_items[left])
            scores = scorer.scores_of(query, excluded, earlier)
            items = store.step_values(schema.ITEM, episodes, steps).astype(np.int64)
            of_list = torch.from_numpy(store.items_above(episodes, steps))
            if of_list.shape[1]:
                scores, shared = scores[decision], torch.from_numpy(decision)
            else:
                shared = torch.arange(len(first))
            term = scorer.list_term
            log_probabilities = scorer.rule.log_probabilities(scores, of_list, term)
            if term is not None:
                for above in of_list.unbind(1):
                    scores += term(above.clamp(min=0)).masked_fill(above.unsqueeze(1) < 0, 0.0)
            row, place = torch.nonzero(of_list >= 0, as_tuple=True)
            scores[row, of_list[row, place]] = -torch.inf
            yield ScoredSteps(
                episodes,
                steps,
                torch.from_numpy(items),
                query.states[shared],
                scores,
                log_probabilities,
                windows.returns_to_go[shared, -1],
                None if query.features is None else query.features[shared],
            )
            bar.update(len(steps))


def score(
    trained: TrainedPolicy,
    logged: LoggedSessions,
    rule: DecisionRule | None = None,
) -> Iterator[pd.DataFrame]:
    """Compute the policy's probability of every logged choice, given those before it in its list,
    under its own rule or another, in logs without unknown items.

    The frames have one row a logged step, in order of user, session and time: `user_id`, `session`
    (from 0), `timestamp` (ms), `item_id`, `reward`, `propensity` (if logged), `probability` of the
    logged item, its `rank` (from 1) among all, and `greedy_item_id`, the best one.
    """
    store, item_ids = logged.store, trained.items.ids
    for batch in score_steps(trained, store, logged.rows, rule):
        column = batch.items.unsqueeze(1)
        take = partial(store.step_values, episodes=batch.episodes, steps=batch.steps)
        probability = batch.log_probabilities.gather(1, column)[:, 0].double().exp()
        better = batch.scores > batch.scores.gather(1, column)
        columns = {
            schema.USER_ID: logged.users[batch.episodes],
            SESSION: batch.episodes,
            schema.TIMESTAMP: take(schema.TIMESTAMP),
            schema.ITEM_ID: item_ids[batch.items.numpy()],
            schema.REWARD: take(schema.REWARD),
        }
        if schema.PROPENSITY in store.record.columns:
            columns[schema.PROPENSITY] = take(schema.PROPENSITY)
        columns[PROBABILITY], columns[RANK] = probability.numpy(), 1 + better.sum(1).numpy()
        columns[GREEDY] = item_ids[batch.scores.argmax(1).numpy()]
        yield pd.DataFrame(columns)


def held_out_sessions(trained: Sequence[TrainedPolicy]) -> LoggedSessions:
    """The test split of the store that policies were trained on; InputError if the actions are
    vectors, the store is gone or has no test split, or a policy is a refit, trained on all rows.
    """
    for policy in trained:
        require_items(policy)
        if policy.record.refit_of is not None:
            raise InputError(
                f"{policy.folder} is a refit, trained on the test split too; name later logs"
            )
    first = trained[0]
    store = first.require_store("move the run together with its store, or name later logs")
    test = store.split("test")
    if not test.n_episodes:
        raise InputError(f"{store.path} has no test split; name later logs")
    users = test.episode_values(schema.USER)
    earlier = np.flatnonzero(store.episode_values(schema.SPLIT) != schema.SPLITS.index("test"))
    sessions, rows = _add_history(first, test, users, store.select(earlier))
    return LoggedSessions(sessions, users, {"dropped": {}}, rows)


def require_items(trained: TrainedPolicy) -> None:
    """Refuse a policy whose actions are vectors."""
    if trained.item_states is None:
        raise InputError(
            f"{trained.folder}: the actions of this policy are vectors; it chooses one for "
            "certain, so a logged action has no probability. Evaluate it with ucfrec evaluate"
        )


def share_seen(trained: TrainedPolicy, logged: EpisodeStore) -> float | None:
    """The share of logged rows whose user, item and time are in the run's training or validation
    data, for a refit in its test split too; None if the run's store has been moved, deleted or
    changed. Both stores number users and items alike (`ucfrec.logs.prepare(like=…)`).
    """
    record = trained.record
    if record.fingerprint == logged.record.fingerprint:
        in_training = np.ones(logged.n_episodes, dtype=bool)
        if record.refit_of is None:
            in_training = logged.episode_values(schema.SPLIT) != schema.SPLITS.index("test")
        return float(in_training[logged.all_steps()[0]].mean())
    if (store := _readable_store(trained)) is None:
        return None
    keys, rows = np.unique(np.concatenate(list(_hash_rows(logged))), return_counts=True)
    seen = np.zeros(len(keys), dtype=bool)
    # The training data may be far larger than the logs.
    for name in schema.SPLITS if trained.record.refit_of is not None else ("train", "validation"):
        for trained_keys in _hash_rows(store.split(name)):
            seen |= np.isin(keys, trained_keys)
    return float(rows[seen].sum() / rows.sum())


def _readable_store(trained: TrainedPolicy) -> EpisodeStore | None:
    """The run's store; None where it is gone, changed or damaged."""
    try:
        return trained.training_store()
    except InputError:
        return None


def seen_too_often(seen: float | None) -> list[str]:
    """What to say of a share of rows seen in training (`share_seen`); nothing if it is small."""
    text = (
        f"{seen or 0:.0%} of the rows were seen in training: on these a policy looks "
        "better than it is; give later logs, or no logs for the test split"
    )
    return [text] if (seen or 0) > MOST_SEEN else []


def _hash_rows(store: EpisodeStore) -> Iterator[Array]:
    """(N,) hash of each step's user, item and time (ms), some steps at a time, in order."""
    users: Array = store.episode_values(schema.USER)
    for episodes, steps in store.step_batches() if store.n_episodes else ():
        names = (schema.ITEM, schema.TIMESTAMP)
        rows = pd.DataFrame({name: store.step_values(name, episodes, steps) for name in names})
        rows = rows.assign(user=users[episodes]).astype(np.int64)
        yield pd.util.hash_pandas_object(rows, index=False).to_numpy()
