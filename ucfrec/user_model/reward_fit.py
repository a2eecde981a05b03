"""Fitting the reward model of items, effect by effect, on training rows."""

import dataclasses
import time
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ucfrec.episodes.states import ItemStates, least_liked
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, load_weights
from ucfrec.progress import progress
from ucfrec.user_model.effect_search import (
    LASTING,
    Beginning,
    EffectSearch,
    ShownBefore,
    added_by_tastes,
    effects_of_items,
    save_fit,
    set_usual,
)
from ucfrec.user_model.reward import FITTED, MEMORY, ItemRewardModel
from ucfrec.user_model.reward_effects import EFFECTS, Design, Effects, fit_effects
from ucfrec.user_model.reward_report import (
    ItemRewardReport,
    RewardRows,
    calibration,
    gauc_against,
    item_rates,
    scores_of,
)

_MAX_ROWS: Final = 500_000
WARM_ROWS: Final = 25_000
"""Most rows of a search that begins near an earlier one."""
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
    effects: Collection[str] = EFFECTS,
    first: Path | None = None,
) -> tuple[ItemRewardModel, ItemRewardReport]:
    """Fit the model to training rows, or read it from `folder` if it was fitted before.

    Effects are added one after the other, all fitted jointly. Validation rows choose the strength
    of each effect's penalty, and whether the effect is kept: if it lowers their mean loss by more
    than the standard error of the decrease.

    Where hardly any validation row is of a user with training rows, the model is for new users. A
    fifth of the training rows then chooses for the effects in `LASTING`: with unknown users,
    effects of items that contain those of the users who saw them predict best. What a user's
    effects tell of training rows, the history of the session must tell of a new user. So the
    effects of users are dropped once those of items are known, but for how much users differ, which
    is what `UserPosterior` start from, and the other effects are fitted without them.

    Args:
        train: view of a store of items.
        validation: held-out view of the same store.
        seed: of the rows drawn from a store with more than `max_rows`.
        max_rows: most rows of each view that are used.
        first: folder of the model of an earlier state of the store, near whose spreads the search
            begins and ends; where users are known, on fewer rows.

    Returns:
        The model, in evaluation mode, and its quality on the validation rows.

    Raises:
        InputError: a view has no steps, or all training rewards are equal.
    """
    model = ItemRewardModel(reward_model_sizes(train))
    if (folder / FITTED).exists():
        tensors, metadata = load_tensors(folder / FITTED)
        load_weights(folder / FITTED, model, tensors)
        with damage_explained(folder / FITTED, REMEDY):
            return model.eval(), ItemRewardReport(**metadata)
    start = time.process_time()
    rows = RewardRows.of(train, model.lags, max_rows, seed)
    held_out = RewardRows.of(validation, model.lags, max_rows, seed)
    set_statistics(model, rows, held_out, train.item_states)
    design = Design.of(model, rows)
    begin = None if first is None else Beginning.of(first / FITTED, design)
    search = EffectSearch(design, Design.of(model, held_out), begin)
    if begin is not None and not search.of_new_users:
        some = np.random.default_rng(seed).permutation(len(rows)) < WARM_ROWS
        search = EffectSearch(design.select(torch.from_numpy(some)), search.held_out, begin)
    if search.of_new_users:
        rows = RewardRows.of(train, MEMORY, max_rows, seed)
        held_out = RewardRows.of(validation, MEMORY, max_rows, seed)
        search.shown = ShownBefore(model, rows.shown, held_out.shown)
    with progress(len(EFFECTS), "item rewards", "effects") as bar:
        search.add_all(bar, effects)
    if len(search.design.items) < len(rows):
        search.fit_to(design)
    model.set_effects(search.effects, search.design.of_content)
    report = _report(model, search, rows, held_out, train.item_states, start)
    save_fit(folder / FITTED, model, search.effects, dataclasses.asdict(report))
    return model.eval(), report


def refit_item_reward_model(
    first: Path, store: EpisodeStore, folder: Path, seed: int
) -> ItemRewardModel:
    """Fit the effects of the model in the folder `first`, as strong as there, to other rows.

    Args:
        first: folder of `fit_item_reward_model`.
        store: view of the episodes to fit to.
        seed: of the rows drawn from a view with too many.
    """
    tensors, metadata = load_tensors(first / FITTED)
    report = ItemRewardReport(**metadata)
    model = ItemRewardModel(reward_model_sizes(store))
    lags = MEMORY if "tastes" in report.kept else model.lags
    rows = RewardRows.of(store, lags, _MAX_ROWS, seed)
    set_statistics(model, rows, rows, store.item_states)
    design = Design.of(model, rows)
    begin, effects = Beginning.of(first / FITTED, design), design.mean_effect()
    if begin is not None:
        effects |= begin.effects
    spreads, fixed = dict(report.kept), Effects()
    if report.new_users:
        lasting: dict[str, float] = {}
        for name in LASTING:
            if name in spreads:
                lasting[name] = spreads.pop(name)
        fixed = effects_of_items(fit_effects(design, effects, lasting))
        design = design.of_unknown_users()
        if "tastes" in spreads:
            alone = fit_effects(design, effects, {}, fixed)
            set_usual(model, design, alone)
            model.tastes.root.copy_(tensors["tastes.root"])
            design = replace(design, tastes=added_by_tastes(model, rows.shown, rows.items))
    effects = fit_effects(design, effects, spreads, fixed)
    model.set_effects(effects, design.of_content)
    save_fit(folder / FITTED, model, effects, dataclasses.asdict(report))
    return model.eval()


def set_statistics(
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
    binary = len(values) == 2
    model.binary.fill_(binary)
    model.reward_low.fill_(values[0] if binary else states.reward_low)
    model.reward_high.fill_(values[1] if binary else states.reward_high)
    rewards, states_before = rows.rewards.double(), rows.states.double()
    model.reward_mean.copy_(rewards.mean())
    model.reward_std.copy_(rewards.std(correction=0))
    model.state_mean.copy_(states_before.mean(0))
    spread = states_before.std(0, correction=0)
    constant = spread <= _CONSTANT * states_before.mean(0).abs().clamp(min=1.0)
    model.state_std.copy_(torch.where(constant, torch.inf, spread))
    shown = states.embeddings[rows.items].double()
    centred = states.embeddings.double() - shown.mean(0)
    length = centred[rows.items].square().sum(1).mean().sqrt()
    model.vectors.copy_(centred / length.clamp(min=_CONSTANT))
    model.likeness.start_from(states)


def _report(
    model: ItemRewardModel,
    search: EffectSearch,
    rows: RewardRows,
    held_out: RewardRows,
    states: ItemStates,
    start: float,
) -> ItemRewardReport:
    scores, levels = scores_of(model, held_out)
    predicted = model.expected(scores).double().numpy()
    observed = held_out.rewards.double().numpy()
    threshold = least_liked(states.reward_low, states.reward_high)
    rates = item_rates(rows, rows.rewards >= threshold, len(model.item))
    ranking = gauc_against(
        scores - levels, rates[held_out.items], held_out.rewards >= threshold, held_out.users
    )
    variance = float(observed.var()) or float("nan")
    return ItemRewardReport(
        train_rows=len(rows),
        validation_rows=len(held_out),
        binary=bool(model.binary),
        effects=search.report(),
        new_users=search.new_users,
        base_loss=search.base_loss,
        item_loss=search.item_loss,
        loss=float(search.losses.mean()),
        r2=1 - float(np.square(predicted - observed).mean()) / variance,
        calibration=calibration(predicted, observed),
        seconds=time.process_time() - start,
        **ranking,
    )
