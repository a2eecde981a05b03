"""CPU time of acting by a trained run, beside the previous way of doing the same, in turn.

    python benchmarks/acting_time.py RUN STORE

`choose the rule`: decision rules played side by side, and one after the other. `one user`: items
for one user's frame of ten rows, read directly, and by SQL. One thread. Appends the rows to
runs/acting_time/results.jsonl, or to --results, and prints a table.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from ucfrec import Recommender, schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.learned_sessions import LearnedSessions
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.rollout import rollout
from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import LogMapping
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.choose_rule import RuleSearch
from ucfrec.runs.rule_config import RuleConfig
from ucfrec.runs.run import training_views
from ucfrec.runs.trained_policy import TrainedPolicy

RESULTS = Path("runs/acting_time/results.jsonl")
Way = Callable[[], object]


def rule_ways(run: Path, store: Path, sessions: int) -> tuple[Way, Way]:
    """Play 8 rules side by side, and one after the other."""
    trained, views = TrainedPolicy.load(run), training_views(EpisodeStore.open(store))
    target = trained.target_return(1.0)
    decider, config = trained.decider(DecisionRule(target)), RuleConfig(sessions=sessions)
    search = RuleSearch(decider, *views, config, seed=0)
    rules = [
        DecisionRule(target, floor=floor, tilt=tilt, temperature=temperature)
        for floor in (None, target)
        for tilt in (0.0, 4.0)
        for temperature in (0.0, 0.5)
    ]
    _, validation = views
    states, model = validation.item_states, trained.reward_model
    assert model is not None
    users = np.arange(len(states.user_features))
    longest = int(views[0].lengths.max())
    world = LearnedSessions(*(validation, model, search.calibration, search.end, sessions, longest))

    def one_by_one() -> list[float]:
        returns = []
        for rule in rules:
            actor = PolicyActor(
                *(replace(decider, rule=rule), sessions, validation.observation_size),
                *(states, None, users),
                seed=0,
            )
            played = rollout(world, actor, sessions, 0)  # type: ignore[arg-type]
            returns.append(float(played.returns.mean()))
        return returns

    return lambda: [each.value for each in search.play(rules)], one_by_one


def user_ways(run: Path) -> tuple[Way, Way]:
    """Recommend to one user whose frame is read directly, and by SQL."""
    policy, rng = Recommender.load(run), np.random.default_rng(0)
    items = policy.trained.item_index
    frame = pd.DataFrame({schema.USER_ID: np.full(10, 1), schema.ITEM_ID: items[:10].to_numpy()})
    frame[schema.TIMESTAMP] = 1_700_000_000_000 + np.cumsum(rng.integers(1, 60_000, 10))
    frame[schema.REWARD] = rng.random(10).round()
    if policy.trained.record["session_by"] == schema.SESSION_ID:
        frame[schema.SESSION_ID] = 1
    named = LogMapping({schema.ITEM_ID: schema.ITEM_ID})
    return lambda: policy.recommend(frame), lambda: policy.recommend(frame, mapping=named)


def seconds(ways: tuple[Way, Way], rounds: int) -> np.ndarray:
    """CPU seconds (rounds, 2) of both ways, in turn, after one round that does not count."""
    taken = []
    for turn in range(rounds + 1):
        times = []
        for way in ways:
            began = time.thread_time()
            way()
            times.append(time.thread_time() - began)
        taken += [times] if turn else []
    return np.array(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder of a policy of items")
    parser.add_argument("store", type=Path, help="the store that it was trained on")
    parser.add_argument("--sessions", type=int, default=100, help="sessions of a rule (100)")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds (5)")
    parser.add_argument("--users", type=int, default=200, help="timed rounds of one user (200)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = []
    cases = (
        (
            "choose the rule",
            options.rounds,
            rule_ways(options.run, options.store, options.sessions),
        ),
        ("one user", options.users, user_ways(options.run)),
    )
    n_items = len(TrainedPolicy.load(options.run).item_index)
    for task, rounds, ways in cases:
        taken = seconds(ways, rounds)
        ratio = float(np.median(taken[:, 0] / taken[:, 1]))
        middle, high = np.quantile(1e3 * taken[:, 0], [0.5, 0.99])
        lines.append((task, f"{ratio:.3f}", f"{middle:.1f}", f"{high:.1f}"))
        row = ResultRow(
            suite="acting-time",
            table="acting-time",
            task=task,
            method="ucf",
            policy="ucf",
            conditions={"items": n_items, "rounds": rounds, "sessions": options.sessions},
            code_version=code_version(Path(__file__), "ucfrec.acting.policy_actor"),
            metric="ratio",
            metrics={"ratio": ratio, "median_ms": float(middle), "p99_ms": float(high)},
            wall_time_s=float(taken.sum()),
            **provenance(),
        )
        append_rows(options.results, [row])
    header = ("what", "CPU time / that of the previous way", "median, ms", "99%, ms")
    print(markdown_table(header, lines))


if __name__ == "__main__":
    main()
