"""Fitting the causal reward model (Algorithm 2) and measuring its quality on held-out steps."""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Float32Array, IntArray
from ucfrec.counterfactual.reward_model import (
    CausalRewardModel,
    CRMConfig,
    EffectsMean,
    kl_to_prior,
    read_transitions,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Transitions
from ucfrec.files.record import Undefinable
from ucfrec.fitting.checkpoint import load_trained, load_weights
from ucfrec.fitting.loop import LoopConfig, fit
from ucfrec.processes import random_state_kept
from ucfrec.user_model.reward import ItemRewardModel

INITIAL: Final = "initial.safetensors"
"""Weights of an older reward model, in the folder of the new one."""
_ACTIVE_NATS = 0.01
_LEAK = 0.1
_PREDICTS_NOTHING = 0.02
"""R² on held-out steps at or below which a reward model counts as useless."""
_QUANTILES = (0.5, 0.9, 0.95, 0.99)
_CONSTANT = 1e-6
_EPOCHS, _LEAST_UPDATES = 5, 800
"""Passes, or from few transitions updates, where the setting leaves the choice."""
_MOST_VALIDATIONS = 20
_REGRESSION_RATE = 0.5
"""Learning rate of the regression, in that of the CVAE."""
_REGRESSION_SHARES = (6, 3, 1)
"""The regression is fitted by this part of the updates, one after the other, while that helps."""
_VALIDATION_LIMIT = 20_000
_CHUNK = 16_384
_AT_ONCE = 1024
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class CRMReport:
    """Quality of the reward model, measured on held-out steps."""

    train_transitions: int
    validation_transitions: int
    reward_std: float
    """Of the training rewards, in reward units."""
    r2: Undefinable
    """R² of f̂_r(s, a, z) with the abduced z, which is computed from the reward itself."""
    r2_without_z: Undefinable
    """R² of f̂_r(s, a, 0), with z at its prior mean: what state and action alone predict."""
    z_share: float
    """Share of the reward's variance due to z (Sobol's total effect of z on f̂_r)."""
    z_leak: float
    """Largest |correlation| of an active z_i with f̂_r(s, a, 0); 0 for a true disturbance."""
    latent_dim: int
    active_dimensions: int
    """Number of latent dimensions with a mean KL above 0.01 nats."""
    kl: tuple[float, ...]
    """(latent_dim,) mean KL(q(z_i | s, a, r) ‖ p(z_i)) in nats."""
    delta: Mapping[str, float]
    """Quantiles of |f̂_r(s, a, z) − r| in reward units: Proposition 1's δ at factual states."""
    warning: str = ""
    """A warning about the abduction of z; empty if there is no problem."""


@random_state_kept()
def fit_crm(
    train: Transitions,
    validation: Transitions,
    config: CRMConfig,
    folder: Path,
    seed: int,
    mean: EffectsMean | None = None,
    device: torch.device = _CPU,
) -> tuple[CausalRewardModel, CRMReport]:
    """Train the reward model (Algorithm 2) with early stopping on held-out steps; the model with
    the lowest validation loss, in evaluation mode, and its quality.

    Args:
        folder: of the checkpoints, which training resumes from; with the file `INITIAL` in it, of
            weights and scales that training begins with.
        mean: E[r | s, a], if it was fitted before; transitions then have the actions that it reads.
        device: where the model is fitted, and stays. What is drawn is the same on all.
    """
    rng = np.random.default_rng(seed)
    train = _sample(train, config.max_transitions, rng).to(device)
    held_out = _sample(validation, _VALIDATION_LIMIT, rng).to(device)
    torch.manual_seed(seed)
    model = CausalRewardModel(train.states.shape[1], train.actions.shape[1], config, mean)
    model = model.to(device)
    _set_statistics(model, train)
    if mean is None and (folder / INITIAL).exists():
        load_weights(folder / INITIAL, model, load_trained(folder / INITIAL))
    if config.mean_first and mean is None:
        _fit_mean(model, train, held_out, folder / "mean", seed)
    inputs = _read_inputs(model, train)
    if config.mean_first:
        model.expected.requires_grad_(False)
        variance = float(inputs[1].double().square().mean())
        model.surprise_std.fill_(max(variance, 1e-8) ** 0.5)
    _fit_elbo(model, inputs, _read_inputs(model, held_out), folder / "cvae", seed)
    return model, _report(model, len(train.rewards), held_out)


def _fit_mean(
    model: CausalRewardModel, train: Transitions, held_out: Transitions, folder: Path, seed: int
) -> None:
    (inputs, rewards), held_out_rows = (
        (model.given(steps.states, steps.actions), model.normalised_rewards(steps.rewards))
        for steps in (train, held_out)
    )

    def draw(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        rows = _draw_rows(generator, len(rewards), model)
        return inputs[rows], rewards[rows]

    def loss(batch: tuple[Tensor, Tensor]) -> tuple[Tensor, Mapping[str, Tensor]]:
        return (batch[1] - model.expected(batch[0]).squeeze(-1)).square().mean(), {}

    def validate() -> float:
        return _mean_over_chunks(loss, held_out_rows)

    first, whole = copy.deepcopy(model.expected.state_dict()), _loop(model.config, len(rewards))
    best, weights = math.inf, first
    for share in _REGRESSION_SHARES:
        steps = max(1, whole.steps // share)
        loop = replace(
            whole,
            steps=steps,
            learning_rate=_REGRESSION_RATE * whole.learning_rate,
            warmup_steps=steps // 20,
            validate_every=max(1, steps // 3),
        )
        model.expected.load_state_dict(first)
        outcome = fit(
            model.expected, draw, loss, loop, folder / str(steps), seed=seed, validate=validate,
            describe="expected reward",
        )  # fmt: skip
        if outcome.best_validation >= best:
            break
        best, weights = outcome.best_validation, copy.deepcopy(model.expected.state_dict())
    model.expected.load_state_dict(weights)


@torch.no_grad()
def _read_inputs(model: CausalRewardModel, transitions: Transitions) -> tuple[Tensor, Tensor]:
    """What the CVAE sees of the steps: normalised inputs (M, S + A) and residuals (M,)."""
    s, a, r = transitions.states, transitions.actions, transitions.rewards
    parts = [slice(start, start + _CHUNK) for start in range(0, len(r), _CHUNK)]
    inputs = torch.cat([model.given(s[part], a[part]) for part in parts])
    return inputs, torch.cat([model.residual(s[part], a[part], r[part]) for part in parts])


def _fit_elbo(
    model: CausalRewardModel,
    train: tuple[Tensor, Tensor],
    held_out: tuple[Tensor, Tensor],
    folder: Path,
    seed: int,
) -> None:
    config, (inputs, residuals) = model.config, train

    def draw(generator: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        rows = _draw_rows(generator, len(residuals), model)
        return inputs[rows], residuals[rows], _draw_noise(generator, config.batch_size, model)

    def loss(batch: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Mapping[str, Tensor]]:
        log_likelihood, kl = (term.mean() for term in model.elbo(*batch))
        parts = {"log_likelihood": log_likelihood.detach(), "kl": kl.detach()}
        return config.beta * kl - log_likelihood, parts

    fixed = _draw_noise(np.random.default_rng(seed), len(held_out[1]), model)

    def validate() -> float:
        return _mean_over_chunks(loss, (*held_out, fixed))

    loop = _loop(config, len(residuals))
    fit(model, draw, loss, loop, folder, seed=seed, validate=validate, describe="reward model")


def _mean_over_chunks(
    loss: Callable[[Any], tuple[Tensor, Mapping[str, Tensor]]], rows: tuple[Tensor, ...]
) -> float:
    """The loss of M rows, of few at once: what a layer returns then stays in the cache."""
    chunks = zip(*(torch.split(values, _AT_ONCE) for values in rows), strict=True)
    total = sum(float(loss(chunk)[0]) * len(chunk[0]) for chunk in chunks)
    return total / len(rows[0])


def _loop(config: CRMConfig, transitions: int) -> LoopConfig:
    epoch = max(1, transitions // config.batch_size)
    steps = epoch * (config.epochs or max(_EPOCHS, math.ceil(_LEAST_UPDATES / epoch)))
    return LoopConfig(
        steps=steps,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        warmup_steps=steps // 20,
        cosine=True,
        clip_norm=0.0,
        validate_every=max(epoch, steps // _MOST_VALIDATIONS),
        patience=config.patience,
        average=0.0,
    )


def _draw_rows(generator: np.random.Generator, most: int, model: CausalRewardModel) -> Tensor:
    rows = generator.integers(most, size=model.config.batch_size)
    return torch.from_numpy(rows).to(model.device)


def _draw_noise(generator: np.random.Generator, rows: int, model: CausalRewardModel) -> Tensor:
    size = (rows, model.config.latent_dim)
    values: Float32Array = generator.standard_normal(size, dtype=np.float32)
    return torch.from_numpy(values).to(model.device)


@torch.no_grad()
def _report(model: CausalRewardModel, n_train: int, held_out: Transitions) -> CRMReport:
    s, a, r = held_out.states, held_out.actions, held_out.rewards
    q = model.encode(s, a, r)
    with_z = model.predict(s, a, q.mean)
    without_z = model.predict(s, a, torch.zeros_like(q.mean))
    # Rows are in random order, so the z of the next row is a draw from the marginal distribution,
    # as Jansen's estimator of the total effect needs.
    other_z = model.predict(s, a, q.mean.roll(1, dims=0))
    variance = float(r.var(correction=0)) or math.nan
    kl = kl_to_prior(q).mean(dim=0)
    active = kl > _ACTIVE_NATS
    columns = torch.cat([without_z.unsqueeze(1), q.mean[:, active]], dim=1)
    leak = torch.corrcoef(columns.T).nan_to_num().abs().reshape(columns.shape[1], -1)[0, 1:]
    errors = (with_z - r).abs().double()
    report = CRMReport(
        train_transitions=n_train,
        validation_transitions=len(r),
        reward_std=float(model.reward_std),
        r2=1 - float((with_z - r).square().mean()) / variance,
        r2_without_z=1 - float((without_z - r).square().mean()) / variance,
        z_share=0.5 * float((with_z - other_z).square().mean()) / variance,
        z_leak=float(leak.max()) if len(leak) else 0.0,
        latent_dim=kl.numel(),
        active_dimensions=int(active.sum()),
        kl=tuple(kl.tolist()),
        delta={f"{level:g}": float(errors.quantile(level)) for level in _QUANTILES},
    )
    return replace(report, warning=_warning(report))


def fit_warning(r2_without_z: float) -> str:
    """A warning if the reward model predicts nothing, i.e. its `CRMReport.r2_without_z` is at most
    0.02 or NaN; otherwise empty."""
    if r2_without_z > _PREDICTS_NOTHING:
        return ""
    return (
        f"the reward model predicts nothing: from state and action its R² on held-out steps is "
        f"{r2_without_z:.2f} (0 is what the mean reward alone reaches), so an edit that keeps its "
        "prediction may still change the true reward"
    )


def _warning(report: CRMReport) -> str:
    alone = f"state and action alone predict {report.r2_without_z:.1%} of the reward's variance"
    if report.active_dimensions == 0:
        return (
            f"latent collapse: none of {report.latent_dim} latent dimensions is used, so nothing "
            f"is abduced; {alone}"
        )
    if report.z_share < 0.01:
        return (
            f"latent near collapse: z accounts for only {report.z_share:.2%} of the reward's "
            f"variance, so abduction hardly matters; {alone}"
        )
    if report.z_leak > max(_LEAK, 4 / report.validation_transitions**0.5):
        return (
            f"latent leak: z correlates by {report.z_leak:.2f} with what state and action predict, "
            "so it is not a disturbance, and edits that change the reward may pass the gate"
        )
    return ""


def _set_statistics(model: CausalRewardModel, train: Transitions) -> None:
    """Means and standard deviations, in float64; of the latter, rounding errors become 0."""
    for name in ("state", "action", "reward"):
        values = getattr(train, f"{name}s").double()
        mean, std = values.mean(dim=0), values.std(dim=0, correction=0)
        std = torch.where(std > _CONSTANT * mean.abs().clamp(min=1.0), std, 0.0)
        model.get_buffer(f"{name}_mean").copy_(mean)
        model.get_buffer(f"{name}_std").copy_(std)


def _sample(transitions: Transitions, limit: int, rng: np.random.Generator) -> Transitions:
    rows = torch.from_numpy(rng.permutation(len(transitions.rewards))[:limit])
    return Transitions(**{f.name: getattr(transitions, f.name)[rows] for f in fields(transitions)})


def sample_steps(view: EpisodeStore, limit: int, seed: int) -> tuple[IntArray, IntArray]:
    """(episodes, steps) of a view: all, or `limit` drawn with replacement if there are more."""
    if view.n_steps <= limit:
        return view.all_steps()
    return view.draw_steps(np.random.default_rng(seed), limit)


def sample_transitions(
    view: EpisodeStore, limit: int, seed: int, item_rewards: ItemRewardModel | None = None
) -> Transitions:
    """The transitions of `sample_steps`, as `read_transitions` reads them."""
    episodes, steps = sample_steps(view, limit, seed)
    return read_transitions(view, episodes, steps, item_rewards)
