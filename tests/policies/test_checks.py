"""`check_policy` refuses what reads the answer or padding, and passes our own policies."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from tests.support.episodes import random_episodes, write_store
from tests.support.tagged import tagged_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import PolicyConfig, SequencePolicy, recurrent
from ucfrec.policies.checks import check_policy
from ucfrec.policies.registry import BUILT_IN
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy, policy_sizes

ITEMS_ONLY = {"item-knn", "gsasrec", "boosted", "item-rate", "recent-clicks", "recent-rate"}
SMALL = {"policy.dim": 16, "policy.context": 6}


@pytest.fixture(scope="module", params=["items", "vectors"])
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "items":
        return tagged_store(folder).split("train")
    return write_store(folder / "store", random_episodes([1, 4, 9, 30] * 8, items=False))


@pytest.mark.parametrize("name", BUILT_IN)
def test_our_own_policies_pass(store: EpisodeStore, name: str) -> None:
    if name in ITEMS_ONLY and not store.has_items:
        with pytest.raises(InputError, match=f"{name} recommends items"):
            new_policy(store, resolve_config(name, None, SMALL))
        return
    for more in ({"policy.context": 1}, {"policy.exposure": store.has_items}):
        more = more | ({"policy.kernel_groups": 4} if name == "lsdt" else {})
        policy = new_policy(store, resolve_config(name, None, SMALL | more))
        before = torch.get_rng_state()
        check_policy(policy, store, policy_sizes(store))
        assert torch.equal(torch.get_rng_state(), before)


class Net(SequencePolicy):
    """Features from states and an input that the test chooses."""

    read: Callable[["Net", Windows], Tensor]
    scale: float | Tensor = 1.0

    def __init__(self, config: PolicyConfig, sizes: dict[str, int]) -> None:
        super().__init__(config, sizes)
        self.net = nn.Linear(sizes["state"], config.dim)
        self.gru = nn.GRU(config.dim, config.dim, batch_first=True)
        self.register_buffer("gain", torch.ones(()))

    def features(self, windows: Windows) -> Tensor:
        return type(self).read(self, windows)


def check(
    store: EpisodeStore,
    read: Callable[[Net, Windows], object],
    change: Callable[[Net], object] = lambda policy: None,
    context: int = 6,
) -> None:
    """Check a policy whose features are `read`, after a change to it."""
    kind = type("Mine", (Net,), {"read": read})
    sizes = policy_sizes(store)
    policy = kind(PolicyConfig(context=context, dim=16, dropout=0.0), sizes)
    if store.has_items:
        counts = torch.from_numpy(store.item_counts()).float()
        policy.head.start_from(store.item_states.embeddings, counts)
    change(policy)
    check_policy(policy, store, sizes)


def embedded(policy: Net, windows: Windows) -> Tensor:
    return policy.head.embed(windows.actions)


def wide(values: Tensor) -> Tensor:
    return values.unsqueeze(-1).expand(-1, -1, 16)


def places(windows: Windows) -> Tensor:
    return torch.arange(1, windows.mask.shape[1] + 1)[:, None]


ANSWER, PADDING = "reads what it is to predict", "how much padding is before a session"
READS: dict[str, tuple[Callable[[Net, Windows], object], str]] = {
    "the current action": (embedded, ANSWER),
    "the next action": (lambda p, w: embedded(p, w).roll(-1, dims=1), ANSWER),
    "all actions": (lambda p, w: embedded(p, w).mean(1, keepdim=True).expand(-1, 6, -1), ANSWER),
    "the current reward": (lambda p, w: wide(w.rewards), ANSWER),
    "the next state": (lambda p, w: p.net(w.states).roll(-1, dims=1), ANSWER),
    "a little of the answer": (lambda p, w: p.net(w.states) + 1e-3 * embedded(p, w), ANSWER),
    "a place in the window": (lambda p, w: p.net(w.states) + places(w), PADDING),
    "the mean over the window": (lambda p, w: p.net(w.states).cumsum(1) / places(w), PADDING),
    "states of padding": (lambda p, w: p.net(w.states).cumsum(1), PADDING),
    "chance": (lambda p, w: p.net(w.states) + torch.randn(*w.mask.shape, 16), "other features for"),
    "too few steps": (lambda p, w: p.net(w.states)[:, 1:], "features of shape"),
    "what is no tensor": (lambda p, w: (p.net(w.states), None), "features of shape"),
}


@pytest.mark.parametrize("what", READS)
def test_what_a_policy_must_not_read_is_refused(store: EpisodeStore, what: str) -> None:
    read, reason = READS[what]
    torch.manual_seed(0)
    with pytest.raises(InputError, match=f"the policy Mine .*{reason}"):
        check(store, read)


@pytest.mark.parametrize("size", [1, 6])
def test_a_recurrent_network_that_skips_padding_passes(store: EpisodeStore, size: int) -> None:
    check(store, lambda p, w: recurrent(p.gru, p.net(w.states), w.mask), context=size)


@pytest.mark.parametrize("answer", [torch.ones(()), (1.0, {}), None, (torch.ones(2), {})])
def test_a_loss_that_gives_no_pair_is_refused(store: EpisodeStore, answer: object) -> None:
    def lose(policy: Net) -> None:
        object.__setattr__(policy, "loss", lambda windows: answer)

    with pytest.raises(InputError, match="loss that gives no scalar tensor"):
        check(store, lambda p, w: p.net(w.states), lose)


def test_state_outside_parameters_and_buffers_is_refused(store: EpisodeStore) -> None:
    def scale(policy: Net) -> None:
        policy.scale = 7.0

    check(store, lambda p, w: p.net(w.states) * p.gain, lambda p: p.gain.fill_(7.0))  # type: ignore[operator]
    with pytest.raises(InputError, match=r"keeps state outside .*; use register_buffer"):
        check(store, lambda p, w: p.net(w.states) * p.scale, scale)


def test_reserved_names_may_not_be_defined(store: EpisodeStore) -> None:
    sizes, kind = policy_sizes(store), type("Other", (Net,), {"normalize": lambda self, w: w})
    with pytest.raises(InputError, match="defines normalize"):
        check_policy(kind(PolicyConfig(), sizes), store, sizes)
