"""Lists of ten from changing candidates, evaluated for another policy: the truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ucfrec.acting.decision import DecisionRule
from ucfrec.off_policy import LoggedSteps, conclude, diagnose, merge_lists
from ucfrec.off_policy.logged_steps import Modelled

K, ITEMS, CANDIDATES = 10, 40, 25
RULE = DecisionRule(0.0, temperature=1.0)


class World:
    """A logging and an evaluated policy, and the clicks of ten positions."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self.chance = 0.4 * torch.rand(ITEMS, generator=generator)
        self.logging = torch.randn(ITEMS, generator=generator)
        drift = torch.randn(ITEMS, generator=generator) + 2 * (self.chance - 0.2)
        self.evaluated = self.logging + 0.5 * drift

    def draw(self, scores: torch.Tensor, users: int, seed: int) -> tuple[torch.Tensor, ...]:
        generator = torch.Generator().manual_seed(seed)
        offered = torch.rand(users, ITEMS, generator=generator).argsort(1) < CANDIDATES
        uniforms = torch.rand(users, ITEMS + 1, generator=generator)
        return offered, *RULE.rank_items(scores.masked_fill(~offered, -torch.inf), K, uniforms)

    def value(self, scores: torch.Tensor) -> float:
        return float(self.chance[self.draw(scores, 40_000, seed=9)[1]].sum(1).mean())

    def log(self, users: int, seed: int) -> LoggedSteps:
        offered, items, propensities = self.draw(self.logging, users, seed)
        scores = self.evaluated.masked_fill(~offered, -torch.inf)
        targets = [
            RULE.log_probabilities(scores, items[:, :place]).gather(1, items[:, place : place + 1])
            for place in range(K)
        ]
        clicks = torch.rand(users, K, generator=torch.Generator().manual_seed(seed + 1))
        return LoggedSteps(
            np.repeat(np.arange(users), K),
            (clicks < self.chance[items]).double().flatten().numpy(),
            propensities.flatten().numpy(),
            torch.cat(targets, 1).double().exp().flatten().numpy(),
            place=np.tile(np.arange(K), users),
        )


@pytest.mark.slow
def test_intervals_cover_the_truth() -> None:
    world, users = World(), 2000
    lift = world.value(world.evaluated) - world.value(world.logging)
    covered = []
    for seed in range(200):
        steps = world.log(users, 10 * seed)
        evidence = conclude(steps, seed, diagnose(steps)).lift
        if evidence.is_reliable:  # one test in a hundred finds a fault where there is none
            covered.append(evidence.low <= lift <= evidence.high)
    assert len(covered) >= 190
    assert 0.92 <= np.mean(covered) <= 0.98


def random_lists(seed: int) -> LoggedSteps:
    """Sessions of one to three decisions of one to four positions."""
    rng = np.random.default_rng(seed)
    session, place = [], []
    for number in range(40):
        for size in rng.integers(1, 5, size=rng.integers(1, 4)):
            session += [number] * size
            place += range(size)
    n = len(session)
    model = Modelled(*rng.random((4, n)))
    chances = rng.uniform(0.2, 1.0, size=(2, n))
    return LoggedSteps(np.array(session), rng.random(n), *chances, model, place=np.array(place))


@pytest.mark.parametrize("seed", range(5))
def test_weights_are_products_of_decisions_and_positions(seed: int) -> None:
    cascade = random_lists(seed)
    independent, whole = replace(cascade, positions="independent"), merge_lists(cascade)
    ratios = cascade.target / cascade.propensity
    decision, weight = -1, 1.0
    for row in range(len(ratios)):
        if cascade.step[row] == 0:
            weight = 1.0
        if cascade.place[row] == 0:
            decision, before = decision + 1, weight
            assert whole.weights_before[decision] == pytest.approx(before)
        assert independent.weights[row] == pytest.approx(before * ratios[row])
        assert independent.weights_before[row] == pytest.approx(before)
        assert cascade.weights_before[row] == pytest.approx(weight)
        weight *= ratios[row]
        assert cascade.weights[row] == pytest.approx(weight)
    assert whole.returns == pytest.approx(cascade.returns)
    assert whole.session_weights == pytest.approx(cascade.weights[cascade.last])


def test_single_steps_are_lists_of_one() -> None:
    steps = random_lists(0)
    alone = replace(steps, place=np.zeros(len(steps.place), dtype=np.int64))
    plain = replace(steps, place=None)
    for name in ("weights", "weights_before", "discounts"):
        np.testing.assert_allclose(getattr(merge_lists(alone), name), getattr(plain, name))
        np.testing.assert_allclose(getattr(alone, name), getattr(plain, name))
