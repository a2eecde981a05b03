"""Session ends: what the log says of them, and what a model of them finds."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.user_model.session_end import LoggedEnds, SessionEnd, describe_steps, whole_sessions

ITEMS = 12
LIKENESS = Likeness.of(ItemStates(torch.eye(ITEMS), torch.zeros(0, 0), 0.0, 1.0))


class Steps(NamedTuple):
    """Steps of sessions."""

    history: Shown
    items: Tensor
    rewards: Float64Array
    steps: IntArray

    @property
    def again(self) -> BoolArray:
        """Whether the item repeats the one before."""
        return (self.items == self.history.items[:, 0]).numpy()

    def logged(self, ended: BoolArray, rows: slice = slice(None)) -> LoggedEnds:
        """Some of the steps, that ended sessions."""
        inputs, followed = describe_steps(LIKENESS, *self)[rows], np.ones(len(ended), dtype=bool)
        return LoggedEnds(inputs, ended[rows], followed[rows])

    def fit(self, ended: BoolArray) -> tuple[SessionEnd, Any]:
        """From two thirds of the steps; the rest is held out."""
        cut = 2 * len(ended) // 3
        training, held_out = self.logged(ended, slice(cut)), self.logged(ended, slice(cut, None))
        return SessionEnd.fit(LIKENESS, training, held_out, 0)


def planted_steps(rows: int = 6000) -> tuple[Steps, BoolArray]:
    """Steps of sessions that end with one, mostly if its item repeats the one before."""
    rng = np.random.default_rng(0)
    shown, items = rng.integers(-1, ITEMS, (rows, 4)), rng.integers(ITEMS, size=rows)
    repeats = rng.random(rows) < 0.3
    items = np.where(repeats & (shown[:, 0] >= 0), shown[:, 0], items)
    steps = rng.integers(8, size=rows)
    ended = rng.random(rows) < np.where(items == shown[:, 0], 0.8, 0.1)
    history = Shown(torch.from_numpy(shown), torch.zeros(rows, 4))
    return Steps(history, torch.from_numpy(items), rng.random(rows).round(), steps), ended


def test_that_repetition_ends_sessions_is_found() -> None:
    steps, ended = planted_steps()
    end, report = steps.fit(ended)
    found = end.probabilities(*steps)
    assert report.kept in ("logistic", "boosted")
    assert report.loss[report.kept] < report.loss["constant"] - 0.1
    assert found[steps.again].mean() == pytest.approx(0.8, abs=0.05)
    assert found[~steps.again].mean() == pytest.approx(0.1, abs=0.03)


def test_steps_later_than_logged_ones_are_like_the_last() -> None:
    """The log has eight steps; sessions end the likelier, the later."""
    steps, _ = planted_steps()
    ended = np.random.default_rng(1).random(len(steps.steps)) < 0.05 * (1 + steps.steps)
    end, report = steps.fit(ended)
    assert report.kept == "logistic"
    found = [
        float(end.probabilities(*steps._replace(steps=np.full(len(steps.steps), step))).mean())
        for step in (6, 7, 8, 100)
    ]
    assert found[1] == pytest.approx(0.4, abs=0.05)
    assert found[0] < found[1] == found[2] == found[3]


def test_what_a_regression_cannot_say_is_boosted_saved_and_read() -> None:
    """Sessions end with the second of two alike items, but not with the third."""
    steps, _ = planted_steps()
    shown = steps.history.items
    end, report = steps.fit(((steps.items == shown[:, 0]) != (steps.items == shown[:, 1])).numpy())
    assert report.kept == "boosted"
    assert report.loss["boosted"] < 0.1 * report.loss["logistic"]
    again = SessionEnd.of(LIKENESS, {**end.tensors})
    np.testing.assert_array_equal(again.probabilities(*steps), end.probabilities(*steps))
    refused = {
        "beyond the last input": {"inputs": end.tensors["inputs"] + 16},
        "leaves": {"leaves": end.tensors["leaves"][:, 1:]},
        **{rf"{name}.*|float64": {name: end.tensors[name].float()} for name in end.tensors},
    }
    for message, other in refused.items():
        with pytest.raises(ValueError, match=message):
            SessionEnd.of(LIKENESS, {**end.tensors, **other})


def test_a_regression_of_other_inputs_is_refused() -> None:
    steps, ended = planted_steps(400)
    end, report = SessionEnd.fit(LIKENESS, steps.logged(ended), steps.logged(ended, slice(0)), 0)
    assert report.kept == "constant"
    again = SessionEnd.of(LIKENESS, {**end.tensors})
    assert again.tensors["bias"] == end.tensors["bias"]
    for name, tensor in end.tensors.items():
        with pytest.raises(ValueError, match=f"{name} does not fit"):
            SessionEnd.of(LIKENESS, {**end.tensors, name: tensor.repeat(2)})


def test_all_items_at_once_end_sessions_as_each_alone() -> None:
    steps, ended = planted_steps(400)
    end, _ = SessionEnd.fit(LIKENESS, steps.logged(ended), steps.logged(ended), 0)
    numbers, every = torch.from_numpy(steps.steps), torch.arange(ITEMS).expand(400, -1)
    rewards = torch.from_numpy(steps.rewards).unsqueeze(1).expand(-1, ITEMS)
    (together,) = end.score_items(steps.history, every, [rewards], numbers)
    two = end.score_items(steps.history, every, [torch.zeros_like(rewards), rewards], numbers)
    assert torch.equal(two[1], together)
    for item in range(ITEMS):
        alone = end.probabilities(*steps._replace(items=torch.full((400,), item)))
        np.testing.assert_allclose(together[:, item].numpy(), alone, atol=1e-6)


@pytest.mark.parametrize("ends", [False, True])
def test_sessions_that_all_end_or_never_do_are_a_constant(ends: bool) -> None:
    steps, _ = planted_steps(50)
    logged = steps.logged(np.full(50, ends))
    end, report = SessionEnd.fit(LIKENESS, logged, logged, 0)
    assert end.probabilities(*steps).tolist() == [float(ends)] * 50
    assert (report.kept, report.loss) == ("constant", {"constant": 0.0})


def store_of(
    items: Sequence[int] | IntArray, lengths: Sequence[int] | IntArray, **episodes: Any
) -> EpisodeStore:
    """A store of items whose rewards are the numbers of the rows."""
    columns = {"item": np.array(items), "reward": np.arange(len(items), dtype=np.float32)}
    arrays = {name: np.array(values) for name, values in episodes.items()}
    states = ItemStates(torch.eye(ITEMS), torch.zeros(9, 0), 0.0, 1.0)
    return EpisodeStore.from_arrays(columns, np.array(lengths), arrays, states)


def ends_of(store: EpisodeStore, most: int, seed: int = 0) -> tuple[LoggedEnds, Float64Array]:
    """Logged ends, and the rewards of their steps, which are one of their inputs."""
    logged = LoggedEnds.of(store, LIKENESS, 4, most, seed)
    return logged, logged.inputs[:, 3].numpy()


@pytest.mark.parametrize("sessions", [1, 3])
def test_the_share_of_steps_that_end_sessions_is_the_logged_one(sessions: int) -> None:
    """However few sessions a user has: the last one of each ends like any other."""
    generator = np.random.default_rng(0)
    lengths = generator.geometric(0.4, 6000)
    items = generator.integers(2, size=int(lengths.sum()))
    ends = {"user": np.arange(6000) // sessions, "terminated": np.ones(6000, dtype=bool)}
    logged, _ = ends_of(store_of(items, lengths, **ends), len(items))
    end, _ = SessionEnd.fit(LIKENESS, logged, logged, 0)
    found = torch.sigmoid(end._log_odds(logged.inputs))
    assert float(found.mean()) == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize("cut", [0, 6, 9])
def test_training_sessions_are_held_out_where_the_split_cut_those_of_validation(cut: int) -> None:
    # Two training sessions of ten users each, then a validation session, which may go on.
    users, split = np.repeat(np.arange(10), 3), np.tile([0, 0, 1], 10).astype(np.uint8)
    terminated = ~((np.arange(30) % 3 == 1) & (users < cut))
    store = store_of([0] * 30, [1] * 30, user=users, split=split, terminated=terminated)
    fitted, held_out = whole_sessions(store.split("train"), store.split("validation"))
    assert (fitted.n_episodes, held_out.n_episodes) == ((16, 4) if cut else (20, 10))
    if cut:
        assert set(held_out.episode_values("user")) == {4, 9}
        assert set(held_out.episode_values("split")) == {0}


@pytest.mark.parametrize("cut", [False, True])
def test_ends_of_the_rows_of_users_are_no_ends_of_sessions(cut: bool) -> None:
    """Sessions end with an item that repeats the one before; rows of users `cut` anywhere."""
    generator = np.random.default_rng(0)
    items, lengths, users, again = list[int](), list[int](), list[int](), list[bool]()
    for user in range(600):
        rows = int(generator.integers(1, 12)) if cut else 10_000
        for _ in range(3):
            session = [int(generator.integers(6))]
            while len(session) < rows and session[-1:] != session[-2:-1]:
                session.append(int(generator.integers(6)))
            rows -= len(session)
            items, lengths, users = items + session, [*lengths, len(session)], [*users, user]
            if user % 2:
                again += [False, *(a == b for a, b in zip(session[1:], session, strict=False))]
            if rows <= 0:
                break
    store = store_of(items, lengths, user=users, terminated=[True] * len(users))
    halves = [store.select(np.flatnonzero(np.array(users) % 2 == half)) for half in (0, 1)]
    logged, held_out = (ends_of(half, len(items))[0] for half in halves)
    end, report = SessionEnd.fit(LIKENESS, logged, held_out, 0)
    found = torch.sigmoid(end._log_odds(held_out.inputs)).numpy()
    assert report.last_sessions is not cut
    assert found[again].mean() > 0.9
    assert found[~np.array(again)].mean() < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_drawn_ends_are_a_sample_of_all(seed: int) -> None:
    generator = np.random.default_rng(seed)
    lengths = generator.integers(1, 4, 60)
    users, terminated = np.sort(generator.integers(9, size=60)), generator.random(60) < 0.5
    n = int(lengths.sum())
    store = store_of([0] * n, lengths, user=users, terminated=terminated)
    cut = np.cumsum(lengths)[~terminated] - 1
    (known, rewards), (drawn, _) = ends_of(store, n, seed), ends_of(store, 20, seed)
    chosen = np.sort(np.random.default_rng(seed).choice(len(rewards), 20, replace=False))
    assert torch.equal(drawn.inputs, known.inputs[torch.from_numpy(chosen)])
    np.testing.assert_array_equal(drawn.ended, known.ended[chosen])
    # The last step of a session that is cut tells nothing.
    assert rewards.tolist() == np.delete(np.arange(n), cut).tolist()
    np.testing.assert_array_equal(known.ended, np.isin(rewards, np.cumsum(lengths) - 1))
