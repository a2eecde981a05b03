"""Training in bfloat16: close to float32, resumed to the last bit, and with every policy."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.fitting.checkpoint import load_tensors, read_metrics
from ucfrec.policies.base import SequencePolicy
from ucfrec.runs.config import resolve_config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.start import new_policy, training_views

SETTINGS = [
    "train.steps=16", "train.validate_every=4", "train.batch_size=16", "train.warmup_steps=2",
    "train.learning_rate=0.02", "policy.dim=16", "policy.context=4", "policy.dropout=0.1",
    "train.average=0",
]  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    return tagged_store(tmp_path_factory.mktemp("store"))


def trained(store: EpisodeStore, out: Path, precision: str, *more: str) -> SequencePolicy:
    config = resolve_config("ucf", None, [*SETTINGS, f"train.precision={precision}", *more])
    train, _ = training_views(store)
    policy = new_policy(train, config)
    fit_policy(policy, train, None, out, config)
    return policy


def test_the_loss_falls_as_in_float32(store: EpisodeStore, tmp_path: Path) -> None:
    curves, train = {}, training_views(store)[0]
    windows = train.windows(*train.draw_steps(np.random.default_rng(0), 200), 4)
    for precision in ("float32", "bfloat16"):
        policy = trained(store, tmp_path / precision, precision)
        assert all(each.dtype == torch.float32 for each in policy.parameters())
        untrained = new_policy(train, resolve_config("ucf", None, SETTINGS)).eval()
        with torch.no_grad():
            assert policy.action_loss(windows) < untrained.action_loss(windows) - 0.002
        curves[precision] = read_metrics(tmp_path / precision / "policy")["loss"]
    lower, full = (np.asarray([*curves[each].values()]) for each in ("bfloat16", "float32"))
    np.testing.assert_allclose(lower, full, rtol=0.01)
    assert not np.array_equal(lower, full)
    saved, _ = load_tensors(tmp_path / "bfloat16" / "policy" / "last.safetensors")
    assert torch.bfloat16 not in {each.dtype for each in saved.values()}


def test_a_resumed_training_ends_with_the_same_weights(store: EpisodeStore, tmp_path: Path) -> None:
    whole = trained(store, tmp_path / "whole", "bfloat16").state_dict()
    trained(store, tmp_path / "parts", "bfloat16", "train.steps=8")
    resumed = trained(store, tmp_path / "parts", "bfloat16").state_dict()
    assert all(torch.equal(each, whole[name]) for name, each in resumed.items())


POLICIES = ["ucf", "ucf-paper", "dt", "dc", "lsdt", "sasrec", "bc", "dt4rec", "cdt4rec", "edt4rec"]
SAMPLED = ["policy.sampled_above=1", "policy.sampled_items=8"]


@pytest.mark.parametrize(
    ("policy_name", "more"), [*((name, []) for name in POLICIES), ("ucf", SAMPLED)]
)
def test_gradients_of_every_learner_are_those_of_float32(
    store: EpisodeStore, policy_name: str, more: list[str]
) -> None:
    sizes = ["policy.dim=32", "policy.context=6", "policy.exposure=true"]
    config = resolve_config(policy_name, None, [*sizes, *more])
    view = training_views(store)[0]
    policy = new_policy(view, config)
    steps = view.draw_steps(np.random.default_rng(0), 64)
    windows, found = view.windows(*steps, policy.config.context), []
    for lower in (False, True):
        torch.manual_seed(0)
        policy.zero_grad()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=lower):
            loss, _ = policy.loss(windows)
        loss.backward()  # type: ignore[no-untyped-call]
        assert loss.dtype == torch.float32
        gradients = [each.grad for each in policy.parameters() if each.grad is not None]
        found.append((loss.item(), torch.cat([each.to_dense().flatten() for each in gradients])))
    (full, of_full), (lower_loss, of_lower) = found
    assert lower_loss == pytest.approx(full, rel=0.005)
    assert torch.cosine_similarity(of_full, of_lower, dim=0) > 0.99
