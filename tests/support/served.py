"""A small run with everything that a decision rule can use, and requests of its users."""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import torch

from tests.support.tagged import tagged_log, tagged_store
from ucfrec import Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.windows import Shown
from ucfrec.logs.mapping import LogMapping
from ucfrec.recommending.recommend import decide
from ucfrec.recommending.requests import Limits
from ucfrec.recommending.responder import Responder
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.session_end import LoggedEnds, SessionEnd, describe_steps

SETTINGS = [
    *("train.steps=20", "policy.dim=8", "policy.context=4", "augment.copies=0"),
    *("rule.sessions=2", "rule.reward_weights=[0.5]"),
    *("rule.temperatures=[0.0]", "rule.quantiles=[1.0]", "rule.tag_windows=[0]"),
]
FULL = DecisionRule(2.0, minimum_target=0.1, reward_weight=0.7, exclude_seen=True, tag_window=2)
"""A rule that uses every part of a policy."""
OBSERVED = LogMapping({"observation": "observation"})
"""Mapping of logs with observations."""


def observed_log(log: pd.DataFrame | None = None) -> pd.DataFrame:
    """A log with observations of two numbers; `tagged_log` without one."""
    log = tagged_log() if log is None else log
    return log.assign(observation=[[user % 3 / 2, user % 2] for user in log.user_id])


def trained_run(folder: Path, policy: str = "ucf") -> TrainedPolicy:
    """A run at `folder / "run"` on `tagged_log`, which has tags, users with features and a gap: a
    copy of one that is trained once for all files of tests."""
    shutil.copytree(_trained_run(policy).name, folder, dirs_exist_ok=True)
    return TrainedPolicy.load(folder / "run")


@cache
def _trained_run(policy: str) -> "TemporaryDirectory[str]":
    made = TemporaryDirectory()
    folder = Path(made.name)
    Recommender(policy, settings=SETTINGS).fit(tagged_store(folder), folder / "run")
    return made


def learn_tastes(trained: TrainedPolicy) -> None:
    """Give the run's reward model tastes that sessions show, as where users are new."""
    tastes, random = trained.reward_model.tastes, torch.Generator().manual_seed(3)
    tastes.root.copy_(torch.randn(tastes.root.shape, generator=random).tril())
    tastes.usual.fill_(0.4)
    tastes.weigh(torch.tensor(1.5))


def learn_interests(trained: TrainedPolicy, until: int = 0) -> None:
    """Give the run's reward model interests of users, as if trained on rows until that time."""
    interests, random = trained.reward_model.interests, torch.Generator().manual_seed(3)
    interests.until.fill_(until)
    for values in (interests.usual, interests.sums):
        values.copy_(torch.rand(values.shape, generator=random))
    interests.weigh(torch.randn(interests.weights.shape, generator=random))


def boredom(likeness: Likeness) -> SessionEnd:
    """Sessions end, mostly, with a liked item that is like the last one."""
    rng, n_items = np.random.default_rng(0), len(likeness.tags)
    earlier = torch.from_numpy(rng.integers(-1, n_items, (4000, 10)))
    items = torch.from_numpy(rng.integers(n_items, size=4000))
    rewards, steps = rng.integers(2, size=4000).astype(np.float64), rng.integers(9, size=4000)
    profile = likeness.profile(earlier[:, :1], torch.ones(4000, 1))
    alike = likeness.to_candidates(profile, items.unsqueeze(1))
    bored = (alike[:, 0] > 0.3).numpy() & (rewards > 0)
    ended = rng.random(4000) < np.where(bored, 0.9, 0.02)
    history = Shown(earlier, torch.zeros(4000, 10))
    inputs = describe_steps(likeness, history, items, rewards, steps)
    logged = LoggedEnds(inputs, ended, np.ones(4000, dtype=bool))
    end, report = SessionEnd.fit(likeness, logged, logged, 0)
    assert report.kept == "boosted"
    assert end.uses_rewards
    return end


def responder(trained: TrainedPolicy, **named: Any) -> Responder:
    """A responder with the default limits."""
    return Responder(trained, named.pop("limits", Limits()), **named)


def histories(users: int = 12) -> pd.DataFrame:
    """The rows of some users, with duplicates, in no order of time."""
    log = tagged_log()
    log = log[log.user_id < 100 + users]
    repeated = log.sample(40, random_state=0)
    again = repeated.assign(reward=1 - repeated.reward)
    return pd.concat([log, again]).sample(frac=1, random_state=1).reset_index(drop=True)


def recommend(*inputs: Any, **how: Any) -> list[pd.DataFrame]:
    """The frames of `decide`."""
    return [frame for frame, _ in decide(*inputs, **how)]


def request_of(rows: pd.DataFrame, **more: Any) -> dict[str, Any]:
    """The request with one user's rows as its history."""
    columns = [name for name in rows.columns if name != "user_id"]
    history = json.loads(rows[columns].to_json(orient="records"))
    # The id that `recommend` gives to the request of such a history.
    request = {"request_id": f"0-{rows.timestamp.max()}", "new_session": False} | more
    return {"user_id": int(rows.user_id.iloc[0]), "history": history, **request}


def requests_of(log: pd.DataFrame, **more: Any) -> list[dict[str, Any]]:
    """The requests of all users of a log, by user."""
    return [request_of(rows, **more) for _, rows in log.groupby("user_id")]


def as_frame(answers: list[dict[str, Any]]) -> pd.DataFrame:
    """Answers in the form of `ucfrec recommend`."""
    rows = [
        {"user_id": answer["user_id"], "rank": rank, **item, "request_id": answer["request_id"]}
        for answer in answers
        for rank, item in enumerate(answer["items"], 1)
    ]
    return pd.DataFrame(rows)


def with_rule(trained: TrainedPolicy, **parts: Any) -> DecisionRule:
    """The run's rule with other parts."""
    return replace(trained.rule, **parts)
