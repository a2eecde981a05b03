"""The reward model recovers a planted disturbance, and its report warns when it does not."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from tests.support.planted import ACTION, CONSTANT, FIT, STATE, affine_correlation, fitted, planted
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig, fit_crm, fit_warning
from ucfrec.errors import InputError

QUICK = CRMConfig(epochs=1, hidden=32, latent_dim=3, learning_rate=1e-3)


def test_the_planted_disturbance_is_abduced_and_its_share_measured() -> None:
    crm, report = fitted()
    unseen = planted(4_000, 2)
    t = unseen.transitions
    with torch.no_grad():
        z = crm.abduct(t.states, t.actions, t.rewards)
        predicted = crm.predict(t.states, t.actions, z)
    assert affine_correlation(z, unseen.disturbance) >= 0.9
    assert (predicted - t.rewards).abs().quantile(0.95) <= 2 * report.delta["0.95"]
    assert report.z_share == pytest.approx(0.3, abs=0.06)
    assert report.r2_without_z == pytest.approx(0.7, abs=0.06)
    assert report.r2 > 0.98
    assert report.active_dimensions >= 1
    assert report.z_leak < 0.1
    assert list(report.delta.values()) == sorted(report.delta.values())
    assert report.warning == ""
    assert json.loads(json.dumps(asdict(report)))["train_transitions"] == 20_000


def test_the_plain_autoencoder_leaks_and_the_report_warns(tmp_path: Path) -> None:
    train, held_out = planted(8_000, 0).transitions, planted(4_000, 1).transitions
    plain = replace(FIT, mean_first=False, epochs=8)
    _, report = fit_crm(train, held_out, plain, tmp_path, seed=0)
    assert report.z_share > 0.5
    assert report.warning.startswith("latent leak")


def test_a_reward_without_disturbance_collapses_and_the_report_warns(tmp_path: Path) -> None:
    train, held_out = planted(8_000, 0, share=0).transitions, planted(2_000, 1, share=0).transitions
    train = replace(train, rewards=train.states[:, 0] - train.actions[:, 1])
    held_out = replace(held_out, rewards=held_out.states[:, 0] - held_out.actions[:, 1])
    config = replace(FIT, epochs=4, hidden=64)
    _, report = fit_crm(train, held_out, config, tmp_path, seed=0)
    assert report.z_share < 0.01
    assert "collapse" in report.warning


def test_a_model_of_unpredictable_rewards_gives_a_warning(tmp_path: Path) -> None:
    train, held_out = planted(4_000, 0).transitions, planted(4_000, 1).transitions
    generator = torch.Generator().manual_seed(0)
    train = replace(train, rewards=1e-9 * torch.randn(4_000, generator=generator))
    held_out = replace(held_out, rewards=1e-9 * torch.randn(4_000, generator=generator))
    _, report = fit_crm(train, held_out, replace(FIT, epochs=2, hidden=32), tmp_path, seed=0)
    assert report.reward_std == pytest.approx(1e-9, rel=0.1)
    with pytest.raises(InputError, match="are equal, or nearly so"):
        fit_crm(replace(train, rewards=train.rewards + 1), held_out, FIT, tmp_path, seed=0)
    assert report.r2_without_z < 0.02
    assert fit_warning(report.r2_without_z).startswith("the reward model predicts nothing")
    assert fit_warning(0.021) == ""
    assert fit_warning(float("nan")) != ""


def test_dimensions_that_never_vary_are_inert(tmp_path: Path) -> None:
    train = planted(2_000, 0).transitions
    crm, _ = fit_crm(train, planted(500, 1).transitions, QUICK, tmp_path, seed=0)
    assert crm.state_std[CONSTANT] == 0
    normalised = crm.normalise_states(train.states)
    assert normalised[:, CONSTANT].abs().max() < 1e-6
    torch.testing.assert_close(normalised.std(0)[:6], torch.ones(CONSTANT), rtol=0.01, atol=0)
    shifted = train.states + torch.eye(STATE)[CONSTANT]
    assert crm.moves(train.states, shifted)[:, CONSTANT].isinf().all()


def test_one_seed_one_model_and_a_finished_run_is_not_repeated(tmp_path: Path) -> None:
    train, held_out = planted(2_000, 0).transitions, planted(500, 1).transitions
    config = replace(QUICK, max_transitions=1_500)

    def weights(folder: str, seed: int) -> torch.Tensor:
        crm, report = fit_crm(train, held_out, config, tmp_path / folder, seed)
        assert report.train_transitions == 1_500
        return torch.cat([value.flatten() for value in crm.state_dict().values()])

    first = weights("a", 0)
    assert torch.equal(first, weights("b", 0))
    assert torch.equal(first, weights("a", 0))
    assert not torch.equal(first, weights("c", 1))


def test_the_elbo_is_equation_2() -> None:
    torch.manual_seed(0)
    crm = CausalRewardModel(STATE, ACTION, QUICK).double()
    s, a, noise, r = (torch.randn(5, size).double() for size in (STATE, ACTION, 3, 1))
    r = r[:, 0]
    inputs, residual = crm.given(s, a), crm.residual(s, a, r)
    q = crm.encode(inputs, residual)
    assert torch.equal(crm.abduct(s, a, r), q.mean)
    posterior = Normal(q.mean, (0.5 * q.log_variance).exp())
    z = q.mean + posterior.stddev * noise
    log_likelihood, kl_of_model = crm.elbo(inputs, residual, noise)
    likelihood = Normal(crm.predict(s, a, z), QUICK.decoder_std)
    expected = likelihood.log_prob(r)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(log_likelihood, expected)
    kl = kl_divergence(posterior, Normal(torch.zeros(()).double(), 1.0))
    torch.testing.assert_close(kl_of_model, kl.sum(-1))
    torch.testing.assert_close(q.kl, kl)
