"""The reward model of items: what its scores depend on, and what they equal."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.exposure import Shown
from ucfrec.user_model.reward import ItemRewardModel

ITEMS, USERS, STATE, DIM = 30, 5, 6, 4


def planted(tags: bool, binary: bool = True) -> ItemRewardModel:
    """A model with random effects."""
    sizes = {"state": STATE, "action": DIM, "items": ITEMS, "users": USERS, "tags": 2 * tags}
    model = ItemRewardModel(sizes)
    random = torch.Generator().manual_seed(0)
    for name, buffer in model.named_buffers():
        if buffer.is_floating_point() and buffer.ndim and name != "state_std":
            buffer.copy_(torch.randn(buffer.shape, generator=random))
    if tags:
        model.likeness.tags.copy_(torch.randint(-1, 4, (ITEMS, 2), generator=random))
        model.likeness.n_tags.fill_(4)
    else:
        model.likeness.directions.copy_(F.normalize(model.likeness.directions, dim=1))
    model.binary.fill_(binary)
    model.reward_low.fill_(-1.0)
    model.reward_high.fill_(2.0)
    return model


def asked(rows: int, lags: int) -> tuple[Tensor, Shown, Tensor]:
    """Random states, items shown before and users."""
    random = torch.Generator().manual_seed(1)
    states = torch.randn(rows, STATE, generator=random)
    items = torch.randint(-1, ITEMS, (rows, lags), generator=random)
    rewards = 3 * torch.rand(rows, lags, generator=random) - 1
    shown = Shown(items, rewards.masked_fill(items < 0, 0.0))
    return states, shown, torch.randint(-1, USERS + 2, (rows,), generator=random)


def score_by_hand(model: ItemRewardModel, state: Tensor, shown: Shown, user: int, i: int) -> float:
    """The sum of the model's definition, term by term."""
    x = ((state - model.state_mean) / model.state_std).clamp(-5, 5)
    row = user if 0 <= user < USERS else USERS
    query = model.affinity[row] + x @ model.interaction
    total = model.item[i] + model.user[row] + x @ model.state + query @ model.vectors[i]
    likeness = model.likeness
    for lag, j in enumerate(shown.items.tolist()[: model.lags]):
        if j < 0:
            continue
        if likeness.tags.shape[1]:
            mine, other = likeness.tags[i].tolist(), likeness.tags[j].tolist()
            alike = sum(mine.count(tag) * other.count(tag) for tag in set(mine) if tag >= 0)
        else:
            alike = float(likeness.directions[i] @ likeness.directions[j])
        liked = (float(shown.rewards[lag]) - -1) / 3
        repeated, like, repeated_liked, like_liked = model.exposure[:, lag]
        total = total + (repeated + repeated_liked * liked) * (i == j)
        total = total + (like + like_liked * liked) * alike
    return float(total)


@pytest.mark.parametrize("tags", [True, False])
def test_scores_are_the_sum_of_the_effects(tags: bool) -> None:
    model = planted(tags)
    states, shown, users = asked(7, model.lags)
    scores = model.scores(states, shown, users)
    assert scores.shape == (7, ITEMS)
    for row in range(7):
        for item in range(0, ITEMS, 7):
            expected = score_by_hand(model, states[row], shown.at(row), int(users[row]), item)
            assert float(scores[row, item]) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("tags", [True, False])
def test_one_item_scores_as_among_all(tags: bool) -> None:
    model = planted(tags)
    states, shown, users = asked(9, model.lags)
    items = torch.arange(9) * 3
    among_all = model.scores(states, shown, users)[torch.arange(9), items]
    torch.testing.assert_close(model.score(states, shown, users, items), among_all)


def test_missing_lags_are_steps_before_the_session_and_unknown_users_are_alike() -> None:
    model = planted(tags=True)
    states, shown, _ = asked(4, model.lags + 3)
    few = Shown(shown.items[:, :4], shown.rewards[:, :4])
    padded = Shown(
        F.pad(few.items, (0, model.lags - 4), value=-1), F.pad(few.rewards, (0, model.lags - 4))
    )
    most = Shown(shown.items[:, : model.lags], shown.rewards[:, : model.lags])
    assert torch.equal(model.scores(states, few), model.scores(states, padded))
    torch.testing.assert_close(model.scores(states, shown), model.scores(states, most))
    for unknown in (-1, USERS, USERS + 9):
        users = torch.full((4,), unknown)
        assert torch.equal(model.scores(states, few, users), model.scores(states, few))


def test_level_is_what_all_items_share() -> None:
    model = planted(tags=True)
    states, shown, users = asked(5, model.lags)
    model.interaction.zero_()
    model.affinity.zero_()
    model.exposure.zero_()
    rest = model.scores(states, shown, users) - model.level(
        states, users, model.tastes_after(shown)
    ).unsqueeze(1)
    torch.testing.assert_close(rest, model.item.expand(5, -1), atol=1e-5, rtol=0)


def test_expected_rewards_are_in_reward_units() -> None:
    model = planted(tags=False)
    scores = torch.tensor([-50.0, 0.0, 50.0])
    torch.testing.assert_close(model.expected(scores), torch.tensor([-1.0, 0.5, 2.0]))
    model.binary.fill_(False)
    model.reward_mean.fill_(3.0)
    model.reward_std.fill_(2.0)
    torch.testing.assert_close(model.expected(scores), torch.tensor([-97.0, 3.0, 103.0]))
