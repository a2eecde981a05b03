"""Exposure in every policy, and sampled items."""

from typing import Any

import pytest
import torch

from tests.policies.test_ucf import CATALOG, ITEMS, VECTORS, K, random_windows, sessions_of, trained
from tests.policies.test_ucf import build as build_plain
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed
from ucfrec.errors import InputError
from ucfrec.fitting.loop import RowAdamW
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead

TAGGED = {**CATALOG, "tags": 2}
POLICIES = ("ucf", "dt", "dc", "lsdt", "dt4rec", "cdt4rec", "edt4rec", "sasrec")
policies = pytest.mark.parametrize("name", POLICIES)
kinds = pytest.mark.parametrize("sizes", [VECTORS, TAGGED], ids=["vectors", "items"])


def build(name: str, sizes: dict[str, int], **settings: Any) -> SequencePolicy:
    policy = build_plain(name, sizes, **{"dropout": 0.0, "exposure": False, **settings})
    if isinstance(policy.head, ItemHead) and policy.head.exposure is not None:
        tags = torch.randint(-1, 4, (ITEMS, 2))
        states = ItemStates(policy.head.embeddings, torch.zeros(0, 0), 0.0, 1.0, tags=tags)
        policy.head.exposure.start_from(states, torch.rand(99))
    return policy


@kinds
@policies
def test_every_learner_trains_and_acts(name: str, sizes: dict[str, int]) -> None:
    more = {"exposure": True, "exposure_window": 3} if sizes["items"] else {}
    policy, windows = build(name, sizes, **more), random_windows(sizes)
    policy.eval()
    before = policy.action_loss(windows).detach()
    trained(policy, windows, 25)
    assert policy.action_loss(windows) < before
    assert torch.isfinite(Scorer(policy, DecisionRule(2.0)).act(sessions_of(windows))).all()
    if sizes["items"]:
        assert any(each.any() for each in policy.head.exposure.parameters()), "it learns too"


@pytest.mark.parametrize("name", [*POLICIES, "bc"])
def test_every_learner_learns_from_sampled_items(name: str) -> None:
    settings = {"sampled_above": ITEMS - 1, "sampled_items": 4, "exposure": True}
    policy, windows = build(name, TAGGED, **settings), random_windows(TAGGED)
    before = policy.eval().action_loss(windows).detach()
    optimizer = RowAdamW(policy.parameters(), lr=1e-2)
    policy.train()
    for step in range(20):
        torch.manual_seed(step)
        optimizer.zero_grad()
        policy.loss(windows)[0].backward()  # type: ignore[no-untyped-call]
        assert policy.head.correction.grad.is_sparse
        optimizer.step()
    assert policy.eval().action_loss(windows) < before - 0.05


@policies
def test_exposure_moves_predictions_by_what_was_shown_alone(name: str) -> None:
    windows = random_windows(TAGGED)
    policy = trained(build(name, TAGGED, exposure=True, exposure_window=3), windows, 25)
    head, normalized = policy.head, policy.normalize(windows)
    for parameter in head.exposure.parameters():
        parameter.data += 0.1
    with torch.no_grad():
        plain = head.predict(policy.features(normalized)[:, -1])
        last = torch.arange(1, len(plain) + 1) * K - 1
        term = Exposed.before(normalized, 3, last)
        added = head.exposure.added_to(torch.zeros(len(last), ITEMS), term)
        torch.testing.assert_close(policy.act(windows), plain + added)


def test_exposure_reaches_as_far_as_the_context() -> None:
    for context, window, lags in ((K, 3, 3), (K, 10, K - 1), (1, 10, 0)):
        policy = build("dt", TAGGED, exposure=True, exposure_window=window, context=context)
        term = policy.head.exposure
        assert (0 if term is None else term.lags) == lags
    with pytest.raises(InputError, match=r"policy\.exposure_window is 0"):
        build("dt", TAGGED, exposure=True, exposure_window=0)
