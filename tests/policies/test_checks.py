"""A policy that reads what it is to predict, or has another shape, is refused before training."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from tests.support.episodes import random_episodes, write_store
from tests.support.tagged import tagged_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.policies.checks import require_sound, require_whole
from ucfrec.policies.layers import recurrent
from ucfrec.policies.registry import BUILT_IN
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import new_policy

ITEMS_ONLY = ("item-knn", "gsasrec", "bpr", "boosted")
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
        pytest.skip("recommends items only")
    for more in ({}, {"policy.context": 1}, {"policy.exposure": store.has_items}):
        more = more | ({"policy.kernel_groups": 4} if name == "lsdt" else {})
        policy = new_policy(store, resolve_config(name, None, SMALL | more))
        before = torch.get_rng_state()
        require_sound(policy, store, name)
        assert policy.training
        assert torch.equal(torch.get_rng_state(), before)


class Net(SequencePolicy):
    """Features from states and an input that the test chooses."""

    def __init__(self, store: EpisodeStore, read: Callable[["Net", Windows], Tensor]) -> None:
        items = len(store.item_states.embeddings) if store.has_items else 0
        action = (
            store.item_states.embeddings.shape[1] if items else store.record.columns["action"][0]
        )
        sizes = {"state": store.state_size, "action": action, "items": items}
        super().__init__(PolicyConfig(context=6, dim=16, dropout=0.0), sizes)
        self.net, self.read = nn.Linear(store.state_size, 16), read
        if store.has_items:
            counts = torch.from_numpy(store.item_counts()).float()
            self.head.start_from(store.item_states.embeddings, counts)  # type: ignore[operator]

    def features(self, windows: Windows) -> Tensor:
        return self.read(self, windows)


def embedded(policy: Net, windows: Windows) -> Tensor:
    return policy.head.embed(windows.actions)


def wide(values: Tensor) -> Tensor:
    return values.unsqueeze(-1).expand(-1, -1, 16)


READS: dict[str, Callable[[Net, Windows], Tensor]] = {
    "the current action": embedded,
    "the next action": lambda p, w: embedded(p, w).roll(-1, dims=1),
    "all actions": lambda p, w: embedded(p, w).mean(1, keepdim=True).expand(-1, 6, -1),
    "the current reward": lambda p, w: wide(w.rewards),
    "the next state": lambda p, w: p.net(w.states).roll(-1, dims=1),
    "the next return": lambda p, w: wide(w.returns_to_go).roll(-1, dims=1),
    "a little of the current action": lambda p, w: p.net(w.states) + 1e-3 * embedded(p, w),
}
SHAPES: dict[str, Callable[[Net, Windows], object]] = {
    "no steps": lambda p, w: p.net(w.states)[:, -1],
    "too few steps": lambda p, w: p.net(w.states)[:, 1:],
    "too narrow": lambda p, w: p.net(w.states)[..., :-1],
    "no tensor": lambda p, w: (p.net(w.states), None),
}


PADDING: dict[str, Callable[[Net, Windows], Tensor]] = {
    "a place in the window": lambda p, w: p.net(w.states) + torch.arange(w.mask.shape[1])[:, None],
    "the mean over the window": lambda p, w: (
        p.net(w.states).cumsum(1) / torch.arange(1, w.mask.shape[1] + 1)[:, None]
    ),
    "the number of steps": lambda p, w: p.net(w.states) + w.mask.shape[1],
    "states of padding": lambda p, w: p.net(w.states).cumsum(1),
}
FAILS: dict[str, Callable[[Net, Windows], object]] = {
    "another size": lambda p, w: w.states @ torch.zeros(99, 16),
    "a wrong name": lambda p, w: w.state,  # type: ignore[attr-defined]
    "nothing": lambda p, w: 1 / 0,
}


@pytest.mark.parametrize("what", PADDING)
def test_what_depends_on_padding_is_refused(store: EpisodeStore, what: str) -> None:
    with pytest.raises(InputError, match="'mine' depends on how much padding is before a session"):
        require_sound(Net(store, PADDING[what]), store, "mine")


@pytest.mark.parametrize("size", [1, 2, 6])
def test_a_recurrent_network_that_skips_padding_passes(store: EpisodeStore, size: int) -> None:
    policy = Net(store, lambda p, w: recurrent(p.gru, p.net(w.states), w.mask))  # type: ignore[arg-type]
    policy.gru = nn.GRU(16, 16, batch_first=True)
    object.__setattr__(policy.config, "context", size)
    require_sound(policy, store, "mine")


def test_features_that_are_random_are_not_taken_for_the_answer(store: EpisodeStore) -> None:
    def random(policy: Net, windows: Windows) -> Tensor:
        return policy.net(windows.states) + torch.randn(*windows.mask.shape, 16)

    with pytest.raises(InputError, match="'mine' gives other features for the same windows"):
        require_sound(Net(store, random), store, "mine")


@pytest.mark.parametrize("what", FAILS)
def test_features_that_fail_are_named(store: EpisodeStore, what: str) -> None:
    with pytest.raises(InputError, match=r"^the policy 'mine' fails in features \(") as caught:
        require_sound(Net(store, FAILS[what]), store, "mine")  # type: ignore[arg-type]
    assert caught.value.__cause__ is not None
    with pytest.raises(type(caught.value.__cause__)):
        require_sound(Net(store, FAILS[what]), store, "dt")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "change",
    [lambda pair: pair[0], lambda pair: (float(pair[0]), {}), lambda _: None, lambda _: 1 / 0],
)
def test_a_loss_that_gives_no_pair_is_refused(
    store: EpisodeStore, change: Callable[[tuple[Tensor, dict[str, Tensor]]], object]
) -> None:
    class Other(Net):
        def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
            return change(super().loss(windows))  # type: ignore[return-value]

    with pytest.raises(InputError, match=r"loss of the policy 'mine'|'mine' fails in loss"):
        require_sound(Other(store, lambda p, w: p.net(w.states)), store, "mine")


@pytest.mark.parametrize("kept", ["parameters", "a buffer", "an attribute"])
def test_state_outside_parameters_and_buffers_is_refused(store: EpisodeStore, kept: str) -> None:
    def policy() -> Net:
        net = Net(store, lambda p, w: p.net(w.states) * p.scale)  # type: ignore[operator]
        if kept == "a buffer":
            net.register_buffer("scale", torch.ones(()))
        else:
            net.scale = 1.0  # type: ignore[assignment]
        return net.eval()

    mine, rebuilt = policy(), policy()
    if kept != "parameters":
        mine.scale *= 7  # type: ignore[operator, assignment]
    rebuilt.load_state_dict(mine.state_dict())
    if kept == "an attribute":
        with pytest.raises(InputError, match=r"'mine' keeps state outside .*; use register_buffer"):
            require_whole(mine, rebuilt, store, "mine")
    else:
        require_whole(mine, rebuilt, store, "mine")


@pytest.mark.parametrize("what", READS)
def test_what_reads_the_answer_is_refused(store: EpisodeStore, what: str) -> None:
    torch.manual_seed(0)
    with pytest.raises(InputError, match="'mine' reads what it is to predict"):
        require_sound(Net(store, READS[what]), store, "mine")


@pytest.mark.parametrize("what", SHAPES)
def test_another_shape_is_refused(store: EpisodeStore, what: str) -> None:
    with pytest.raises(InputError, match=r"'mine' (gives features of shape|cannot act on)"):
        require_sound(Net(store, SHAPES[what]), store, "mine")  # type: ignore[arg-type]


def test_earlier_actions_and_rewards_may_be_read(store: EpisodeStore) -> None:
    def earlier(policy: Net, windows: Windows) -> Tensor:
        read = (embedded(policy, windows) + wide(windows.rewards)).roll(1, dims=1)
        read[:, 0] = 0
        return policy.net(windows.states) + read + wide(windows.returns_to_go)

    require_sound(Net(store, earlier), store, "mine")


@pytest.mark.parametrize("name", ["config", "values", "state_mean", "return_scale"])
def test_a_reserved_attribute_is_not_set_again(store: EpisodeStore, name: str) -> None:
    policy = Net(store, embedded)
    with pytest.raises(InputError, match=f"Net sets '{name}', which .* keeps for itself"):
        setattr(policy, name, nn.Linear(2, 2) if name == "values" else torch.ones(1))
