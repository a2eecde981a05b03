"""How often the answer of `ucfrec ope` is right, in launches whose true gain is known.

    python benchmarks/launches.py --launches 450      # about 40 minutes of one core; resumes
    python benchmarks/launches.py --seed 100 --results /tmp/other.jsonl  # other launches

Every launch has a log of its own, by a policy that serves uniform items in a share of its requests,
and a policy that would be launched in its place. Both draw by scores of items. The policy is the
logging policy with noise in its scores, so that it differs from it, and with so much of the items'
true quality that its gain in return per session is -10%, 0, +5%, +10% or +20%. Ninety launches have
every gain, in two worlds, with 500, 1,500 and 4,000 users of two sessions each, and with 5%, 20%
and 100% exploration:

- the catalogue, `SyntheticCatalog` with 60 items: single items, a repeated tag ends the session;
- the publisher of `examples/make_news_log.py`: pages of four articles, which expire.

Logs go through `Recommender.ope`, as those of the command, with all defaults: a lift of 5% is
wanted. If the answer is an A/B test, one of the planned users is simulated, and evaluated by
`compare` at its planned end: by the return per session, and by the reward per shown item. True
gains are measured in 60,000 users' sessions under both policies with the same random numbers, other
than those that the policy was made with.

Nothing was chosen on the launches of seed 0. Seeds from 100 on were looked at before.
"""

import sys
import tempfile
import time
import warnings
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from measured_rows import append_row, make_parser
from scipy.optimize import brentq
from scipy.special import logit

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.errors import InputNote
from ucfrec.logs.mapping import LogMapping, read_mapping
from ucfrec.off_policy.ab_test import compare_arms
from ucfrec.processes import progress
from ucfrec.python_api.recommender import Recommender
from ucfrec.results.rows import read_rows
from ucfrec_simulators.synthetic_catalog import SyntheticCatalog

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from make_news_log import DAYS, LONGEST, PAGE, START, News
from make_news_log import make_log as make_news_log

SUITE = "launches"
GAINS, USERS, EXPLORATION = (-0.1, 0.0, 0.05, 0.1, 0.2), (500, 1500, 4000), (0.05, 0.2, 1.0)
SESSIONS = 2
"""Of every user."""
NOISE = (0.1, 1.0)
"""Standard deviation of what a policy's scores have of their own, drawn by its logarithm."""
CELLS = Random(0).sample([*product(("catalogue", "publisher"), USERS, EXPLORATION, GAINS)], k=90)
"""World, users, exploration and gain of 90 launches."""
DRAW = DecisionRule(0.0, temperature=1.0)
_SOLVE, _MEASURE, _AT_ONCE, _MOST_TESTED = 2_000, 8_000, 10_000, 100_000
"""Users."""


class Catalogue:
    """`SyntheticCatalog` with 60 items: one a step, of all."""

    page, longest, repeats = 1, 20, True

    def __init__(self, seed: int) -> None:
        self._of = SyntheticCatalog(1, n_items=60, environment_seed=seed)
        self.quality = logit(self._of.click_probabilities.mean(axis=0))
        self.population = len(self._of.logits)

    def read(self, folder: Path) -> LogMapping:
        """How to read its logs."""
        return LogMapping()

    def nearby(self, hour: Float64Array) -> IntArray:
        """(S, W) the only items that sessions of an hour (S,) may show, a superset."""
        return np.tile(np.arange(len(self.quality)), (len(hour), 1))

    def offered(self, items: IntArray, hour: Float64Array) -> BoolArray:
        """(S, W) whether items are on offer at an hour (S, 1)."""
        return np.ones(items.shape, dtype=bool)

    def chances(self, taste: IntArray, items: IntArray, hour: Float64Array) -> Float64Array:
        """(S, page) of clicks by users of a taste (S, 1)."""
        return self._of.click_probabilities[taste, items]

    def stay(self, shown: IntArray, clicks: IntArray, draws: Float64Array) -> BoolArray:
        """(S,) whether sessions go on after steps that showed items (S, T, page), with so many
        clicks (S,) in the last."""
        tags = self._of.tags[shown[:, -self._of.boredom_window :, 0]]
        return np.asarray((tags[:, :-1] != tags[:, -1:]).all(axis=1))

    def value(self, scores: Float64Array, rule: DecisionRule) -> Float64Array:
        """(1,) exact mean return: clicks do not change which items follow, so it is the mean chance
        of a click times the mean length of a session, of tags among which no four have a repeat."""
        chosen = rule.log_probabilities(torch.from_numpy(scores)[None])[0].exp().numpy()
        share = np.bincount(self._of.tags, chosen)
        a, b, c = np.ogrid[(slice(len(share)),) * 3]
        differ = share * ((a != b) & (a != c) & (b != c))
        left = np.outer(share, share)[:, :, None] * differ
        length = 3 - np.square(share).sum()
        for _ in range(self.longest - 3):
            length += left.sum()
            left = (left.sum(axis=0)[:, :, None] - left.transpose(1, 2, 0)) * differ
        return np.array([length * (chosen * self._of.click_probabilities.mean(axis=0)).sum()])


class Publisher:
    """`News`: pages of what is alive, and new to the session."""

    page, longest, repeats = PAGE, LONGEST, False

    def __init__(self, seed: int) -> None:
        self._of, self._seed = News(seed), seed
        self.quality, self.population = self._of.quality, len(self._of.taste)

    def read(self, folder: Path) -> LogMapping:
        make_news_log(folder, sessions=1, seed=self._seed)
        return replace(read_mapping(folder / "news.toml"), columns={}, reward=None)

    def nearby(self, hour: Float64Array) -> IntArray:
        first = np.searchsorted(self._of.published, hour - 72)
        width = int((np.searchsorted(self._of.published, hour + 1) - first).max())
        first = np.minimum(first, len(self.quality) - width)
        return np.asarray(first[:, None] + np.arange(width))

    def offered(self, items: IntArray, hour: Float64Array) -> BoolArray:
        return np.asarray((self._of.published[items] <= hour) & (hour < self._of.expires[items]))

    def chances(self, taste: IntArray, items: IntArray, hour: Float64Array) -> Float64Array:
        return self._of.chances(taste, items, hour)

    def stay(self, shown: IntArray, clicks: IntArray, draws: Float64Array) -> BoolArray:
        return np.asarray(draws <= 0.45 + 0.25 * np.minimum(clicks, 2))


World = Catalogue | Publisher
WORLDS: Final[dict[str, type[World]]] = {"catalogue": Catalogue, "publisher": Publisher}


def play(
    world: World,
    scores: Float64Array,
    rule: DecisionRule,
    users: int,
    seed: list[int],
) -> pd.DataFrame:
    """The log of two sessions of every user, who are shown items drawn by scores (n_items,), with
    the `chance` of each click. Equal seeds have the same users and random numbers."""
    parts, by_item = list[pd.DataFrame](), torch.from_numpy(scores).float()
    for begin in range(0, users, _AT_ONCE):
        rng, count = np.random.default_rng([*seed, begin]), min(_AT_ONCE, users - begin)
        n = count * SESSIONS
        taste = np.repeat(rng.integers(world.population, size=count), SESSIONS)[:, None]
        hour = (np.arange(n) % SESSIONS + 0.98 * rng.random(n))[:, None] * 24 * DAYS / SESSIONS
        nearby, live = world.nearby(hour[:, 0]), np.arange(n)
        fresh, history = np.ones(nearby.shape, dtype=bool), np.empty((n, 0, world.page), int)
        for step in range(world.longest):
            uniforms = rng.random((n, nearby.shape[1] + 1), np.float32)[live]
            draws, stays, pause = rng.random((n, world.page)), rng.random(n), rng.random((n, 1))
            items, at, whose = nearby[live], hour[live], taste[live]
            left = torch.from_numpy(world.offered(items, at) & fresh[live])
            shown = by_item[items].masked_fill(~left, -torch.inf)
            places, propensity = rule.rank_items(shown, world.page, torch.from_numpy(uniforms))
            items = np.take_along_axis(items, places.numpy(), axis=1)
            chance = world.chances(whose, items, at)
            clicks = draws[live] < chance
            columns = {
                "session_id": live[:, None] + begin * SESSIONS,
                "request_id": (live[:, None] + begin * SESSIONS) * world.longest + step,
                "user_id": live[:, None] // SESSIONS + begin,
                "position": np.arange(world.page)[None],
                "hour": at,
                "item_id": items,
                "reward": clicks.astype(np.int64),
                "propensity": propensity.numpy(),
                "chance": chance,
            }
            flat = {k: np.broadcast_to(v, items.shape).ravel() for k, v in columns.items()}
            parts.append(pd.DataFrame(flat))
            history = np.concatenate([history, np.zeros((n, 1, world.page), int)], axis=1)
            history[live, -1] = items
            if not world.repeats:
                fresh[live[:, None], places.numpy()] = False
            live = live[world.stay(history[live], clicks.sum(axis=1), stays[live])]
            hour = hour + 0.01 + 0.06 * pause
            if not len(live):
                break
    log = pd.concat(parts, ignore_index=True)
    log["timestamp"] = START + pd.to_timedelta(log.pop("hour"), "h").dt.round("ms")
    return log


@cache
def make_world(name: str, seed: int) -> tuple[World, Float64Array]:
    """A world, and the scores that its logging policy draws by."""
    world, rng = WORLDS[name](seed), np.random.default_rng([seed, 7])
    world.quality = (world.quality - world.quality.mean()) / world.quality.std()
    return world, 0.4 * world.quality + 0.5 * rng.normal(size=len(world.quality))


@cache
def train(name: str, seed: int, scratch: Path) -> Path:
    """A run that knows all items of a world, from users that no later log has."""
    folder, (world, scores) = scratch / f"{name}-{seed}", make_world(name, seed)
    log = play(world, scores, DecisionRule(0.0, explore=1.0), 2000, [seed, 8])
    log["user_id"] += 10**6
    rows, mapping = log.drop(columns="chance"), world.read(folder)
    return Recommender("item-rate").fit(rows, folder / "run", mapping=mapping).run


def value(
    world: World,
    scores: Float64Array,
    rule: DecisionRule,
    users: int,
    seed: list[int],
) -> Float64Array:
    """(U,) expected returns per session of users, or (1,) their mean where it is known."""
    if isinstance(world, Catalogue):
        return world.value(scores, rule)
    log = play(world, scores, rule, users, seed)
    return np.asarray(np.bincount(log.user_id, log.chance, users) / SESSIONS)


def make_target(
    world: World,
    behavior: DecisionRule,
    scores: Float64Array,
    gain: float,
    seed: list[int],
) -> Float64Array:
    """Scores (n_items,) of a policy that differs at random from the logging policy, and is better
    by a share `gain` of its return."""
    rng = np.random.default_rng([*seed, 1])
    shares = np.exp(scores) / np.exp(scores).mean()
    as_logged = np.log((1 - behavior.explore) * shares + behavior.explore)
    logged = value(world, scores, behavior, _SOLVE, [*seed, 2]).mean()
    while True:
        base = as_logged + np.exp(rng.uniform(*np.log(NOISE))) * rng.normal(size=len(scores))

        def excess(weight: float, base: Float64Array = base) -> float:
            returns = value(world, base + weight * world.quality, DRAW, _SOLVE, [*seed, 2])
            return float(returns.mean() / logged - 1 - gain)

        # Too much of the best items ends sessions of the catalogue, so not every gain is reached.
        step = -np.sign(excess(0.0)) * 0.3
        for weight in step * np.arange(1, 6):
            if excess(weight) * step > 0:
                return base + brentq(excess, weight - step, weight, xtol=0.01) * world.quality


def test(
    world: World,
    arms: tuple[tuple[Float64Array, DecisionRule], ...],
    users: int,
    seed: list[int],
    file: Path,
) -> dict[str, bool]:
    """Whether an A/B test of so many users finds a gain: in the return per session, and in the
    reward per item."""
    logs = []
    for number, (scores, rule) in enumerate(arms):
        log = play(world, scores, rule, users // 2, [*seed, number])
        logs.append(log.assign(user_id=log.user_id + number * users, arm=f"arm {number}"))
    items, found = pd.concat(logs), {}
    sessions = items.groupby(["user_id", "session_id", "arm"], as_index=False)["reward"].sum()
    for unit, frame in (("session", sessions), ("item", items)):
        frame[["user_id", "arm", "reward"]].to_parquet(file)
        planned = compare_arms([file], "reward", ("arm 0", "arm 1")).planned
        found[unit] = planned.low is not None and planned.low > 0
    return found


def launch(number: int, seed: int, scratch: Path) -> dict[str, Any]:
    """Fields of a result row: what `ope` answers, what is true, and what a planned test shows."""
    began, (name, users, explore, gain) = time.perf_counter(), CELLS[number % len(CELLS)]
    world_seed, own = 1000 * seed + number // len(CELLS), [seed, number]
    world, scores = make_world(name, world_seed)
    # Read anew, as a policy that has acted keeps what it made of its weights.
    model = Recommender.load(train(name, world_seed, scratch))
    behavior, rule = replace(DRAW, explore=explore), replace(DRAW, exclude_seen=not world.repeats)
    target = make_target(world, behavior, scores, gain, own)
    model.trained.policy.head.get_parameter("bias").data.copy_(torch.from_numpy(target))
    log = play(world, scores, behavior, users, [*own, 3]).drop(columns="chance")
    verdict = model.ope(log, rule=rule, seed=number).verdict
    arms = (scores, behavior), (target, rule)
    before, after = (value(world, *arm, _MEASURE, [*own, 4]) for arm in arms)
    true = after.mean() / before.mean() - 1
    error = (after - (1 + true) * before).std() / before.mean() / len(before) ** 0.5
    details: dict[str, Any] = {"answer": verdict.answer, "reliable": verdict.lift.is_reliable}
    lift, logged = verdict.lift, verdict.logged
    metrics = {"gain": gain, "true": true, "error": error, "logged": logged}
    metrics["effective_users"] = verdict.effective_users
    if lift.value is not None and lift.low is not None and lift.high is not None:
        metrics |= {"lift": lift.value, "low": lift.low, "high": lift.high}
    if verdict.answer == "test it" and verdict.test is not None:
        plan = verdict.test
        metrics |= {"plan_users": plan.users, "plan_days": plan.days or 0.0, "plan_lift": plan.lift}
        if plan.users <= _MOST_TESTED:
            details["finds"] = test(world, arms, plan.users, [*own, 5], scratch / "test.parquet")
    return {
        "task": name,
        "method": "ope",
        "policy": "item-rate",
        "log_seed": number,
        "evaluation_seed": seed,
        "conditions": {"users": users, "exploration": explore},
        "metrics": {measure: float(f"{number:.4g}") for measure, number in metrics.items()},
        "details": details,
        "wall_time_s": round(time.perf_counter() - began, 1),
    }


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("--launches", type=int, default=450)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore", InputNote)  # that the users are new
    done = {(row.evaluation_seed, row.log_seed) for row in read_rows(options.results)}
    missing = [n for n in range(options.launches) if (options.seed, n) not in done]
    with (
        tempfile.TemporaryDirectory() as scratch,
        progress(len(missing), "launches", "launches") as bar,
    ):
        for number in missing:
            append_row(options.results, SUITE, **launch(number, options.seed, Path(scratch)))
            bar.update()
    rows = [row for row in read_rows(options.results) if row.evaluation_seed == options.seed]
    print(len(rows))


if __name__ == "__main__":
    main()
