"""A month of daily updates on simulated users, against a policy that is never updated.

    python examples/simulated_month.py month --days 30 --sessions 1000

Every day the current run answers the sessions of the day's users, exploring a little; what it
showed and what was clicked become a log, `update` trains on from it, and `promote` makes the new
run current unless it is worse. The catalogue grows every day. Users and clicks are those of
`SyntheticCatalog`, the built-in simulator with tastes, tags and boredom.

Writes `month.json`, one entry a day, and `month.svg`, the daily reward (needs matplotlib). A month
that was interrupted begins again at its last day.
"""

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.logs.join import join_feedback
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.off_policy.estimators import cluster_intervals
from ucfrec.off_policy.score import read_logged_sessions, score_steps
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.requests import Limits, Request
from ucfrec.recommending.responder import Answer, Responder, Served
from ucfrec.runs.config import resolve_config
from ucfrec.runs.promoted import promote
from ucfrec.runs.refit import refit_within
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.update import update_run
from ucfrec_simulators.synthetic_catalog import SyntheticCatalog

START_MS = 1_704_067_200_000
"""2024-01-01, UTC."""
DAY_MS, STEP_MS = 86_400_000, 10_000
FIRST_ITEMS = 100
"""Items of the first day; the others come evenly over the month."""
EXPLORE, TEMPERATURE = 0.05, 0.5
"""Of the rules that are served, which draw at least at this temperature."""
_CANDIDATES = ("drawing at temperature 1", "exploring half of the time", "uniform")
"""Variants of the served rule that are evaluated on a day's exposures."""
_LEAST_STEPS = 50
_ESTIMATED = 200
"""Sessions of a day that candidates are evaluated on."""


@dataclass(frozen=True)
class Month:
    """How much is simulated."""

    days: int = 30
    sessions: int = 1000
    """Of a day, each of another user."""
    items: int = 200
    users: int = 2000
    policy: str = "dt"
    settings: tuple[str, ...] = (
        "train.steps=3000",
        "train.learning_rate=1e-3",
        "policy.dim=32",
        "policy.context=10",
        "policy.exposure=true",
        "rule.sessions=50",
    )
    from_scratch: tuple[int, ...] = ()
    """Days on which a training from scratch is measured beside the update."""
    seed: int = 0


@dataclass(frozen=True)
class Day:
    """What happened on a day."""

    day: int
    reward: float
    """Clicks of a session of the policy that is updated."""
    frozen: float
    """Clicks of a session of the policy of the first day."""
    items: int
    """Items in the catalogue."""
    verdict: str
    promoted: bool
    current: str
    """The run that answers the next day."""
    update_seconds: float
    """Processor time of the update."""
    validation_loss: float
    covered: tuple[bool | None, ...]
    """Whether the interval of the estimated reward per step holds the true one, for each of
    `_CANDIDATES`; None where the exposures say too little."""
    nothing_seconds: float | None = None
    nothing_loss: float | None = None


class World:
    """Users, items and what the users click."""

    def __init__(self, month: Month) -> None:
        self.month = month
        self.catalog = SyntheticCatalog(1, n_items=month.items, n_users=month.users)

    def items_on(self, day: int) -> int:
        """Number of items that there are."""
        grown = (self.month.items - FIRST_ITEMS) * day // max(self.month.days, 1)
        return min(FIRST_ITEMS + grown, self.month.items)

    def features(self, folder: Path, day: int) -> LogMapping:
        """The mapping of the day's logs, with the tags of all items of the day."""
        tags = [[f"tag {tag}"] for tag in self.catalog.tags[: self.items_on(day)]]
        frame = pd.DataFrame({"item_id": np.arange(len(tags)), "tags": tags})
        path = folder / f"items-{day:02d}.parquet"
        frame.to_parquet(path)
        return LogMapping(item_features=(FeatureTable((path,), "item_id"),))

    def sessions(self, day: int, show: "Show") -> pd.DataFrame:
        """Simulate the sessions of a day; one row a step."""
        rng = np.random.default_rng([self.month.seed, day])
        users = rng.permutation(self.month.users)[: self.month.sessions]
        catalog = self.catalog
        recent = np.full((len(users), catalog.boredom_window - 1), -1)
        live, rows = np.arange(len(users)), list[pd.DataFrame]()
        begins = START_MS + day * DAY_MS + rng.integers(DAY_MS // 2, size=len(users))
        for step in range(catalog.max_turn):
            now = begins + step * STEP_MS
            items, propensities = show(users[live], now[live], rows)
            tags = catalog.tags[items]
            chances = catalog.click_probabilities[users[live], items]
            clicks = rng.random(len(users))[live] < chances
            rows.append(
                pd.DataFrame(
                    {
                        "user_id": users[live],
                        "item_id": items,
                        "timestamp": now[live],
                        "click": clicks.astype(int),
                        "propensity": propensities,
                    },
                    index=live,
                )
            )
            bored = (recent[live] == tags[:, None]).any(axis=1)
            recent[live] = np.column_stack([recent[live], tags])[:, 1:]
            live = live[~bored]
            if not len(live):
                break
        return pd.concat(rows)


class Show:
    """Chooses the next items of sessions."""

    def __call__(
        self, users: np.ndarray, now: np.ndarray, rows: list[pd.DataFrame]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Items of the live sessions, and their propensities."""
        raise NotImplementedError


class Guess(Show):
    """The shop before any training: a rough guess of what users like, at random."""

    def __init__(self, world: World) -> None:
        rng = np.random.default_rng(9)
        logits = world.catalog.logits[:, :FIRST_ITEMS]
        guess = (logits + 2 * rng.standard_normal(logits.shape)) / 1.5
        weights = np.exp(guess - guess.max(axis=1, keepdims=True))
        self._chances = 0.7 * weights / weights.sum(axis=1, keepdims=True) + 0.3 / FIRST_ITEMS
        self._rng = np.random.default_rng(10)

    def __call__(
        self, users: np.ndarray, now: np.ndarray, rows: list[pd.DataFrame]
    ) -> tuple[np.ndarray, np.ndarray]:
        chances = self._chances[users]
        drawn = self._rng.random((len(users), 1)) * chances.sum(axis=1, keepdims=True)
        items = (chances.cumsum(axis=1) < drawn).sum(axis=1).clip(max=FIRST_ITEMS - 1)
        return items, chances[np.arange(len(users)), items]


class Serve(Show):
    """A server's answers, whose exposures are written."""

    def __init__(
        self, answers: Served | Responder, log: ExposureLog | None, clock: "Clock"
    ) -> None:
        self._answers, self._log, self._clock = answers, log, clock
        self._history: dict[int, list[Any]] = {}

    def __call__(
        self, users: np.ndarray, now: np.ndarray, rows: list[pd.DataFrame]
    ) -> tuple[np.ndarray, np.ndarray]:
        if rows:
            for user, item, at, click, _ in rows[-1].itertuples(index=False):
                row = {"item_id": int(item), "timestamp": int(at), "reward": float(click)}
                self._history.setdefault(int(user), []).append(row)
        requests = [
            Request(
                user_id=int(user),
                history=self._history.get(int(user), []),
                k=1,
                new_session=False,  # the server's clock is another one
                request_id=f"{at}-{user}",
            )
            for user, at in zip(users, now, strict=True)
        ]
        answers = []
        for outcome in self._answers.answers(requests):
            assert isinstance(outcome, Answer), outcome
            answers.append(outcome)
        if self._log is not None:
            for user, at, answer in zip(users, now, answers, strict=True):
                self._clock.ms = int(at)
                self._log.add(int(user), answer)
        items = np.array([answer.items[0] for answer in answers], dtype=np.int64)
        return items, np.array([answer.propensities[0] for answer in answers])


class Clock:
    """The simulated time."""

    ms = START_MS

    def __call__(self) -> float:
        return self.ms / 1000


def responder(run: Path, month: Month, explore: float) -> Responder:
    """What answers with a run; sessions may repeat items."""
    trained = TrainedPolicy.load(run)
    temperature = max(trained.rule.temperature, TEMPERATURE)
    rule = replace(trained.rule, explore=explore, temperature=temperature)
    return Responder(trained, Limits(), rule=rule, k=1, filter_seen=False, seed=month.seed)


def simulate(folder: Path, month: Month) -> list[Day]:
    """Simulate the month, or go on with it; returns its days, from the second on."""
    folder.mkdir(parents=True, exist_ok=True)
    world, runs = World(month), folder / "runs"
    runs.mkdir(exist_ok=True)
    first = runs / "day-00"
    if not (folder / "day-00.parquet").exists():
        world.sessions(0, Guess(world)).to_parquet(folder / "day-00.parquet")
    mapping = world.features(folder, 0)
    if not (folder / "store").exists():
        logs = [folder / "day-00.parquet"]
        prepare(logs, mapping, folder / "store", PrepareOptions(reward="click"))
    config = resolve_config(month.policy, None, month.settings, month.seed)
    train_run(EpisodeStore.open(folder / "store"), first, config)
    refit_within(EpisodeStore.open(folder / "store"), first)
    days = _done(folder)
    # A day that was interrupted begins again with the run of the day before.
    promote(runs / (days[-1].current if days else first.name), force=True)
    for day in range(len(days) + 1, month.days + 1):
        days.append(_day(folder, world, day))
        (folder / "month.json").write_text(json.dumps([asdict(each) for each in days], indent=1))
    return days


def _done(folder: Path) -> list[Day]:
    path = folder / "month.json"
    found = json.loads(path.read_text()) if path.exists() else []
    return [Day(**{**each, "covered": tuple(each["covered"])}) for each in found]


def _day(folder: Path, world: World, day: int) -> Day:
    month, clock, runs = world.month, Clock(), folder / "runs"
    shown, log = folder / f"shown-{day:02d}", folder / f"log-{day:02d}.parquet"
    with closing(Served(lambda run: responder(run, month, EXPLORE), runs, None)) as served:
        current = served.described()["name"]
        with closing(ExposureLog(shown, served.trained, clock=clock)) as exposures:
            steps = world.sessions(day, Serve(served, exposures, clock))
    frozen = world.sessions(day, Serve(responder(runs / "day-00", month, EXPLORE), None, clock))
    clicks = steps[steps.click > 0][["user_id", "item_id", "timestamp", "click"]]
    clicks.assign(timestamp=clicks.timestamp + 1000).to_parquet(
        folder / f"clicks-{day:02d}.parquet"
    )
    join_feedback([shown], [folder / f"clicks-{day:02d}.parquet"], log, 5000)
    mapping = world.features(folder, day)
    began, run = time.process_time(), runs / f"day-{day:02d}"
    # Days whose run was not promoted are new to the one that was.
    new = range(int(current.removeprefix("day-")) + 1, day + 1)
    logs = [folder / f"log-{each:02d}.parquet" for each in new]
    store = folder / f"store-{day:02d}"
    record = update_run(runs / current, logs, run, store=store, mapping=mapping)
    seconds = time.process_time() - began
    assert record.update is not None
    assert record.update.verdict is not None
    better = record.update.verdict.result != "worse"
    if better:
        promote(run)
    found = Day(
        day=day,
        reward=float(steps.click.sum() / month.sessions),
        frozen=float(frozen.click.sum() / month.sessions),
        items=world.items_on(day),
        verdict=record.update.verdict.result,
        promoted=better,
        current=run.name if better else current,
        update_seconds=seconds,
        validation_loss=record.finished.best_validation,
        covered=tuple(_covered(world, runs / current, log)),
    )
    if day not in month.from_scratch:
        return found
    began = time.process_time()
    config = resolve_config(month.policy, None, month.settings, month.seed)
    nothing = train_run(EpisodeStore.open(store), folder / f"nothing-{day:02d}", config)
    refit_within(EpisodeStore.open(store), folder / f"nothing-{day:02d}")
    return replace(
        found,
        nothing_seconds=time.process_time() - began,
        nothing_loss=nothing.finished.best_validation,
    )


def _covered(world: World, run: Path, log: Path) -> Iterator[bool | None]:
    """Whether intervals of the reward per step, from the day's exposures, hold the true values.

    Candidates are other rules of the run that was served, which was not trained on the day. None
    where the weights leave too few effective steps for an estimate.
    """
    trained = TrainedPolicy.load(run)
    drawing = replace(trained.rule, temperature=1.0)
    rules = drawing, replace(trained.rule, explore=0.5), replace(drawing, explore=1.0)
    with read_logged_sessions(trained, [log], LogMapping()) as logged:
        store = logged.store.select(np.arange(min(_ESTIMATED, logged.store.n_episodes)))
        places = store.all_steps()
        users, items = logged.users[places[0]], store.step_values("item", *places)
        clicks = store.step_values("reward", *places).astype(np.float64)
        propensity = store.step_values("propensity", *places).astype(np.float64)
        assert trained.item_ids is not None
        chances = world.catalog.click_probabilities[users.astype(np.int64)][:, trained.item_ids]
        of_users = UserRows.of(store, logged.users[: len(store)], None)
        scores = torch.cat([batch.scores for batch in score_steps(trained, store, of_users)])
        for rule in rules:
            chosen = rule.log_probabilities(scores).double().exp().numpy()
            weight = chosen[np.arange(len(items)), items] / propensity
            true = (chosen * chances).sum(axis=1).mean()
            (interval,) = cluster_intervals(
                (weight * clicks)[:, None], weight[:, None], users.astype(np.int64), 0
            )
            effective = weight.sum() ** 2 / (weight**2).sum()
            if interval is None or effective < _LEAST_STEPS:
                yield None
            else:
                yield bool(interval.low <= true <= interval.high)


def plot(days: list[Day], path: Path) -> None:
    """Draw the daily reward of both policies."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([each.day for each in days], [each.reward for each in days], label="updated daily")
    axes.plot([each.day for each in days], [each.frozen for each in days], label="never updated")
    axes.set(xlabel="day", ylabel="clicks per session", ylim=(0, None))
    axes.legend()
    figure.savefig(path, metadata={"Date": None})


def summary(days: list[Day]) -> str:
    """What the month shows."""
    last = days[-7:]
    reward, frozen = (np.mean([getattr(d, name) for d in last]) for name in ("reward", "frozen"))
    lines = [
        f"last {len(last)} days: {reward:.3f} clicks per session, never updated {frozen:.3f} "
        f"({reward / frozen - 1:+.1%})",
        f"first day: {days[0].reward:.3f} and {days[0].frozen:.3f}",
        f"promoted: {sum(each.promoted for each in days)} of {len(days)} updates",
        "days on which the estimate of a candidate covers its true value:",
    ]
    for name, found in zip(
        _CANDIDATES, zip(*(each.covered for each in days), strict=True), strict=True
    ):
        known = [each for each in found if each is not None]
        too_little = f"; {len(days) - len(known)} days say too little" * (len(known) < len(days))
        lines.append(f"  {name}: {np.mean(known):.1%} of {len(known)}{too_little}")
    lines += [_against_nothing(each) for each in days if each.nothing_seconds is not None]
    return "\n".join(lines)


def _against_nothing(day: Day) -> str:
    assert day.nothing_seconds is not None
    assert day.nothing_loss is not None
    return (
        f"day {day.day}: update {day.update_seconds:.0f} s of processor time, from scratch "
        f"{day.nothing_seconds:.0f} s ({day.update_seconds / day.nothing_seconds:.0%}); validation "
        f"loss {day.validation_loss:.4f} and {day.nothing_loss:.4f} "
        f"({day.validation_loss / day.nothing_loss - 1:+.1%})"
    )


def main() -> None:
    """Simulate a month and say what it shows."""
    parser = argparse.ArgumentParser(description="Simulate a month of daily updates.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--users", type=int, default=2000)
    parser.add_argument("--from-scratch", type=int, nargs="*", default=[], metavar="DAY")
    options = parser.parse_args()
    nothing = tuple(options.from_scratch)
    month = Month(options.days, options.sessions, users=options.users, from_scratch=nothing)
    days = simulate(options.out, month)
    plot(days, options.out / "month.svg")
    print(summary(days))


if __name__ == "__main__":
    main()
