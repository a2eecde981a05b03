"""Edits keep the true reward; the default generator's are varied, the paper's are not."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.support.planted import CONSTANT, f, fitted, planted
from tests.support.real_data import data_folder
from ucfrec.counterfactual.augmentation import MoveReport, MoveStatistics, accept
from ucfrec.counterfactual.generators import (
    ActionSupport,
    CounterfactualStateGenerator,
    CSGConfig,
    Generator,
    NoiseGenerator,
    StateClusters,
    make_generator,
)
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig, fit_crm
from ucfrec.episodes.windows import Transitions

TANGENT = CSGConfig()
FAITHFUL = CSGConfig(kind="faithful", epochs=4)


def made(config: CSGConfig, folder: Path) -> Generator:
    return make_generator(planted(20_000, 0).transitions, fitted()[0], config, folder, seed=0)


def proposed(
    generator: Generator, crm: CausalRewardModel, at: Transitions, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Counterfactual states, and which of them pass both gates in float64."""
    with torch.no_grad():
        z = crm.abduct(at.states, at.actions, at.rewards)
    edited = generator.propose(at, z, torch.Generator().manual_seed(seed))
    assert edited.dtype == torch.float32
    exact = copy.deepcopy(crm).double()
    s, a, r = at.states.double(), at.actions.double(), at.rewards.double()
    factual = replace(at, states=s, actions=a, rewards=r)
    with torch.no_grad():
        z = exact.abduct(s, a, r)
        passed = accept(exact, factual, z, edited.double(), 0.1 * float(crm.reward_std), 0.5)
    return edited, passed


def moves(crm: CausalRewardModel, at: Transitions, edited: Tensor) -> MoveReport:
    statistics = MoveStatistics(at.states.shape[1])
    statistics.add(crm.moves(at.states, edited))
    return statistics.report(0.5, int((crm.state_std > 0).sum()))


@pytest.mark.parametrize("config", [TANGENT, FAITHFUL], ids=lambda config: config.kind)
def test_accepted_edits_keep_the_true_reward(config: CSGConfig, tmp_path: Path) -> None:
    crm, _ = fitted()
    at = planted(4_000, 2).transitions
    edited, passed = proposed(made(config, tmp_path), crm, at)
    assert passed.float().mean() >= 0.8
    # r − f(s, a) is the disturbance u, the same for both.
    true_change = (f(edited, at.actions) - f(at.states, at.actions)).abs()
    kept = true_change[passed] <= 0.1 * crm.reward_std
    assert kept.float().mean() >= 0.9
    assert torch.equal(edited[:, CONSTANT], at.states[:, CONSTANT])


def test_tangent_moves_stay_on_the_level_set_and_in_the_band(tmp_path: Path) -> None:
    crm, _ = fitted()
    at = planted(4_000, 2).transitions
    generator, other = made(TANGENT, tmp_path), made(TANGENT, tmp_path)
    edited, _ = proposed(generator, crm, at)
    assert torch.equal(edited, proposed(other, crm, at)[0])
    assert not torch.equal(edited, proposed(generator, crm, at, seed=1)[0])
    with torch.no_grad():
        z = crm.abduct(at.states, at.actions, at.rewards)
        drift = crm.predict(edited, at.actions, z) - crm.predict(at.states, at.actions, z)
    assert (drift.abs() / crm.reward_std).quantile(0.99) < 0.01
    report = moves(crm, at, edited)
    assert report.length_quantiles["0.05"] > 0.18
    assert report.histogram_counts[-1] > 0
    assert report.mean_move_ratio < 0.1
    # The level set takes one of the six dimensions that vary.
    assert 3.5 < report.effective_rank < 6
    few = planted(3, 0).transitions
    generator = make_generator(few, crm, TANGENT, tmp_path, seed=0)
    assert proposed(generator, crm, few)[0].isfinite().all()
    assert len(proposed(generator, crm, planted(0, 0).transitions)[0]) == 0


@pytest.fixture(scope="module")
def hopper(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[CausalRewardModel, Transitions, Transitions]:
    import h5py

    torch.set_num_threads(1)
    with h5py.File(data_folder("control") / "hopper_medium-expert-zoo.hdf5") as file:
        s, a, r = (
            torch.from_numpy(np.asarray(file[name], dtype=np.float32))
            for name in ("observations", "actions", "rewards")
        )
        episode = np.cumsum(np.asarray(file["terminals"]) | np.asarray(file["timeouts"]))
    held_out = torch.from_numpy(episode % 10 == 0)

    def some(which: Tensor) -> Transitions:
        rows = torch.nonzero(which)[::6, 0]
        last = torch.zeros(len(rows), dtype=torch.bool)
        return Transitions(s[rows], a[rows], r[rows], torch.zeros_like(s[rows]), last)

    train, rest = some(~held_out), some(held_out)
    config = CRMConfig(epochs=5, learning_rate=2e-3)
    crm, _ = fit_crm(train, rest, config, tmp_path_factory.mktemp("hopper"), seed=0)
    return crm, train, rest


@pytest.mark.realdata
@pytest.mark.parametrize(("config", "varied"), [(TANGENT, True), (FAITHFUL, False)])
def test_edit_collapse_on_hopper(
    hopper: tuple[CausalRewardModel, Transitions, Transitions],
    config: CSGConfig,
    varied: bool,
    tmp_path: Path,
) -> None:
    crm, train, at = hopper
    edited, passed = proposed(make_generator(train, crm, config, tmp_path, seed=0), crm, at)
    report = moves(crm, Transitions(*(v[passed] for v in vars(at).values())), edited[passed])
    assert passed.float().mean() >= 0.8
    assert varied == (report.mean_move_ratio <= 0.3 and report.effective_rank > 5)
    assert varied != (report.mean_move_ratio > 0.5)


def test_noise_fills_the_band_and_spares_what_never_varies(tmp_path: Path) -> None:
    crm, _ = fitted()
    at = planted(2000, 1).transitions
    edited, _ = proposed(made(CSGConfig(kind="noise"), tmp_path), crm, at)
    moves = crm.moves(at.states, edited)
    length = moves.norm(dim=1)
    assert 0.199 < length.min() < 0.21
    assert 0.49 < length.max() < 0.501
    assert (moves[:, CONSTANT] == 0).all()
    assert moves[:, crm.state_std > 0].mean(0).abs().max() < 0.03


@pytest.mark.parametrize("kind", ["noise", "faithful"])
def test_proposals_are_made_where_the_model_is(kind: Literal["noise", "faithful"]) -> None:
    # Tensors of the device "meta" have no values, and mixing them with the CPU's is an error.
    crm = CausalRewardModel(3, 2, CRMConfig(latent_dim=2, hidden=4)).to("meta")
    config = CSGConfig(kind=kind, hidden=4)
    s, a, r, z = (torch.empty(5, size, device="meta") for size in (3, 2, 1, 2))
    generator: Generator = NoiseGenerator(crm, config)
    if kind == "faithful":
        generator = CounterfactualStateGenerator(crm, config).to("meta")
    found = generator.propose(Transitions(s, a, r, s, r), z, torch.Generator())
    assert found.device == crm.device
    assert found.shape == (5, 3)


def test_states_apart_are_clusters_apart() -> None:
    centres = torch.tensor([[8.0, 0.0], [-8.0, 0.0], [0.0, 8.0]])
    labels = torch.arange(300) % 3
    spread = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])[labels]
    noise = torch.randn(300, 2, generator=torch.Generator().manual_seed(0))
    clusters = StateClusters.of(centres[labels] + spread * noise, 3, seed=0)
    found = clusters.nearest(centres)
    assert sorted(found.tolist()) == [0, 1, 2]
    torch.testing.assert_close(clusters.centres[found], centres, atol=0.3, rtol=0)
    wide = clusters.covariances[found].diagonal(dim1=1, dim2=2)
    assert wide[0, 0] > 2 * wide[0, 1] - 1
    assert wide[0, 0] > wide[1, 0]
    assert len(StateClusters.of(centres, 32, seed=0).centres) == 1


@given(
    labels=st.lists(st.integers(0, 4), min_size=1, max_size=30),
    asked=st.lists(st.integers(0, 6), max_size=30),
    size=st.sampled_from([None, 2]),
    seed=st.integers(0, 9),
)
def test_only_actions_of_the_same_cluster_are_drawn(
    labels: list[int], asked: list[int], size: int | None, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    numbers = rng.permutation(len(labels))
    actions = numbers if size is None else np.stack([numbers, -numbers], axis=1).astype(np.float32)
    support = ActionSupport(np.array(labels), actions)
    drawn, known = support.draw(np.array(asked, dtype=np.int64), rng)
    assert known.tolist() == [label in labels for label in asked]
    cluster_of = dict(zip(numbers.tolist(), labels, strict=True))
    for action, label, is_known in zip(drawn, asked, known, strict=True):
        if is_known:
            first = int(np.atleast_1d(action)[0])
            assert cluster_of[first] == label
            assert size is None or action.tolist() == [first, -first]


def test_actions_are_drawn_as_often_as_they_were_logged() -> None:
    support = ActionSupport(np.zeros(8, dtype=np.int64), np.array([3, 3, 3, 3, 3, 3, 5, 9]))
    drawn, _ = support.draw(np.zeros(40_000, dtype=np.int64), np.random.default_rng(0))
    shares = np.bincount(drawn, minlength=10) / 40_000
    np.testing.assert_allclose(shares[[3, 5, 9]], [0.75, 0.125, 0.125], atol=0.01)
