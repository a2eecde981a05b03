"""Session ends: what the log says of them, and what a model of them finds."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ucfrec.episodes.exposure import Likeness, Shown
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.user_model.session_end import (
    BoostedTrees,
    LoggedEnds,
    SessionEnd,
    fit_trees,
    whole_sessions,
)

ITEMS = 12


def planted_ends(rows: int = 6000) -> tuple[Likeness, LoggedEnds]:
    """Sessions that end with a step, mostly if its item repeats the one before."""
    rng = np.random.default_rng(0)
    shown, items = rng.integers(-1, ITEMS, (rows, 4)), rng.integers(ITEMS, size=rows)
    repeats = rng.random(rows) < 0.3
    items = np.where(repeats & (shown[:, 0] >= 0), shown[:, 0], items)
    again = items == shown[:, 0]
    states = ItemStates(torch.eye(ITEMS), torch.zeros(0, 0), 0.0, 1.0)
    before = Shown(torch.from_numpy(shown), torch.zeros(rows, 4))
    steps = rng.integers(8, size=rows)
    ended = rng.random(rows) < np.where(again, 0.8, 0.1)
    rewards = rng.random(rows).round()
    followed = np.ones(rows, dtype=bool)
    return Likeness.of(states), LoggedEnds(
        before, torch.from_numpy(items), rewards, steps, ended, followed
    )


def part_of(logged: LoggedEnds, rows: slice) -> LoggedEnds:
    """Some of the steps."""
    chosen = np.zeros(len(logged.ended), dtype=bool)
    chosen[rows] = True
    return logged.select(chosen)


@pytest.mark.parametrize("last", [4000, 4010])
def test_that_repetition_ends_sessions_is_found_if_there_are_steps_to_show_it(last: int) -> None:
    likeness, logged = planted_ends()
    held_out = part_of(logged, slice(4000, last + 2000 * (last == 4000)))
    end, report = SessionEnd.fit(likeness, part_of(logged, slice(4000)), held_out, 0)
    again = (logged.items == logged.history.items[:, 0]).numpy()
    found = end.probabilities(logged.history, logged.items, logged.rewards, logged.steps)
    if last == 4000:
        assert report.kept in ("logistic", "boosted")
        assert report.loss[report.kept] < report.loss["constant"] - 0.1
        assert found[again].mean() == pytest.approx(0.8, abs=0.05)
        assert found[~again].mean() == pytest.approx(0.1, abs=0.03)
    for kind, (gain, error) in report.gain.items():
        assert (gain > error) or kind != report.kept or kind == "constant"


def test_steps_later_than_logged_ones_are_like_the_last() -> None:
    """The log has eight steps; sessions end the likelier, the later."""
    likeness, logged = planted_ends()
    ended = np.random.default_rng(1).random(len(logged.steps)) < 0.05 * (1 + logged.steps)
    parts = [
        part_of(replace(logged, ended=ended), rows) for rows in (slice(4000), slice(4000, 6000))
    ]
    end, report = SessionEnd.fit(likeness, *parts, 0)
    assert report.kept == "logistic"

    def at(step: int) -> float:
        steps = np.full(len(logged.steps), step)
        return float(end.probabilities(logged.history, logged.items, logged.rewards, steps).mean())

    assert at(7) == pytest.approx(0.4, abs=0.05)
    assert at(7) > at(6)
    assert at(7) == at(8) == at(100)


def test_what_a_regression_cannot_say_is_boosted_saved_and_read() -> None:
    """Sessions end with the second of two alike items, but not with the third."""
    likeness, logged = planted_ends()
    items, shown = logged.items, logged.history.items
    ended = ((items == shown[:, 0]) != (items == shown[:, 1])).numpy()
    parts = [
        part_of(replace(logged, ended=ended), rows) for rows in (slice(4000), slice(4000, 6000))
    ]
    end, report = SessionEnd.fit(likeness, *parts, 0)
    assert report.kept == "boosted"
    assert report.loss["boosted"] < 0.1 * report.loss["logistic"]
    inputs = logged.history, items, logged.rewards, logged.steps
    again = SessionEnd.of(likeness, {**end.tensors})
    np.testing.assert_array_equal(again.probabilities(*inputs), end.probabilities(*inputs))
    with pytest.raises(ValueError, match="beyond the last input"):
        SessionEnd.of(likeness, {**end.tensors, "inputs": end.tensors["inputs"] + 16})
    for name, tensor in end.tensors.items():
        with pytest.raises(ValueError, match=r"inputs|float64"):
            SessionEnd.of(likeness, {**end.tensors, name: tensor.float()})
    with pytest.raises(ValueError, match="leaves"):
        SessionEnd.of(likeness, {**end.tensors, "leaves": end.tensors["leaves"][:, 1:]})


def test_a_regression_of_other_inputs_is_refused() -> None:
    likeness, logged = planted_ends(400)
    end, report = SessionEnd.fit(likeness, logged, part_of(logged, slice(0)), 0)
    assert report.kept == "constant"
    again = SessionEnd.of(likeness, {**end.tensors})
    assert again.tensors["bias"] == end.tensors["bias"]
    for name, tensor in end.tensors.items():
        with pytest.raises(ValueError, match=f"{name} does not fit"):
            SessionEnd.of(likeness, {**end.tensors, name: tensor.repeat(2)})


def test_all_items_at_once_end_sessions_as_each_alone() -> None:
    likeness, logged = planted_ends(400)
    end, _ = SessionEnd.fit(likeness, logged, logged, 0)
    steps, rewards = torch.from_numpy(logged.steps), torch.from_numpy(logged.rewards)
    every = torch.arange(ITEMS).expand(400, -1)
    rewards = rewards.unsqueeze(1).expand(-1, ITEMS)
    (together,) = end.score_items(logged.history, every, [rewards], steps)
    two = end.score_items(logged.history, every, [torch.zeros_like(rewards), rewards], steps)
    assert torch.equal(two[1], together)
    for item in range(ITEMS):
        alone = end.probabilities(
            *(logged.history, torch.full((400,), item), logged.rewards, logged.steps)
        )
        np.testing.assert_allclose(together[:, item].numpy(), alone, atol=1e-6)


def test_sessions_that_all_end_or_never_do_are_a_constant() -> None:
    likeness, logged = planted_ends(50)
    for ends in (False, True):
        given = replace(logged, ended=np.full(50, ends))
        end, report = SessionEnd.fit(likeness, given, given, 0)
        found = end.probabilities(logged.history, logged.items, logged.rewards, logged.steps)
        assert found.tolist() == [float(ends)] * 50
        assert (report.kept, report.loss) == ("constant", {"constant": 0.0})


def test_only_the_last_step_of_a_cut_session_tells_nothing() -> None:
    columns = {"item": np.zeros(9, dtype=np.int64), "reward": np.arange(9, dtype=np.float32)}
    states = ItemStates(torch.eye(2), torch.zeros(2, 0), 0.0, 1.0)
    episodes = {"user": np.array([0, 0, 1, 1]), "terminated": np.array([True, True, False, True])}
    lengths = np.array([2, 3, 2, 2])
    store = EpisodeStore.from_arrays(columns, lengths, episodes, states)
    logged = LoggedEnds.of(store, 2, 100, 0)
    # Excluded: step 6, of the session that is not terminated.
    assert logged.rewards.tolist() == [0, 1, 2, 3, 4, 5, 7, 8]
    assert logged.ended.tolist() == [False, True, False, False, True, False, False, True]


@pytest.mark.parametrize("sessions", [1, 3])
def test_the_share_of_steps_that_end_sessions_is_the_logged_one(sessions: int) -> None:
    """However few sessions a user has: the last one of each ends like any other."""
    generator = np.random.default_rng(0)
    lengths = generator.geometric(0.4, 6000)
    n = int(lengths.sum())
    columns = {"item": generator.integers(2, size=n), "reward": np.zeros(n, dtype=np.float32)}
    states = ItemStates(torch.eye(2), torch.zeros(2, 0), 0.0, 1.0)
    episodes = {"user": np.arange(6000) // sessions, "terminated": np.ones(6000, dtype=bool)}
    store = EpisodeStore.from_arrays(columns, lengths, episodes, states)
    logged = LoggedEnds.of(store, 2, n, 0)
    end, _ = SessionEnd.fit(Likeness.of(states), logged, logged, 0)
    found = end.probabilities(logged.history, logged.items, logged.rewards, logged.steps)
    assert found.mean() == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize("cut", [0, 6, 9])
def test_training_sessions_are_held_out_where_the_split_cut_those_of_validation(cut: int) -> None:
    states = ItemStates(torch.eye(2), torch.zeros(0, 0), 0.0, 1.0)
    columns = {"item": np.zeros(30, dtype=np.int64), "reward": np.zeros(30, dtype=np.float32)}
    # Two training sessions of ten users each, then a validation session, which may go on.
    users = np.repeat(np.arange(10), 3)
    split = np.tile([0, 0, 1], 10)
    terminated = ~((np.arange(30) % 3 == 1) & (users < cut))
    episodes = {"user": users, "split": split.astype(np.uint8), "terminated": terminated}
    store = EpisodeStore.from_arrays(columns, np.ones(30, dtype=np.int64), episodes, states)
    fitted, held_out = whole_sessions(store.split("train"), store.split("validation"))
    if cut:
        assert set(held_out.episode_values("user")) == {4, 9}
        assert set(held_out.episode_values("split")) == {0}
        assert fitted.n_episodes == 16
    else:
        assert (fitted.n_episodes, held_out.n_episodes) == (20, 10)


@pytest.mark.parametrize("cut", [False, True])
def test_ends_of_the_rows_of_users_are_no_ends_of_sessions(cut: bool) -> None:
    """Sessions end with an item that repeats the one before; rows of users `cut` anywhere."""
    generator = np.random.default_rng(0)
    items, lengths, users = list[int](), list[int](), list[int]()
    for user in range(600):
        rows = int(generator.integers(1, 12)) if cut else 10_000
        for _ in range(3):
            session = [int(generator.integers(6))]
            while len(session) < rows and session[-1:] != session[-2:-1]:
                session.append(int(generator.integers(6)))
            rows -= len(session)
            items, lengths, users = items + session, [*lengths, len(session)], [*users, user]
            if rows <= 0:
                break
    columns = {"item": np.array(items), "reward": np.zeros(len(items), dtype=np.float32)}
    states = ItemStates(torch.eye(6), torch.zeros(0, 0), 0.0, 1.0)
    episodes = {"user": np.array(users), "terminated": np.ones(len(users), dtype=bool)}
    store = EpisodeStore.from_arrays(columns, np.array(lengths), episodes, states)
    halves = [store.select(np.flatnonzero(np.array(users) % 2 == half)) for half in (0, 1)]
    logged, held_out = (LoggedEnds.of(half, 4, len(items), 0) for half in halves)
    end, report = SessionEnd.fit(Likeness.of(states), logged, held_out, 0)
    again = (held_out.items == held_out.history.items[:, 0]).numpy()
    given = held_out.history, held_out.items, held_out.rewards, held_out.steps
    found = end.probabilities(*given)
    assert report.last_sessions is not cut
    assert found[again].mean() > 0.9
    assert found[~again].mean() < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_drawn_ends_are_a_sample_of_all(seed: int) -> None:
    generator = np.random.default_rng(seed)
    lengths = generator.integers(1, 4, 60)
    n = int(lengths.sum())
    columns = {"item": np.zeros(n, dtype=np.int64), "reward": np.arange(n, dtype=np.float32)}
    states = ItemStates(torch.eye(2), torch.zeros(2, 0), 0.0, 1.0)
    episodes = {
        "user": np.sort(generator.integers(9, size=60)),
        "terminated": generator.random(60) < 0.5,
    }
    store = EpisodeStore.from_arrays(columns, lengths, episodes, states)
    known = LoggedEnds.of(store, 2, n, seed)
    drawn = LoggedEnds.of(store, 2, 20, seed)
    chosen = np.sort(np.random.default_rng(seed).choice(len(known.rewards), 20, replace=False))
    for name in ("rewards", "steps", "ended"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(known, name)[chosen])
    episode = np.searchsorted(np.cumsum(lengths), known.rewards, side="right")
    np.testing.assert_array_equal(known.ended, known.steps == lengths[episode] - 1)


def test_another_value_of_one_input_is_as_if_it_were_there() -> None:
    rng = np.random.default_rng(0)
    inputs = rng.integers(4, size=(2000, 3)).astype(np.float64)
    trees = BoostedTrees(**fit_trees(inputs, (inputs.sum(1) + rng.normal(size=2000)) > 5, 0))
    given, other = torch.from_numpy(inputs), torch.from_numpy(rng.integers(4, size=2000))
    for number in range(3):
        changed = given.clone()
        changed[:, number] = other
        odds = trees.replace_input(given, number, [other, given[:, number]])
        assert torch.equal(odds[0], trees(changed))
        assert torch.equal(odds[1], trees(given))
        assert not torch.equal(*odds)
