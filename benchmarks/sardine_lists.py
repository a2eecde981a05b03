"""Lists by marginal gain and the k best, in SARDINE's environment of slates (extra `sardine`).

    python benchmarks/sardine_lists.py 3    # the penalty; 1 as published

Logs are slates of the ten items that a user likes best, of which a share ε, of each session, is
replaced by random ones. Where four or more items of a slate have the same main topic, SARDINE
divides the probabilities of all clicks by the penalty.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch

from ucfrec import Recommender
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.windows import Sessions
from ucfrec.logs.mapping import FeatureTable, LogMapping

SLATE, STEPS, EPSILONS, SEEDS = 10, 20, (0.2, 0.5, 0.8, 1.0), (0, 1, 2, 3)
SETTINGS = ["train.steps=300", "policy.dim=64", "rule.sessions=40", "rule.lookaheads=[0]"]


def make_sessions(penalty: float, count: int, seed: int) -> list[Any]:
    """Environments of slates, each at the start of a session."""
    options: dict[str, Any] = {"diversity_penalty": penalty, "episode_length": STEPS}
    name = "sardine:sardine/SlateTopK-Bored-v0"
    sessions = [gymnasium.make(name, **options).unwrapped for _ in range(count)]
    for number, session in enumerate(sessions):
        session.reset(seed=1000 * seed + number)
    return sessions


def draw_log(sessions: list[Any], seed: int) -> pd.DataFrame:
    """What a policy that knows the users showed them, and their clicks."""
    rng, frames = np.random.default_rng(seed), list[pd.DataFrame]()
    for user, session in enumerate(sessions):
        epsilon = rng.choice(EPSILONS)
        for step in range(STEPS):
            order = np.argsort(-session.item_embedd @ session.cur_user_embedd)
            fresh = rng.choice(order[SLATE:], SLATE, replace=False)
            slate = np.where(rng.random(SLATE) < epsilon, fresh, order[:SLATE])
            columns = {"item_id": slate, "reward": session.step(slate)[0]["clicks"]}
            columns |= {"user_id": user, "timestamp": 10**12 + 10**7 * user + 1000 * step}
            frames.append(pd.DataFrame({**columns, "position": range(SLATE)}))
    return pd.concat(frames, ignore_index=True)


def play(scorer: Scorer, environments: list[Any], seed: int) -> np.ndarray:
    """Clicks (N,) of sessions that are shown lists of a policy, no item twice."""
    n, n_items = len(environments), len(environments[0].item_embedd)
    sessions, clicks = Sessions.begun(n, scorer.length), np.zeros(n)
    shown, generator = torch.zeros(n, n_items) > 0, torch.Generator().manual_seed(seed)
    for _ in range(STEPS):
        scores = scorer.scores(sessions, excluded=shown)
        draws = torch.rand(n, n_items + 1, generator=generator)
        lists, _ = scorer.rule.rank_items(scores, SLATE, draws, scorer.list_term)
        shown.scatter_(1, lists, True)
        pairs = zip(environments, lists.numpy(), strict=True)
        rewards = np.stack([environment.step(slate)[0]["clicks"] for environment, slate in pairs])
        clicks += rewards.sum(1)
        for items, received in zip(lists.T, torch.from_numpy(rewards.T), strict=True):
            sessions = sessions.add_step(items, received)
    return clicks


def compare(penalty: float, seed: int, folder: Path) -> None:
    """Train on a log, and print the clicks of both kinds of lists."""
    environments, table = make_sessions(penalty, 300, seed), folder / "items.parquet"
    topics = environments[0].item_embedd
    tags = [np.flatnonzero(row) for row in topics]
    items = {"item_id": range(len(topics)), "topics": list(topics), "tags": tags}
    pd.DataFrame(items).to_parquet(table)
    mapping = LogMapping(item_features=(FeatureTable((table,), "item_id"),))
    log, policy = draw_log(environments, seed), Recommender("bc", settings=SETTINGS)
    policy.fit(log, folder / "run", reward="reward", session_by="user", mapping=mapping)
    rule, model = policy.trained.rule, policy.trained.reward_model
    clicks = [
        play(policy.trained.scorer(replace(rule, by_marginal_gain=by_gain)), sessions, seed)
        for by_gain in (False, True)
        if (sessions := make_sessions(penalty, 100, 1000 + seed))
    ]
    gain, effect = clicks[1] - clicks[0], 0.0 if model is None else float(model.above)
    error = gain.std() / len(gain) ** 0.5
    print(f"{seed}: {rule}; above {effect:.3f}; clicks {clicks[0].mean():.2f}, by marginal gain")
    print(f"   {gain.mean():+.2f} ± {error:.2f}")


if __name__ == "__main__":
    for log_seed in SEEDS:
        with tempfile.TemporaryDirectory() as scratch:
            compare(float(sys.argv[1]), log_seed, Path(scratch))
