"""Exposure, advantage weights and the largest return, in every policy; without them, nothing."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from tests.policies.test_ucf import (
    CATALOG,
    ITEMS,
    SMALL,
    VECTORS,
    K,
    other,
    random_windows,
    sessions_of,
    trained,
)
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed
from ucfrec.errors import InputError
from ucfrec.fitting.loop import RowAdamW
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead, advantage_weights
from ucfrec.policies.registry import policy_class

TAGGED = {**CATALOG, "tags": 2}
POLICIES = ("ucf", "dt", "dc", "lsdt", "dt4rec", "cdt4rec", "edt4rec", "sasrec")
ADDITIONS = {"advantage_weights": True, "max_return": True}
policies = pytest.mark.parametrize("name", POLICIES)
kinds = pytest.mark.parametrize("sizes", [VECTORS, TAGGED], ids=["vectors", "items"])


def build(name: str, sizes: dict[str, int], **settings: Any) -> SequencePolicy:
    torch.manual_seed(0)
    policy_type = policy_class(name)
    small = {**SMALL, "dropout": 0.0, **({"kernel_groups": 4} if name == "lsdt" else {})}
    policy = policy_type(policy_type.Config(**{**small, "exposure": False, **settings}), sizes)
    if sizes["items"]:
        generator = torch.Generator().manual_seed(4)
        embeddings = torch.randn(ITEMS, 4, generator=generator)
        policy.head.start_from(embeddings, torch.rand(ITEMS, generator=generator))
        if policy.head.exposure is not None:  # type: ignore[union-attr]
            tags = torch.randint(-1, 4, (ITEMS, 2), generator=generator)
            states = ItemStates(embeddings, torch.zeros(0, 0), 0.0, 1.0, tags=tags)
            policy.head.exposure.start_from(states, torch.rand(99))  # type: ignore[union-attr]
    return policy


@kinds
@policies
def test_every_learner_trains_and_acts_with_the_additions(name: str, sizes: dict[str, int]) -> None:
    more = {"exposure": True, "exposure_window": 3} if sizes["items"] else {}
    policy, windows = build(name, sizes, **ADDITIONS, **more), random_windows(sizes)
    policy.eval()
    before = policy.loss(windows)[1]
    trained(policy, windows, 25)
    loss, scalars = policy.loss(windows)
    assert torch.isfinite(loss)
    assert {"action_loss", "value_loss"} <= scalars.keys()
    assert scalars["value_loss"] < before["value_loss"]
    assert torch.isfinite(policy.action_loss(windows))
    sessions = sessions_of(windows)
    for rule in (DecisionRule(None), DecisionRule(2.0)):
        assert torch.isfinite(Scorer(policy, rule).act(sessions)).all()
    if sizes["items"]:
        term = policy.head.exposure  # type: ignore[union-attr]
        moved = torch.cat([parameter.flatten() for parameter in term.parameters()])
        assert (moved != 0).any(), "the exposure term learns too"


@pytest.mark.parametrize("name", [*POLICIES, "bc"])
def test_every_learner_learns_from_sampled_items(name: str) -> None:
    settings = {"sampled_above": ITEMS - 1, "sampled_items": 4, **ADDITIONS, "exposure": True}
    policy, windows = build(name, TAGGED, **settings), random_windows(TAGGED)
    everything = build(name, TAGGED, **{**settings, "sampled_above": ITEMS})
    assert isinstance(policy.head, ItemHead)
    with torch.no_grad():
        expected = everything.eval().action_loss(windows)
        torch.testing.assert_close(policy.eval().action_loss(windows), expected)
    optimizer = RowAdamW(policy.parameters(), lr=1e-2)
    policy.train()
    for step in range(20):
        torch.manual_seed(step)
        optimizer.zero_grad()
        policy.loss(windows)[0].backward()  # type: ignore[no-untyped-call]
        assert policy.head.correction.grad is not None
        assert policy.head.correction.grad.is_sparse
        optimizer.step()
    with torch.no_grad():
        assert policy.eval().action_loss(windows) < expected - 0.05


@policies
def test_exposure_moves_predictions_by_what_was_shown_alone(name: str) -> None:
    """Prediction t with the term is prediction t without it plus what `Exposed.before` says."""
    windows = random_windows(TAGGED)
    policy = trained(build(name, TAGGED, exposure=True, exposure_window=3), windows, 25)
    head = policy.head
    assert isinstance(head, ItemHead)
    assert head.exposure is not None
    for parameter in head.exposure.parameters():
        parameter.data += 0.1
    normalized = policy.normalize(windows)
    with torch.no_grad():
        plain = head.predict(policy.features(normalized)[:, -1])
        last = torch.arange(1, len(plain) + 1) * K - 1
        term = Exposed.before(normalized, 3, last)
        added = head.exposure.added_to(torch.zeros(len(last), ITEMS), term)
        torch.testing.assert_close(policy.act(windows), plain + added)
        own = windows.actions.clone()
        own[:, -1] = other(own[:, -1])
        earned = windows.rewards.clone()
        earned[:, -1] += 1
        torch.testing.assert_close(
            policy.act(replace(windows, actions=own, rewards=earned)), policy.act(windows)
        )
        noisy = torch.where(windows.mask, windows.actions, other(windows.actions))
        torch.testing.assert_close(policy.act(replace(windows, actions=noisy)), policy.act(windows))


@kinds
def test_the_loss_is_weighted_by_the_advantage(sizes: dict[str, int]) -> None:
    policy, windows = build("dt", sizes, **ADDITIONS).eval(), random_windows(sizes)
    normalized = policy.normalize(windows)
    assert policy.values is not None
    mask = windows.mask
    values = policy.values(normalized, policy.head.embed(windows.actions))[mask]
    returns = normalized.returns_to_go[mask]
    weights = advantage_weights(values, returns)
    assert weights.max() > 1.2 * weights.min()
    losses = policy.head.losses(policy.features(normalized)[mask], windows.actions[mask])
    expected = (weights * losses).sum() / mask.sum()
    value_loss = policy.values.loss(values, returns)
    loss, scalars = policy.loss(windows)
    torch.testing.assert_close(scalars["action_loss"], expected)
    torch.testing.assert_close(scalars["value_loss"], value_loss)
    torch.testing.assert_close(loss, expected + value_loss)
    # With values but without weights, steps count alike.
    alike = build("dt", sizes, max_return=True).eval()
    alike.load_state_dict(policy.state_dict())
    torch.testing.assert_close(alike.loss(windows)[1]["action_loss"], losses.mean())
    # The weights do not teach the values to please the loss.
    gradient = torch.autograd.grad(loss - value_loss, list(policy.values.parameters()))
    assert all(float(each.abs().max()) < 1e-6 for each in gradient)


def test_exposure_reaches_as_far_as_the_context() -> None:
    for context, window, lags in ((K, 3, 3), (K, 10, K - 1), (1, 10, 0)):
        policy = build("dt", TAGGED, exposure=True, exposure_window=window, context=context)
        term = policy.head.exposure  # type: ignore[union-attr]
        assert (0 if term is None else term.lags) == lags
    with pytest.raises(InputError, match=r"policy\.exposure_window is 0"):
        build("dt", TAGGED, exposure=True, exposure_window=0)


def test_the_largest_return_is_in_reward_units() -> None:
    policy, windows = build("dt", VECTORS, max_return=True).eval(), random_windows(VECTORS)
    small = policy.max_return(windows)
    policy.return_scale.fill_(10.0)
    torch.testing.assert_close(policy.max_return(windows), 10 * small)
    asked = replace(windows, returns_to_go=windows.returns_to_go + 7)
    assert torch.equal(policy.max_return(asked), policy.max_return(windows))
