"""Judging a policy three ways: by playing it, from logs alone, and by what was shown next.

Run it with `python examples/judge_three_ways.py [FOLDER]`; it takes about a minute on two cores.

The three ways answer different questions and can disagree. Here all three are possible, because the
logs come from a simulated environment, `synthetic-catalog`: the first way gives the truth in that
environment, and the others can be held against it. With real logs only the second and the third
remain.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import pandas as pd

from ucfrec import EpisodeStore
from ucfrec.acting.decision import DecisionRule
from ucfrec.evaluation.collect import collect
from ucfrec.evaluation.evaluate import Environment, evaluate_behavior, evaluate_policy
from ucfrec.evaluation.simulated_store import simulated_store
from ucfrec.logs.mapping import LogMapping
from ucfrec.off_policy.evaluate import evaluate_off_policy
from ucfrec.off_policy.score import logged_sessions, score
from ucfrec.reporting.tables import evaluation_table
from ucfrec.results.row import ResultRow
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy

ENVIRONMENT = Environment("synthetic-catalog")
SMALL = ["train.steps=600", "train.learning_rate=3e-3", "train.cosine=true"]
SMALL += ["train.warmup_steps=50", "policy.dim=32"]
LEARNERS = {"ucf": [*SMALL, "policy.context=10", "crm.epochs=2"], "bc": SMALL}
EPISODES, SEED, K = 400, 1000, 10


def train(folder: Path) -> dict[str, Path]:
    """Collect logs by a mixed behavior policy, and train one run a learner on them.

    Behaviour cloning (`bc`) imitates the logs. UCF is told, in every step, what return is wanted.
    """
    store = EpisodeStore.open(simulated_store(ENVIRONMENT, folder, sessions=2500, seed=0))
    runs = {}
    for learner, settings in LEARNERS.items():
        runs[learner] = folder / learner
        train_run(store, runs[learner], resolve_config(learner, None, settings))
    return runs


# The first way: play it.
#
# `evaluate` plays episodes with seeds that the logs did not have. Look at the rows of `random`, of
# the logging policy and of `optimal` before you look at a policy's.


def by_playing(runs: dict[str, Path]) -> list[ResultRow]:
    """One result row a policy: `R_cum` is the mean return of an episode."""
    rows = [evaluate_behavior(ENVIRONMENT, name, EPISODES, SEED) for name in ("random", "mixture")]
    for name, run in runs.items():
        trained = TrainedPolicy.load(run)
        # By the run's own rule, which was chosen on its log.
        rows.append(evaluate_policy(ENVIRONMENT, trained, name, EPISODES, SEED, trained.rule))
    rows.append(evaluate_behavior(ENVIRONMENT, "optimal", EPISODES, SEED))
    return rows


# The second way: from logs alone.
#
# New logs of the same logging policy, which the runs have not seen. Each logged session is weighted
# by how much likelier the evaluated policy makes its items than the logging policy did; that needs
# the logged propensities. Read the verdict and the warnings first: if the policy does what the logs
# hardly show, its estimate rests on a handful of users. (DM and FQE are fitted models
# instead: they always have an answer, right or wrong.)
#
# One difference to the first way: here an item is drawn from the policy's probabilities, whatever
# the run's own rule does. That rule could be judged too, but one that shows one item for certain
# agrees with hardly any whole session of the logs, and the effective sample shrinks to almost
# nothing.


def drawn(trained: TrainedPolicy) -> DecisionRule:
    """The run's rule, but items are drawn from the policy's probabilities."""
    return replace(trained.rule, temperature=1.0)


def from_logs(runs: dict[str, Path], fresh: Path) -> pd.DataFrame:
    """Estimates of the mean return, one row an estimator and policy, with what warns of them."""
    rows = []
    for name, run in runs.items():
        trained = TrainedPolicy.load(run)
        with logged_sessions(run, trained, [fresh / "sessions.parquet"], LogMapping()) as logged:
            estimates = evaluate_off_policy(run, trained, logged, rule=drawn(trained), seed=0)
        for warning in estimates.warnings:
            print(f"{name}: {warning}")
        print(f"{name}: {estimates.verdict.headline}")
        rows += [
            row.as_line() | {"estimator": row.method, "policy": name} for row in estimates.rows
        ]
    return pd.DataFrame(rows)


# The third way: what was shown next.
#
# How high does the policy rank the item that came next in the new logs? Hit rate at 10 of all items
# that were shown rewards imitation of whoever made the logs. Hit rate at 10 of clicked items is
# closer to what a user liked, but still only among what was shown. The column `mean probability`
# tells of clicked against other items: near 1, the policy's probabilities do not rank clicks.


def by_what_came_next(runs: dict[str, Path], fresh: Path) -> pd.DataFrame:
    """Hit rates at K over the steps of the new logs, one row a policy."""
    rows = []
    for name, run in runs.items():
        trained = TrainedPolicy.load(run)
        with logged_sessions(run, trained, [fresh / "sessions.parquet"], LogMapping()) as logged:
            steps = pd.concat(score(trained, logged, drawn(trained)))
        hit, clicked = steps["rank"] <= K, steps["reward"] > 0
        odds = steps["probability"][clicked].mean() / steps["probability"][~clicked].mean()
        rows.append(
            {
                "policy": name,
                f"hit rate@{K}, shown": hit.mean(),
                f"hit rate@{K}, clicked": hit[clicked].mean(),
                "mean probability, clicked : not": odds,
            }
        )
    return pd.DataFrame(rows)


def main(folder: Path) -> tuple[list[ResultRow], pd.DataFrame, pd.DataFrame]:
    """Train, judge three ways and print all three tables."""
    runs = train(folder)

    played = by_playing(runs)
    print(f"1. played in the simulator\n{evaluation_table(played)}\n")

    simulator = ENVIRONMENT.simulator()
    env = simulator.make(256, None)
    actor = simulator.behaviors["mixture"](env, SEED)
    about = {"env_name": ENVIRONMENT.name, "behavior": "mixture"}
    collect(simulator, env, actor, 800, SEED, folder / "fresh", **about)

    print("2. estimated from new logs")
    estimated = from_logs(runs, folder / "fresh")
    shown = ["policy", "estimator", "R_cum", "R_cum_low", "R_cum_high", "effective_sessions"]
    table = estimated[shown].to_string(index=False, float_format="%.2f", na_rep="–")
    print(table, end="\n\n")

    print("3. what came next in new logs")
    ranked = by_what_came_next(runs, folder / "fresh")
    print(ranked.to_string(index=False, float_format="%.3f"))
    return played, estimated, ranked


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch))
