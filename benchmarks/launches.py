"""How often the answer of `ucfrec ope` is right, in launches whose true gain is known.

    python benchmarks/launches.py --launches 360      # 20 minutes of one core; resumes

Each launch has a log of its own, of a policy that draws items by scores, and uniformly in a share
of its requests. The policy to launch draws by these scores with noise, and with so much of the
items' true quality that its gain in return per session is -10%, 0, +5% or +10%. Every 72 launches
have each gain, share of 5%, 20% and 100%, and 400, 1,200 and 3,000 users of two sessions, in two
worlds: `SyntheticCatalog` with 60 items, where a repeated tag ends the session, and the publisher
of `examples/make_news_log.py`, with pages of four articles, which expire. Both have three seeds.

Logs go through `Recommender.ope`, as those of the command, with its defaults: a lift of 5% is
wanted. If it plans an A/B test, a test of as many users is simulated, and evaluated by `compare` at
its planned end, by return per session and by reward per item. True gains are exact in the
catalogue; at the publisher they are means over 6,000 users who have the same random numbers under
both policies, other than those that the policy was made with.

Nothing was chosen on the launches of seed 0. Some of --seed 100 were looked at before.
"""

import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pandas as pd
import torch
from measured_rows import append_row, make_parser
from results_page import answers
from scipy.optimize import brentq
from scipy.special import logit

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.errors import InputNote
from ucfrec.logs.mapping import read_mapping
from ucfrec.off_policy.ab_test import compare_arms
from ucfrec.processes import progress
from ucfrec.python_api.recommender import Recommender
from ucfrec.results.rows import read_rows
from ucfrec_simulators.synthetic_catalog import SyntheticCatalog

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from make_news_log import DAYS, LONGEST, PAGE, START, News
from make_news_log import make_log as make_news_log

SUITE = "launches"
GAINS, USERS, EXPLORATION = (-0.1, 0.0, 0.05, 0.1), (400, 1200, 3000), (0.05, 0.2, 1.0)
SESSIONS = 2
"""Of every user."""
NOISE = (0.1, 1.0)
"""Standard deviation of what a policy's scores have of their own, drawn by its logarithm."""
CELLS = Random(0).sample([*product(("catalogue", "publisher"), USERS, EXPLORATION, GAINS)], k=72)
"""World, users, exploration and gain of 72 launches, in no order."""
DRAW = DecisionRule(0.0, temperature=1.0)
_SOLVE, _MEASURE, _MOST_TESTED = 2_000, 6_000, 50_000
"""Users."""


class Catalogue:
    """`SyntheticCatalog` with 60 items: one a step, of all."""

    page, longest, repeats = 1, 20, True

    def __init__(self, seed: int) -> None:
        self._of = SyntheticCatalog(1, n_items=60, environment_seed=seed)
        self.quality = logit(self._of.click_probabilities.mean(axis=0))
        self.population = len(self._of.logits)

    def nearby(self, hour: Float64Array) -> IntArray:
        """(S, W) items among which are all that sessions of an hour (S,) may show."""
        return np.tile(np.arange(len(self.quality)), (len(hour), 1))

    def offered(self, items: IntArray, hour: Float64Array) -> BoolArray:
        """(S, W) whether items are on offer at an hour (S, 1)."""
        return np.ones(items.shape, dtype=bool)

    def chances(self, taste: IntArray, items: IntArray, hour: Float64Array) -> Float64Array:
        """(S, page) of clicks by users of a taste (S, 1)."""
        return np.asarray(self._of.click_probabilities[taste, items])

    def stay(self, shown: IntArray, clicks: IntArray, draws: Float64Array) -> BoolArray:
        """(S,) whether sessions go on after steps that showed items (S, T, page), with so many
        clicks (S,) in the last."""
        tags = self._of.tags[shown[:, -self._of.boredom_window :, 0]]
        return np.asarray((tags[:, :-1] != tags[:, -1:]).all(axis=1))

    def value(self, probabilities: Float64Array) -> Float64Array:
        """(1,) exact mean return: clicks do not change which items follow, so it is the mean chance
        of a click times the mean length of a session, of tags among which no four have a repeat."""
        share = np.bincount(self._of.tags, probabilities)
        a, b, c = np.ogrid[(slice(len(share)),) * 3]
        differ = share * ((a != b) & (a != c) & (b != c))
        left, length = np.outer(share, share)[:, :, None] * differ, 3 - np.square(share).sum()
        for _ in range(self.longest - 3):
            length += left.sum()
            left = (left.sum(axis=0)[:, :, None] - left.transpose(1, 2, 0)) * differ
        return np.array([length * (self._of.click_probabilities.mean(axis=0) @ probabilities)])


class Publisher:
    """`News`: pages of what is alive, and new to the session."""

    page, longest, repeats = PAGE, LONGEST, False

    def __init__(self, seed: int) -> None:
        self._of = News(seed)
        self.quality, self.population = self._of.quality, len(self._of.taste)
        self.chances = self._of.chances

    def nearby(self, hour: Float64Array) -> IntArray:
        first = np.searchsorted(self._of.published, hour - 72)
        width = int((np.searchsorted(self._of.published, hour + 1) - first).max())
        return np.asarray(np.minimum(first, len(self.quality) - width)[:, None] + np.arange(width))

    def offered(self, items: IntArray, hour: Float64Array) -> BoolArray:
        return self._of.is_alive(items, hour)

    def stay(self, shown: IntArray, clicks: IntArray, draws: Float64Array) -> BoolArray:
        return self._of.goes_on(clicks, draws)


@dataclass(frozen=True)
class Arm:
    """A policy in a world: items are drawn by scores (n_items,)."""

    world: Catalogue | Publisher
    scores: Float64Array
    rule: DecisionRule

    def play(self, users: int, seed: Sequence[int]) -> pd.DataFrame:
        """The log of two sessions of every user, with the `chance` of each click. Equal seeds have
        the same users and random numbers."""
        rng, parts = np.random.default_rng([*seed, 0]), list[pd.DataFrame]()
        world, n, by_item = self.world, users * SESSIONS, torch.from_numpy(self.scores).float()
        taste = np.repeat(rng.integers(world.population, size=users), SESSIONS)[:, None]
        hour = (np.arange(n) % SESSIONS + 0.98 * rng.random(n))[:, None] * 24 * DAYS / SESSIONS
        nearby, live = world.nearby(hour[:, 0]), np.arange(n)
        fresh, history = np.ones(nearby.shape, dtype=bool), np.empty((n, 0, world.page), int)
        for step in range(world.longest):
            uniforms = rng.random((n, nearby.shape[1] + 1), np.float32)[live]
            draws, stays, pause = rng.random((n, world.page)), rng.random(n), rng.random((n, 1))
            items, at = nearby[live], hour[live]
            left = torch.from_numpy(world.offered(items, at) & fresh[live])
            shown = by_item[items].masked_fill(~left, -torch.inf)
            places, propensity = self.rule.rank_items(shown, world.page, torch.from_numpy(uniforms))
            items = np.take_along_axis(items, places.numpy(), axis=1)
            chance = world.chances(taste[live], items, at)
            clicks, number, place = draws[live] < chance, live[:, None], np.arange(world.page)[None]
            columns = {
                "session_id": number,
                "request_id": number * world.longest + step,
                "user_id": number // SESSIONS,
                **{"position": place, "hour": at, "item_id": items, "reward": clicks + 0},
                **{"propensity": propensity.numpy(), "chance": chance},
            }
            flat = {name: np.broadcast_to(v, items.shape).ravel() for name, v in columns.items()}
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

    def value(self, users: int, seed: Sequence[int]) -> Float64Array:
        """(U,) expected returns per session of users, or (1,) their mean where it is known."""
        if isinstance(self.world, Catalogue):
            logs = self.rule.log_probabilities(torch.from_numpy(self.scores)[None])
            return self.world.value(logs[0].exp().numpy())
        log = self.play(users, seed)
        return np.asarray(np.bincount(log.user_id, log.chance, users) / SESSIONS)

    def improve(self, gain: float, seed: Sequence[int]) -> "Arm":
        """A policy without exploration that differs at random from this one, and is better by a
        share `gain` of its return."""
        rng, quality = np.random.default_rng([*seed, 1]), self.world.quality
        shares = np.exp(self.scores) / np.exp(self.scores).mean()
        base = np.log((1 - self.rule.explore) * shares + self.rule.explore)
        logged = self.value(_SOLVE, [*seed, 2]).mean()
        while True:
            noise = np.exp(rng.uniform(*np.log(NOISE))) * rng.normal(size=len(base))

            def excess(weight: float, start: Float64Array = base + noise) -> float:
                arm = Arm(self.world, start + weight * quality, DRAW)
                return float(arm.value(_SOLVE, [*seed, 2]).mean() / logged - 1 - gain)

            # Too much of the best items ends sessions of the catalogue: not every gain is reached.
            step = -np.sign(excess(0.0)) * 0.3
            for end in step * np.arange(1, 6):
                if excess(end) * step > 0:
                    weight = brentq(excess, end - step, end, xtol=0.01)
                    return Arm(self.world, base + noise + weight * quality, DRAW)


@cache
def make_arm(name: str, seed: int) -> Arm:
    """A world, and the policy that serves in it before exploration."""
    world = Catalogue(seed) if name == "catalogue" else Publisher(seed)
    scores = 0.5 * np.random.default_rng([seed, 7]).normal(size=len(world.quality))
    world.quality = (world.quality - world.quality.mean()) / world.quality.std()
    return Arm(world, scores, DRAW)


@cache
def train(name: str, seed: int, scratch: Path) -> Path:
    """A run that knows all items of a world, from users that no later log has."""
    folder, arm = scratch / f"{name}-{seed}", make_arm(name, seed)
    log = replace(arm, rule=replace(DRAW, explore=1.0)).play(2000, [seed, 8])
    rows = log.drop(columns="chance").assign(user_id=log.user_id + 10**6)
    mapping = None
    if isinstance(arm.world, Publisher):
        make_news_log(folder, sessions=1, seed=seed)
        mapping = replace(read_mapping(folder / "news.toml"), columns={}, reward=None)
    return Recommender("item-rate").fit(rows, folder / "run", mapping=mapping).run


def test(arms: Sequence[Arm], users: int, seed: Sequence[int], file: Path) -> dict[str, bool]:
    """Whether an A/B test of so many users finds a gain: in the return per session, and in the
    reward per item."""
    logs = []
    for number, arm in enumerate(arms):
        log = arm.play(users // 2, [*seed, number])
        logs.append(log.assign(user_id=log.user_id + number * users, arm=f"arm {number}"))
    items, finds = pd.concat(logs), {}
    sessions = items.groupby(["user_id", "session_id", "arm"], as_index=False)["reward"].sum()
    for unit, frame in (("session", sessions), ("item", items)):
        frame[["user_id", "arm", "reward"]].to_parquet(file)
        planned = compare_arms([file], "reward", ("arm 0", "arm 1"), per="item").planned
        finds[unit] = planned.low is not None and planned.low > 0
    return finds


def launch(number: int, seed: int, results: Path, scratch: Path) -> None:
    """Append a result row: what `ope` answers, what is true, and what a planned test shows."""
    began, (name, users, explore, gain) = time.perf_counter(), CELLS[number % len(CELLS)]
    world_seed, own = 3 * seed + number // len(CELLS) % 3, (seed, number)
    behavior = replace(make_arm(name, world_seed), rule=replace(DRAW, explore=explore))
    target = behavior.improve(gain, own)
    # Read anew, as a policy that has acted keeps what it made of its weights.
    model = Recommender.load(train(name, world_seed, scratch))
    bias = model.trained.policy.head.get_parameter("bias")
    bias.data.copy_(torch.from_numpy(target.scores))
    log = behavior.play(users, [*own, 3]).drop(columns="chance")
    rule = replace(DRAW, exclude_seen=not behavior.world.repeats)
    verdict = model.ope(log, rule=rule, seed=number).verdict
    before, after = (arm.value(_MEASURE, [*own, 4]) for arm in (behavior, target))
    true, lift, plan = after.mean() / before.mean() - 1, verdict.lift, verdict.test
    error = (after - (1 + true) * before).std() / before.mean() / len(before) ** 0.5
    metrics = {"gain": gain, "true": true, "error": error, "logged": verdict.logged}
    metrics["effective_users"] = verdict.effective_users
    details: dict[str, Any] = {"answer": verdict.answer, "reliable": lift.is_reliable}
    if lift.value is not None and lift.low is not None and lift.high is not None:
        metrics |= {"lift": lift.value, "low": lift.low, "high": lift.high}
    if verdict.answer == "test it" and plan is not None:
        metrics |= {"plan_users": plan.users, "plan_days": plan.days or 0.0, "plan_lift": plan.lift}
        if plan.users <= _MOST_TESTED:
            file = scratch / "test.parquet"
            details["finds"] = test((behavior, target), plan.users, [*own, 5], file)
    append_row(
        *(results, SUITE, name, "ope"),
        {measure: float(f"{value:.4g}") for measure, value in metrics.items()},
        policy="item-rate",
        log_seed=number,
        evaluation_seed=seed,
        conditions={"users": users, "exploration": explore},
        details=details,
        wall_time_s=round(time.perf_counter() - began, 1),
    )


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("--launches", type=int, default=360)
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
            launch(number, options.seed, options.results, Path(scratch))
            bar.update()
    rows = [row for row in read_rows(options.results) if row.evaluation_seed == options.seed]
    print(answers(rows))


if __name__ == "__main__":
    main()
