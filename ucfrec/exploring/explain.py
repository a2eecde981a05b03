"""Why a policy recommends what it does to one user: parts of the scores, and excluded items."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.logs.histories import Histories
from ucfrec.recommending.recommend import recommend, sessions_of
from ucfrec.runs.trained_policy import TrainedPolicy

PARTS: Final = ("policy", "exposure", "reward weight", "lookahead")
_ALMOST_NONE = 1e-9
"""A lookahead that changes no score, but has rewards counted in the units of a lookahead."""
_EXCLUDED = 10
_MOST_ROWS = 1000


@dataclass(frozen=True)
class Card:
    """One recommended item."""

    item_id: Any
    propensity: float
    """Probability of the item at its position, given those before it."""
    parts: Mapping[str, float]
    """What each of `PARTS` adds to its score, relative to the mean of all items (nats)."""


@dataclass(frozen=True)
class Excluded:
    """An item that is not recommended although its score is high."""

    item_id: Any
    rank: int
    """Among all items by score, from 1."""
    reason: str


@dataclass(frozen=True)
class Explained:
    """What one user is recommended, and why."""

    rows: Sequence[tuple[Any, float]]
    """Items that the user was shown, with their rewards, the latest first."""
    cards: Sequence[Card]
    excluded: Sequence[Excluded]
    """Those of the best items by score that are not recommended, best first."""


def explain(
    trained: TrainedPolicy,
    rule: DecisionRule,
    user: Histories,
    k: int,
    filter_seen: bool,
) -> Explained:
    """The recommendations of `ucfrec recommend` for one user, with their reasons.

    Raises:
        InputError: the rule does not fit the policy, or an item of the history is not known.
    """
    at = None if trained.offers is None else int(user.timestamps.max(initial=0))
    (frame,) = recommend(trained, [user], k, rule=rule, filter_seen=filter_seen, at=at)
    # The user's latest session, before the step that is decided.
    numbered = user.with_numbers(trained.items, False)
    latest = numbered.latest_session(trained.record.session_gap_ms)
    sessions = sessions_of(trained, latest, trained.scorer().length)
    offer = None if trained.offers is None else trained.offers.at(torch.tensor([at]))
    parts = _score_parts(trained.scorer(rule), replace(sessions, offer=offer))
    ids = frame[schema.ITEM_ID].to_numpy()
    cards = [
        Card(item_id, chance, {name: float(part[number]) for name, part in parts.items()})
        for item_id, number, chance in zip(
            ids.tolist(), trained.items.numbers(ids), frame[schema.PROPENSITY], strict=True
        )
    ]
    rows = list(
        zip(
            user.item_ids[::-1].tolist(),
            user.rewards[::-1].tolist(),
            strict=True,
        )
    )
    excluded = _find_excluded(trained, rule, user, sessions, filter_seen, sum(parts.values()))
    return Explained(rows, cards, excluded)


def read_pasted(text: str) -> pd.DataFrame:
    """The history that someone pasted: a row per line, `item_id` or `item_id, reward`, the latest
    last, as a frame of one user whose rows are a minute apart.

    Raises:
        InputError: there are too many rows, or a reward is not a number.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if len(lines) > _MOST_ROWS:
        raise InputError(f"the history has {len(lines):,} rows; paste at most {_MOST_ROWS:,}")
    items, rewards = [], []
    for number, line in enumerate(lines, start=1):
        item, comma, reward = line.rpartition(",")
        items.append(item.strip() if comma else line)
        try:
            rewards.append(float(reward) if comma else 0.0)
        except ValueError:
            rewards.append(np.nan)
        if not abs(rewards[-1]) <= schema.LARGEST_REWARD:
            raise InputError(
                f"line {number} of the history is {line[:60]!r}; write item_id, or item_id, reward"
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
) -> list[Excluded]:
    """The best of the items that filters exclude."""
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
    order = torch.argsort(scores, descending=True, stable=True).tolist()
    ranked = [
        Excluded(trained.items.ids[number], rank, reasons[number])
        for rank, number in enumerate(order, start=1)
        if number in reasons
    ]
    return ranked[:_EXCLUDED]
