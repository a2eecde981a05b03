"""What models of the users promise of decision rules, and what comes in the environment.

    python benchmarks/promised_returns.py --out runs/promised           # ten minutes on one core
    python benchmarks/promised_returns.py --out runs/promised --log 1   # nothing was decided on it

In SARDINE's BoredInf, whose users are new in every session: UCF and BC are trained on 500 sessions
of its oracles at the sizes of the benchmark's small budget. The rule of each is played at every
reward weight and temperature in three models of the users, each fitted to the log alone, and in
the environment:

- reward model: rewards are drawn from the run's reward model, which learns tastes from the session;
- training users: users have the tastes of training users;
- weighted: the same, fitted with the log's propensities, as `train` does.

The table says what each promises; then how far promises are off in the mean, and Spearman's rank
correlation with the environment, over the rules of a policy.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from scipy.stats import spearmanr

from ucfrec.acting.decision import DecisionRule
from ucfrec.choosing.by_simulation import RuleSearch
from ucfrec.choosing.config import RuleConfig
from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_policy
from ucfrec.evaluation.simulated_store import simulated_store
from ucfrec.provenance import config_hash, provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows, read_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.schema import PROPENSITY
from ucfrec.user_model.training_users import TrainingUsers, fit_training_users
from ucfrec_simulators.benchmark.plan import BUDGETS

ENVIRONMENT, SESSIONS, EPISODES, SEED = Environment("sardine-boredinf"), 500, 300, 3_000_000
POLICIES = {"ucf": ("policy.context=11",), "bc": ()}
RULES = tuple(product((1.0, 0.5), (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)))
"""Temperatures and reward weights."""
MODELS = ("reward model", "training users", "weighted")


def users_of(store: Path, path: Path) -> TrainingUsers:
    """The training users of a store."""
    return fit_training_users(training_views(EpisodeStore.open(store))[0], path, 0)


def without_propensities(logs: Path, folder: Path, log: int) -> Path:
    """The store of the same logs without their propensities."""
    for file in logs.rglob("*.parquet"):
        target = folder / "logs" / file.relative_to(logs)
        target.parent.mkdir(parents=True, exist_ok=True)
        table = pq.read_table(file)
        kept = [name for name in table.column_names if name != PROPENSITY]
        pq.write_table(table.select(kept), target)
    return simulated_store(ENVIRONMENT, folder, SESSIONS, log)


def measured(
    name: str, out: Path, log: int, seed: int
) -> tuple[list[ResultRow], Mapping[str, Any]]:
    """Rows of the rules of one policy, and the configuration of its training."""
    path = simulated_store(ENVIRONMENT, out / "told", SESSIONS, log)
    bare = without_propensities(out / "told" / "logs", out / "untold", log)
    store = EpisodeStore.open(path)
    config = resolve_config(name, None, (*BUDGETS["small"].settings, *POLICIES[name]), seed)
    train_run(store, out / f"{name}-{seed}", config)
    trained = TrainedPolicy.load(out / f"{name}-{seed}")
    rules = [replace(trained.rule, temperature=t, reward_weight=b) for t, b in RULES]
    train, validation = training_views(store)
    given = trained.decider(DecisionRule(trained.rule.target)), train, validation, RuleConfig(), 0
    users = {
        "reward model": None,
        "training users": users_of(bare, out / "untold.safetensors"),
        "weighted": users_of(path, out / "told.safetensors"),
    }
    played = {model: RuleSearch(*given, users[model]).play(rules) for model in MODELS}
    rows = [
        row(name, log, seed, rule, {m: played[m][i].value for m in MODELS}, trained, store)
        for i, rule in enumerate(rules)
    ]
    return rows, trained.record.settings


def row(
    name: str,
    log: int,
    seed: int,
    rule: DecisionRule,
    promised: Mapping[str, float],
    trained: TrainedPolicy,
    store: EpisodeStore,
) -> ResultRow:
    """The row of a rule: what was promised of it, and what it earns."""
    played = evaluate_policy(ENVIRONMENT, trained, name, EPISODES, SEED, rule)
    return ResultRow(
        suite="promised-returns",
        table="promised-returns",
        task=ENVIRONMENT.name,
        method=name,
        policy=name,
        training_seed=seed,
        log_seed=log,
        evaluation_seed=SEED,
        conditions={
            "temperature": rule.temperature,
            "reward_weight": rule.reward_weight,
            "episodes": EPISODES,
        },
        config_hash=config_hash(trained.record.settings),
        code_version=code_version(RuleSearch.__module__, fit_training_users.__module__),
        data_fingerprint=store.record.fingerprint,
        metric="R_cum",
        metrics={"R_cum": played["R_cum"], **promised},
        interval=(played["R_cum_low"], played["R_cum_high"]),
        rule=f"{rule} ({rule.hash})",
        wall_time_s=played["wall_time_s"],
        **provenance(),
    )


def tables(rows: Sequence[ResultRow]) -> str:
    """Promises and returns of every rule, then how they agree."""
    lines, agreement = list[Sequence[object]](), list[Sequence[object]]()
    for name in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == name]
        for each in own:
            promised = [f"{each.metrics[model]:.1f}" for model in MODELS]
            rule = (each.conditions["temperature"], each.conditions["reward_weight"])
            lines.append((name, *rule, *promised, f"{each.value:.1f}"))
        earned = np.array([each.value for each in own])
        for model in MODELS:
            promises = np.array([each.metrics[model] for each in own])
            rank = spearmanr(promises, earned).statistic
            agreement.append(
                (name, model, f"{np.abs(promises - earned).mean():.1f}", f"{rank:.2f}")
            )
    head = ("policy", "temperature", "reward_weight", *MODELS, "environment")
    told = markdown_table(("policy", "model", "off by, mean", "rank correlation"), agreement)
    return f"{markdown_table(head, lines)}\n\n{told}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/promised"))
    parser.add_argument("--results", type=Path, help="file of rows (results.jsonl in --out)")
    parser.add_argument("--log", type=int, default=0, help="seed of the log")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    parser.add_argument("--show-only", action="store_true", help="print the rows at hand")
    options = parser.parse_args()
    results = options.results or options.out / "results.jsonl"
    if not options.show_only:
        for name in POLICIES:
            folder = options.out / f"log-{options.log}"
            found, config = measured(name, folder, options.log, options.seed)
            known = read_rows(results) if results.exists() else []
            new = [each for each in found if not any(map(each.covers, known))]
            append_rows(results, new, config)
    wanted = options.log, options.seed
    rows = [row for row in read_rows(results) if (row.log_seed, row.training_seed) == wanted]
    print(tables(rows))


if __name__ == "__main__":
    main()
