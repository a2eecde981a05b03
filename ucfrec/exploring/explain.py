"""Why a policy recommends what it does to one user: parts of the scores, and excluded items."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import IntArray
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.logs.histories import Histories
from ucfrec.recommending.recommend import SCORE, decide, sessions_of
from ucfrec.runs.trained_policy import TrainedPolicy

PARTS = ("policy", "exposure", "reward weight", "lookahead")
_ALMOST_NONE = 1e-9
"""A lookahead that changes no score, but has rewards counted in the units of a lookahead."""
_EXCLUDED = 10


@dataclass(frozen=True)
class Card:
    """One recommended item."""

    item_id: Any
    propensity: float
    """Probability of the item at its position, given those before it."""
    parts: Mapping[str, float]
    """What each of `PARTS` adds to its score, relative to the mean of all items (nats)."""
    by_chance: bool
    """Whether an item below it has a higher score: it was drawn."""


@dataclass(frozen=True)
class Explained:
    """What one user is recommended, and why."""

    rule: DecisionRule
    rows: Sequence[tuple[Any, float, datetime]]
    """Items that the user was shown, with their rewards and times (UTC), the latest first."""
    new_session: bool
    """Whether so much time has passed that a new session begins."""
    cards: Sequence[Card]
    excluded: Sequence[tuple[Any, int, str]]
    """Those of the best items by score that are not recommended, best first: the item, its rank
    among all items, or all candidates, from 1, and the reason."""


def explain(
    trained: TrainedPolicy,
    rule: DecisionRule,
    user: Histories,
    k: int,
    filter_seen: bool,
    *,
    candidates: Sequence[Any] | None = None,
    time_ms: int | None = None,
    seed: int = 0,
) -> Explained:
    """The recommendations of `ucfrec recommend` for one user, with their reasons. InputError if the
    rule does not fit the policy, or an item is not known.

    Args:
        candidates: the only items to recommend; None for all.
        time_ms: the moment of the decision, before which rows count; None for right after the last.
        seed: of the draws of a rule that draws.
    """
    gap, new = trained.record.session_gap_ms, False
    at = time_ms
    if time_ms is not None:
        user = _cut_history(user, time_ms)
        new = gap is not None and bool(time_ms - user.timestamps.max(initial=0) > gap)
    elif trained.offers is not None:
        at = int(user.timestamps.max(initial=0))
    ((frame, _),) = decide(
        trained,
        [user],
        k,
        rule=rule,
        filter_seen=filter_seen,
        candidates=candidates,
        new_session=new,
        seed=seed,
        at=at,
    )
    # The user's latest session, before the step that is decided.
    latest = user.with_numbers(trained.items, False).latest_session(gap, np.array([new]))
    sessions = sessions_of(trained, latest, trained.scorer().length)
    offer = None if trained.offers is None else trained.offers.at(torch.tensor([at]))
    parts = _score_parts(trained.scorer(rule), replace(sessions, offer=offer))
    by_chance = frame[SCORE] < frame[SCORE][::-1].cummax()[::-1]
    numbers = trained.items.numbers(frame[schema.ITEM_ID].to_numpy())
    columns = frame[schema.ITEM_ID], frame[schema.PROPENSITY], numbers, by_chance
    cards = [
        Card(item_id, chance, {name: float(part[number]) for name, part in parts.items()}, lucky)
        for item_id, chance, number, lucky in zip(*columns, strict=True)
    ]
    times = [datetime.fromtimestamp(time / 1000, UTC) for time in user.timestamps.tolist()]
    rows = list(zip(user.item_ids.tolist(), user.rewards.tolist(), times, strict=True))[::-1]
    allowed = None if candidates is None else trained.items.numbers(np.asarray(candidates))
    scores = torch.stack([*parts.values()]).sum(0)
    excluded = _find_excluded(trained, rule, user, sessions, filter_seen, scores, allowed)
    return Explained(rule, rows, new, cards, excluded)


def _cut_history(user: Histories, time_ms: int) -> Histories:
    """What was known of one user before a moment."""
    past = user.timestamps < time_ms
    future = np.setdiff1d(user.item_ids[~past], user.item_ids[past])
    seen = ~np.isin(user.seen_ids, future)
    user = replace(user, seen_owner=user.seen_owner[seen], seen_ids=user.seen_ids[seen])
    return user.with_rows(past)


def read_pasted(text: str) -> pd.DataFrame:
    """The history that someone pasted: a row per line, `item_id` or `item_id, reward`, the latest
    last, as a frame of one user, a minute apart. InputError if a reward is not a number."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    parts = [line.rpartition(",") for line in lines]
    items = [item.strip() if comma else line for item, comma, line in parts]
    texts = pd.Series([reward if comma else "0" for _, comma, reward in parts])
    rewards = pd.to_numeric(texts, errors="coerce")
    faults = np.flatnonzero(~(rewards.abs() <= schema.LARGEST_REWARD))
    if len(faults):
        raise InputError(
            f"line {faults[0] + 1} of the history is {lines[faults[0]][:60]!r}; write item_id, or "
            "item_id, reward"
        )
    times = int(time.time() * 1000) - 60_000 * np.arange(len(items), 0, -1)
    frame = pd.DataFrame({schema.USER_ID: "pasted", schema.ITEM_ID: items})
    return frame.assign(timestamp=times, session_id=0, reward=rewards)


def _simplify(rule: DecisionRule, **changes: Any) -> DecisionRule:
    """The rule without filters and draws."""
    nothing = {"tag_window": 0, "tag_run": 0, "exclude_seen": False, "temperature": 0.0}
    return replace(rule, **{**nothing, "explore": 0.0, **changes})


def _score_parts(scorer: Scorer, sessions: Sessions) -> dict[str, Tensor]:
    """(n_items,) of each of `PARTS`, less its mean over all items."""
    rule = _simplify(scorer.rule)

    def score(**changes: Any) -> Tensor:
        return scorer.under(replace(rule, **changes)).scores(sessions, empty=True)[0].double()

    alone = scorer.under(replace(rule, reward_weight=0.0, lookahead=0.0))
    query = alone.query(sessions)
    exposed = unexposed = alone.scores_of(query, empty=True)[0].double()
    if query.policy is not None:
        none = torch.zeros_like(query.policy.repeated)
        query = query._replace(policy=query.policy._replace(repeated=none, alike=none))
        unexposed = alone.scores_of(query, empty=True)[0].double()
    rewarded = score(lookahead=_ALMOST_NONE if rule.looks_ahead else 0.0)
    sums = torch.stack((torch.zeros_like(exposed), unexposed, exposed, rewarded, score()))
    # Scores of what is not available are −∞.
    parts = sums.diff(dim=0).nan_to_num(nan=0.0, neginf=0.0)
    return dict(zip(PARTS, parts - parts.mean(1, keepdim=True), strict=True))


def _find_excluded(
    trained: TrainedPolicy,
    rule: DecisionRule,
    user: Histories,
    sessions: Sessions,
    filter_seen: bool,
    scores: Any,
    candidates: IntArray | None,
) -> list[tuple[Any, int, str]]:
    """The best of the items, among candidates if there are some, that filters exclude."""
    excluded: dict[str, Any] = {}
    for name, words in (
        ("tag_run", f"the last {rule.tag_run} items had its main tag"),
        ("tag_window", f"it shares a tag with one of the last {rule.tag_window} items"),
    ):
        if limit := getattr(rule, name):
            scorer = trained.scorer(_simplify(rule, **{name: limit}))
            filtered = scorer.scores(sessions, empty=True)[0]
            excluded[words] = torch.isneginf(filtered).nonzero()[:, 0]
    if rule.exclude_seen:
        excluded["this session has shown it"] = sessions.actions[0]
    if filter_seen:
        excluded["the user has seen it"] = trained.items.numbers(user.seen_ids)
    # Of several reasons, the last one here.
    reasons = {n: words for words, numbers in excluded.items() for n in numbers.tolist()}
    order = torch.argsort(scores, descending=True, stable=True).numpy()
    if candidates is not None:
        order = order[np.isin(order, candidates)]
    ranked = [
        (trained.items.ids[number], rank, reasons[number])
        for rank, number in enumerate(order.tolist(), start=1)
        if number in reasons
    ]
    return ranked[:_EXCLUDED]
