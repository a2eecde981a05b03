"""Fitting the reward model of items, effect by effect, on training rows."""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ucfrec.counterfactual.item_reward_effects import EFFECTS, Design, Effects, fit_effects
from ucfrec.counterfactual.item_reward_model import FITTED, ItemRewardModel
from ucfrec.counterfactual.item_reward_report import (
    Calibration,
    EffectTried,
    ItemRewardReport,
    calibration,
    gauc_against,
    item_rates,
    scores_of,
)
from ucfrec.counterfactual.item_reward_rows import RewardRows
from ucfrec.episodes.item_counts import LIKED
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, load_weights, save_tensors
from ucfrec.progress import progress

_SPREADS: Final = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
_FIRST: Final = 3
"""Index of the spread that is tried first."""
_MAX_ROWS: Final = 500_000
_CONSTANT: Final = 1e-6


def reward_model_sizes(store: EpisodeStore) -> dict[str, int]:
    """Sizes of the reward model of a store of items, as `ItemRewardModel` takes them."""
    states = store.item_states
    items, dim = states.embeddings.shape
    return {
        "state": store.state_size,
        "action": dim,
        "items": items,
        "users": len(states.user_features),
        "tags": states.tags.shape[1],
    }


def fit_item_reward_model(
    train: EpisodeStore,
    validation: EpisodeStore,
    folder: Path,
    seed: int,
    max_rows: int = _MAX_ROWS,
) -> tuple[ItemRewardModel, ItemRewardReport]:
    """Fit the model to training rows, or read it from `folder` if it was fitted before.

    Effects are added one after the other, all fitted jointly. Validation rows choose the strength
    of each effect's penalty, and whether the effect is kept: if it lowers their mean loss by more
    than the standard error of the decrease.

    Args:
        train: view of a store of items.
        validation: held-out view of the same store.
        folder: receives the fitted model.
        seed: of the rows drawn from a store with more than `max_rows`.
        max_rows: most rows of each view that are used.

    Returns:
        The model, in evaluation mode, and its quality on the validation rows.

    Raises:
        InputError: a view has no steps, or all training rewards are equal.
    """
    model = ItemRewardModel(reward_model_sizes(train))
    if (folder / FITTED).exists():
        tensors, about = load_tensors(folder / FITTED)
        load_weights(folder / FITTED, model, tensors)
        return model.eval(), _report_from(about)
    start = time.process_time()
    rows = RewardRows.of(train, model.lags, max_rows, seed)
    held_out = RewardRows.of(validation, model.lags, max_rows, seed)
    _set_statistics(model, rows, held_out, train.item_states)
    search = _Search(Design.of(model, rows), Design.of(model, held_out))
    with progress(len(EFFECTS), "item rewards", "effects") as bar:
        for name in EFFECTS:
            search.add(name)
            bar.update()
    model.set_effects(search.effects, search.design.of_content)
    report = _report(model, search, rows, held_out, train.item_states, start)
    folder.mkdir(parents=True, exist_ok=True)
    save_tensors(folder / FITTED, model.state_dict(), dataclasses.asdict(report))
    return model.eval(), report


class _Search:
    """The effects found so far, and their loss on held-out rows."""

    def __init__(self, design: Design, held_out: Design) -> None:
        self.design, self._held_out = design, held_out
        mean = design.target.mean()
        self.effects: Effects = {"mean": torch.logit(mean) if design.binary else mean}
        self.spreads: dict[str, float] = {}
        self.losses = self._losses(self.effects)
        self.base_loss = self.item_loss = float(self.losses.mean())
        self.tried: list[EffectTried] = []

    def add(self, name: str) -> None:
        """Add the effect `name` with the best spread, if it lowers the held-out loss."""
        if not float(self.design.squares(name).sum()):
            return
        found = {_FIRST: self._fitted(name, _FIRST)}
        for step in (1, -1):
            at = _FIRST + step
            while 0 <= at < len(_SPREADS):
                found[at] = self._fitted(name, at)
                if found[at][0] >= found[at - step][0]:
                    break
                at += step
            if min(found, key=lambda index: found[index][0]) > _FIRST:
                break
        best = min(found, key=lambda index: found[index][0])
        _, effects, losses = found[best]
        decrease = self.losses - losses
        gain = float(decrease.mean())
        error = float(decrease.std(correction=0)) / len(decrease) ** 0.5
        kept = gain > error
        self.tried.append(EffectTried(name, _SPREADS[best], gain, error, kept))
        if name == "item":
            self.item_loss = float(losses.mean())
        if kept:
            self.effects, self.losses = effects, losses
            self.spreads[name] = _SPREADS[best]

    def _fitted(self, name: str, index: int) -> tuple[float, Effects, Tensor]:
        effects = fit_effects(self.design, self.effects, {**self.spreads, name: _SPREADS[index]})
        losses = self._losses(effects)
        return float(losses.mean()), effects, losses

    def _losses(self, effects: Effects) -> Tensor:
        return self._held_out.loss(self._held_out.predictor(effects)).double()


def _set_statistics(
    model: ItemRewardModel, rows: RewardRows, held_out: RewardRows, states: ItemStates
) -> None:
    """Set the normalisation of states, rewards and embeddings from the training rows."""
    for name, part in (("training", rows), ("held-out", held_out)):
        if len(part) == 0:
            raise InputError(f"the reward model has no {name} steps; check the store's split")
    values = torch.unique(rows.rewards)
    if len(values) == 1:
        raise InputError(
            f"all {len(rows)} training rewards equal {float(values[0]):g}: there is nothing to "
            "model; check the reward expression"
        )
    model.binary.fill_(len(values) == 2)
    model.reward_low.fill_(values[0])
    model.reward_high.fill_(values[-1])
    rewards, before = rows.rewards.double(), rows.states.double()
    model.reward_mean.copy_(rewards.mean())
    model.reward_std.copy_(rewards.std(correction=0))
    model.state_mean.copy_(before.mean(0))
    spread = before.std(0, correction=0)
    constant = spread <= _CONSTANT * before.mean(0).abs().clamp(min=1.0)
    model.state_std.copy_(torch.where(constant, torch.inf, spread))
    shown = states.embeddings[rows.items].double()
    centred = states.embeddings.double() - shown.mean(0)
    length = centred[rows.items].square().sum(1).mean().sqrt()
    model.vectors.copy_(centred / length.clamp(min=_CONSTANT))
    model.likeness.start_from(states)


def _report(
    model: ItemRewardModel,
    search: _Search,
    rows: RewardRows,
    held_out: RewardRows,
    states: ItemStates,
    start: float,
) -> ItemRewardReport:
    scores, levels = scores_of(model, held_out)
    predicted = model.expected(scores).double().numpy()
    observed = held_out.rewards.double().numpy()
    threshold = states.reward_low + LIKED * (states.reward_high - states.reward_low)
    rates = item_rates(rows, rows.rewards >= threshold, len(model.item))
    ranking = gauc_against(
        scores - levels, rates[held_out.items], held_out.rewards >= threshold, held_out.users
    )
    variance = float(observed.var()) or float("nan")
    return ItemRewardReport(
        train_rows=len(rows),
        validation_rows=len(held_out),
        binary=bool(model.binary),
        effects=tuple(search.tried),
        base_loss=search.base_loss,
        item_loss=search.item_loss,
        loss=float(search.losses.mean()),
        r2=1 - float(np.square(predicted - observed).mean()) / variance,
        calibration=calibration(predicted, observed),
        seconds=time.process_time() - start,
        **ranking,
    )


def _report_from(values: Mapping[str, Any]) -> ItemRewardReport:
    """The report as it was before `dataclasses.asdict` and JSON."""
    curve = values["calibration"]
    return ItemRewardReport(
        **{
            **values,
            "effects": tuple(EffectTried(**tried) for tried in values["effects"]),
            "calibration": Calibration(
                predicted=tuple(curve["predicted"]),
                observed=tuple(curve["observed"]),
                count=tuple(curve["count"]),
                error=curve["error"],
            ),
        }
    )
