"""CPU time of acting by a trained run, beside another way of doing the same, in turn.

    python benchmarks/acting_time.py RUN STORE

`one user`: a line of JSON to the line that answers it, as `ucfrec recommend --stream` and `serve`
do; beside it, a store of every request. The rule is the run's, or what `--reward-weight`,
`--tag-window` and the other options of `ucfrec serve` say. With `--items 1000000` also for a
catalogue of random copies of the run's items. `one user's frame`: `Recommender.recommend`, beside
reading the frame by SQL. `all users`: `ucfrec recommend` without its start, beside a store of all
requests. `choose the rule`: decision rules simulated side by side, and one after the other.
`VirtualTaobao`: pages of 4,096 sessions, beside the authors' environment (--original, their
repository) page by page.

One thread. Appends the rows to runs/acting_time/results.jsonl, or to --results, and prints a table.
"""

import argparse
import io
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from ucfrec import Recommender, schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import logged_history
from ucfrec.choosing.by_simulation import RuleSearch
from ucfrec.choosing.choice import Problem, RuleConfig
from ucfrec.commands.options import rule_given, rule_options
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import LogMapping
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import provenance
from ucfrec.recommending.histories import Histories, histories_of_files
from ucfrec.recommending.recommend import recommend
from ucfrec.recommending.requests import Limits
from ucfrec.recommending.responder import ENGINES, TORCH, Responder
from ucfrec.recommending.stream import answer_stream
from ucfrec.reporting.tables import markdown_table
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import append_rows
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import REWARD_MODEL, TrainedPolicy
from ucfrec.user_model.model import UserModel
from ucfrec.user_model.reward import ItemRewardModel

RESULTS = Path("runs/acting_time/results.jsonl")
HISTORY, SESSIONS, PAGES, LOG_USERS = 20, 4096, 300, 5000
TASKS = (
    "one user",
    "one user, large catalogue",
    "one user's frame",
    "all users",
    "choose the rule",
    "VirtualTaobao",
)
BEGAN = 1_700_000_000_000
Way = Callable[[], object]


class Case(NamedTuple):
    """Two ways of doing the same."""

    task: str
    ways: tuple[Way, Way]
    rounds: int
    units: tuple[int, int] = (1, 1)
    """What one call of each way does, such as the number of users."""


def enlarged(trained: TrainedPolicy, items: int) -> TrainedPolicy:
    """The policy with a catalogue of random copies of its items."""
    states, model = trained.item_states, trained.reward_model
    assert states is not None
    assert model is not None
    n_items = len(states.embeddings)
    rows = torch.randint(n_items, (items,), generator=torch.Generator().manual_seed(0))
    sizes = {**trained.record.sizes, "items": items}
    config = trained.record.config
    policy = policy_class(config.policy_name)(config.policy, sizes)
    larger = ItemRewardModel(sizes)
    for old, new in ((trained.policy, policy), (model, larger)):
        values = old.state_dict()
        for name, value in values.items():
            if value.ndim and len(value) == n_items:
                values[name] = value[rows]
        new.load_state_dict(values)
    return replace(
        trained,
        policy=policy.eval(),
        reward_model=larger.eval(),
        item_states=replace(states, embeddings=states.embeddings[rows], tags=states.tags[rows]),
        item_ids=np.arange(items),
    )


def line_ways(trained: TrainedPolicy, engine: str) -> tuple[Way, Way]:
    """Answer one line of JSON: as the stream does, and by way of a store."""
    assert trained.item_ids is not None
    rng = np.random.default_rng(0)
    rows = [
        {"item_id": item, "timestamp": BEGAN + 1000 * n, "reward": n % 2, schema.SESSION_ID: 1}
        for n, item in enumerate(rng.choice(trained.item_ids, size=HISTORY).tolist())
    ]
    line = json.dumps({"user_id": "someone", "history": rows, "k": 10}).encode() + b"\n"
    responder, scorer = Responder(trained, Limits(), engine=engine), trained.scorer()

    def before() -> str:
        request = json.loads(line)
        history = responder._reader.read(request["history"], request["user_id"])
        items = trained.items.numbers(history.item_ids)
        store = _next_steps(trained, items, history.rewards, np.array([HISTORY]), np.array([-1]))
        left_out = torch.zeros(1, len(trained.items), dtype=torch.bool)
        left_out[0, items] = True
        last = store.lengths - 1
        known, _ = logged_history(scorer, store, np.arange(1), last)
        scores = scorer.scores(known, excluded=left_out).log_softmax(-1)
        best = scores.topk(request["k"])
        pairs = zip(trained.item_ids[best.indices[0]].tolist(), best.values[0].tolist())  # type: ignore[index]  # noqa: B905
        return json.dumps({"items": [{"item_id": item, "score": score} for item, score in pairs]})

    return lambda: answer_stream(responder, io.BytesIO(line), io.BytesIO()), before


def _next_steps(
    trained: TrainedPolicy,
    items: np.ndarray,
    rewards: np.ndarray,
    counts: np.ndarray,
    users: np.ndarray,
) -> EpisodeStore:
    """A store of sessions with the step that follows each."""
    ends = np.cumsum(counts)
    columns = {schema.ITEM: np.insert(items, ends, 0), schema.REWARD: np.insert(rewards, ends, 0)}
    return EpisodeStore.from_arrays(columns, counts + 1, {schema.USER: users}, trained.item_states)


def frame_ways(run: Path) -> tuple[Way, Way]:
    """Recommend to one user whose frame is read directly, and by SQL."""
    policy, rng = Recommender.load(run), np.random.default_rng(0)
    items = policy.trained.items.ids
    frame = pd.DataFrame({schema.USER_ID: np.full(10, 1), schema.ITEM_ID: items[:10]})
    frame[schema.TIMESTAMP] = BEGAN + np.cumsum(rng.integers(1, 60_000, 10))
    frame[schema.REWARD] = rng.random(10).round()
    if policy.trained.record.session_by == schema.SESSION_ID:
        frame[schema.SESSION_ID] = 1
    named = LogMapping({schema.ITEM_ID: schema.ITEM_ID})
    return lambda: policy.recommend(frame), lambda: policy.recommend(frame, mapping=named)


def log_ways(trained: TrainedPolicy, store: EpisodeStore, folder: Path) -> tuple[Way, Way, int]:
    """Recommend to all users of a log of the store's sessions: now, and by way of stores."""
    episodes, steps = store.all_steps()
    assert trained.item_ids is not None
    frame = pd.DataFrame(
        {
            schema.USER_ID: episodes,
            schema.ITEM_ID: trained.item_ids[store.step_values(schema.ITEM, episodes, steps)],
            schema.TIMESTAMP: BEGAN + 1000 * steps,
            schema.REWARD: store.step_values(schema.REWARD, episodes, steps),
            schema.SESSION_ID: episodes,
        }
    )
    # The way of the run's reward to its column is not what is measured.
    log = folder / "log.parquet"
    frame.assign(**{trained.record.reward: frame[schema.REWARD]}).to_parquet(log)
    scorer = trained.scorer()

    def batches() -> Iterator[Histories]:
        return histories_of_files(trained, [log], LogMapping())

    def before() -> None:
        for batch in batches():
            items = trained.items.numbers(batch.item_ids)
            for first in range(0, len(batch.users), 1024):
                users = np.arange(first, min(first + 1024, len(batch.users)))
                at = slice(*np.searchsorted(batch.owner, [first, users[-1] + 1]))
                owner = batch.owner[at] - first
                counts = np.bincount(owner, minlength=len(users))
                nobody = np.full(len(users), -1)
                steps = _next_steps(trained, items[at], batch.rewards[at], counts, nobody)
                left_out = torch.zeros(len(users), len(trained.items), dtype=torch.bool)
                left_out[owner, items[at]] = True
                rows = np.arange(len(users))
                known, _ = logged_history(scorer, steps, rows, counts)
                scores = scorer.scores(known, excluded=left_out)
                scores.topk(10), scores.log_softmax(-1)

    return (lambda: list(recommend(trained, batches(), 10))), before, len(store)


def rule_ways(run: Path, store: EpisodeStore, sessions: int) -> tuple[Way, Way]:
    """Simulate 8 rules side by side, and one after the other."""
    trained, views = TrainedPolicy.load(run), training_views(store)
    target, config = trained.target_return(1.0), RuleConfig(sessions=sessions)
    scorer = trained.scorer(DecisionRule(target))
    users = UserModel.fit(*views, run / REWARD_MODEL, 0)
    search = RuleSearch(Problem(scorer, users, {}, *views, config, seed=0))
    rules = [
        DecisionRule(target, minimum, reward_weight=reward_weight, temperature=temperature)
        for minimum in (None, target)
        for reward_weight in (0.0, 4.0)
        for temperature in (0.0, 0.5)
    ]
    return lambda: search.simulate(rules), lambda: [search.simulate([rule]) for rule in rules]


def taobao_ways(original: Path) -> tuple[Way, Way, tuple[int, int]]:
    """Turn pages of many sessions at once, and of one session of the authors' environment."""
    import gymnasium

    from ucfrec_simulators.taobao.virtual import VirtualTaobao

    # The authors' code imports the package that Gymnasium continues.
    for name in ("", ".utils", ".utils.seeding", ".envs", ".envs.registration"):
        sys.modules[f"gym{name}"] = __import__(f"gymnasium{name}", fromlist=["x"])
    sys.path.insert(0, str(original))
    from virtualTB.envs.virtualTB import VirtualTB  # type: ignore[import-not-found]

    rng, pages = np.random.default_rng(0), 4
    many = VirtualTaobao(original / "virtualTB" / "data", SESSIONS)
    many.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one: Any = VirtualTB()

    def all_at_once() -> None:
        for _ in range(pages):
            many.step(rng.uniform(-1, 1, (SESSIONS, 27)).astype(np.float32))

    def one_by_one() -> None:
        for _ in range(PAGES):
            if one.step(rng.uniform(-1, 1, 27).astype(np.float32))[2]:
                one.reset()

    assert gymnasium.__version__
    return all_at_once, one_by_one, (pages * SESSIONS, PAGES)


def seconds(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """CPU and wall seconds (rounds, 2) of both ways, in turn, after one round that counts not."""
    taken = []
    for turn in range(case.rounds + 1):
        times = []
        for way in case.ways:
            cpu, wall = time.thread_time(), time.perf_counter()
            way()
            times.append((time.thread_time() - cpu, time.perf_counter() - wall))
        taken += [times] if turn else []
    both = np.array(taken)
    return both[..., 0], both[..., 1]


def cases(options: argparse.Namespace, folder: Path) -> Iterator[tuple[Case, int]]:
    """The cases, and the number of items of each."""
    trained, store = TrainedPolicy.load(options.run), EpisodeStore.open(options.store)
    trained = replace(trained, rule=rule_given(options, trained))
    items, rounds, wanted = len(trained.items), options.rounds, options.only or TASKS
    if "one user" in wanted:
        yield Case("one user", line_ways(trained, options.engine), options.users), items
    if "one user, large catalogue" in wanted and options.items:
        ways = line_ways(enlarged(trained, options.items), options.engine)
        yield Case("one user, large catalogue", ways, max(60, rounds)), options.items
        del ways
    if "one user's frame" in wanted:
        yield Case("one user's frame", frame_ways(options.run), options.users), items
    if "all users" in wanted:
        some = store.select(np.arange(min(LOG_USERS, len(store))))
        now, before, users = log_ways(trained, some, folder)
        yield Case("all users", (now, before), rounds, (users, users)), items
    if "choose the rule" in wanted:
        ways = rule_ways(options.run, store, options.sessions)
        yield Case("choose the rule", ways, rounds), items
    if "VirtualTaobao" in wanted and options.original:
        first, second, units = taobao_ways(options.original)
        yield Case("VirtualTaobao", (first, second), rounds, units), 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder of a policy of items")
    parser.add_argument("store", type=Path, help="the store that it was trained on")
    parser.add_argument("--sessions", type=int, default=100, help="sessions of a rule (100)")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds (5)")
    parser.add_argument("--users", type=int, default=300, help="timed rounds of one user (300)")
    parser.add_argument("--items", type=int, default=0, help="of a larger catalogue (none)")
    parser.add_argument("--engine", choices=ENGINES, default=TORCH, help="of one user (torch)")
    parser.add_argument("--original", type=Path, help="folder of the authors' VirtualTaobao")
    parser.add_argument("--only", nargs="+", choices=TASKS, help="what to measure (everything)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    rule_options(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = []
    with tempfile.TemporaryDirectory() as name:
        for case, items in cases(options, Path(name)):
            cpu, wall = seconds(case)
            each = 1e3 * cpu / case.units
            ratio = float(np.median(each[:, 0] / each[:, 1]))
            middle, high = np.quantile(each[:, 0], [0.5, 0.99])
            found = {
                "ratio": ratio,
                "median_ms": float(middle),
                "p99_ms": float(high),
                "p99_wall_ms": float(1e3 * np.quantile(wall[:, 0] / case.units[0], 0.99)),
                "before_ms": float(np.median(each[:, 1])),
            }
            lines.append((case.task, f"{items:,}", *(f"{value:.4g}" for value in found.values())))
            row = ResultRow(
                suite="acting-time",
                table="acting-time",
                task=case.task,
                method="ucf",
                policy="ucf",
                conditions={"items": items, "rounds": case.rounds, "sessions": options.sessions}
                | ({} if options.engine == TORCH else {"engine": options.engine}),
                metric="ratio",
                metrics=found,
                wall_time_s=float(wall.sum()),
                **provenance(),
            )
            append_rows(options.results, [row])
            print(*lines[-1], flush=True)
    heads = ("what", "items", "CPU time / the other way's", "median, ms", "99%", "99%, clock")
    print(markdown_table((*heads, "the other way, ms"), lines))


if __name__ == "__main__":
    main()
