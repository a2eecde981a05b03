"""Fitting reward models of items, effect by effect: for whoever acts, and of training users.

Decision rules are tried in sessions of training users, who have fixed tastes that nothing that acts
knows: a model that learns tastes from the session would pay a policy for its own guesses. Where the
log has all propensities, rows of new users are weighted, as policies that knew more than the log
shows make what they showed look better; known users are calibrated on weighted rows instead.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pydantic
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.errors import InputError, damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, load_weights
from ucfrec.processes import progress
from ucfrec.user_model.interest import find_user_rows
from ucfrec.user_model.reward import FITTED, MEMORY, ItemRewardModel
from ucfrec.user_model.reward_effects import (
    CHEAP,
    EFFECTS,
    LASTING,
    Beginning,
    Design,
    EffectSearch,
    fit_effects,
)
from ucfrec.user_model.reward_report import (
    SAVED,
    EffectTried,
    ItemRewardReport,
    Line,
    RewardRows,
    draw_episodes,
    fit_line,
    weigh_by_propensity,
)
from ucfrec.user_model.running import AGES, HALF_LIVES, RunningRates

_Report = TypeVar("_Report")
_USERS_FITTED = "training_users.safetensors"
"""File of the reward model of training users in its folder."""
_MAX_ROWS = 500_000
_MAX_STEPS = 100_000
_WARM_ROWS = 25_000
"""Most rows of a search that begins near an earlier one."""
_CONSTANT = 1e-6
_LEAST_KNOWN = 0.1
"""Least share of held-out rows of known users that can evaluate the effects in `LASTING`."""
_SPREAD = 0.4
"""Of effects of items and users where they only tell what items usually get."""
_FOLDS = 5
"""Parts of the decisions, each predicted by a fit to the others."""


@pydantic.dataclasses.dataclass(frozen=True, config=SAVED)
class TrainingUsersReport:
    """How the tastes of training users were found."""

    calibration: Line
    """Slope and intercept of the model's scores on training rows that were held back."""
    effects: tuple[EffectTried, ...]
    """The effects that were tried, evaluated on these rows."""


def reward_model_sizes(store: EpisodeStore) -> dict[str, int]:
    """Sizes of the reward model of a store of items, as `ItemRewardModel` takes them."""
    states = store.item_states
    items, dim = states.embeddings.shape
    sizes = {"state": store.state_size, "action": dim, "items": items}
    if store.has_offers:
        sizes["running"] = len(HALF_LIVES) + AGES
    return {**sizes, "users": len(states.user_features), "tags": states.tags.shape[1]}


def fit_item_reward_model(
    train: EpisodeStore,
    validation: EpisodeStore,
    folder: Path,
    seed: int,
    first: Path | None = None,
) -> tuple[ItemRewardModel, ItemRewardReport]:
    """Fit the model to training rows, or read it from `folder` if it was fitted before. InputError
    if a view has no steps, or all training rewards are equal.

    Effects are added one after the other, all fitted jointly. Validation rows choose the strength
    of each effect's penalty, and whether the effect is kept: if it lowers their mean loss by more
    than the standard error of the decrease.

    Where hardly any validation row is of a user with training rows, the model is for new users. A
    fifth of the training rows then chooses for the effects in `LASTING`: with unknown users,
    effects of items that contain those of the users who saw them predict best. The effects of users
    are dropped once those of items are known, but for how much users differ (`UserPosterior`).

    Args:
        seed: of the rows drawn from a view with too many.
        first: folder of the model of an earlier state of the store, near whose spreads the search
            begins and ends; where users are known, on fewer rows.
    """
    model = ItemRewardModel(reward_model_sizes(train))
    file = folder / FITTED
    if file.exists():
        return model, _read_fit(file, model, ItemRewardReport)
    views = train, validation
    rows, held_out = (RewardRows.of(view, model.lags, _MAX_ROWS, seed) for view in views)
    set_statistics(model, rows, held_out, train)
    design = Design.of(model, rows)
    new_users = _are_new(rows, held_out)
    if not new_users:
        design = _follow_users(model, design, train, rows)
    begin = Beginning.of(first, FITTED, design)
    validated = Design.of(model, held_out, fitted_users=design.fitted_users)
    search = EffectSearch(design, validated, begin)
    if new_users:
        rows, held_out = (RewardRows.of(view, MEMORY, _MAX_ROWS, seed) for view in views)
        search.sessions = model, rows.history, held_out.history
    elif begin.effects:
        search = EffectSearch(_select_some(design, seed), search.held_out, begin)
    none = rows.rewards.new_zeros(0)  # the design has what it needs of states and history
    rows = replace(rows, states=none, history=Shown(none, none))
    with progress(len(EFFECTS), "item rewards", "effects") as bar:
        lasting = EffectSearch(design, None, begin) if new_users else search
        for name in EFFECTS:
            if name not in LASTING and lasting is not search:
                search.take(lasting)
                search.forget_users()
                lasting = search
            lasting.add(name)
            if name == CHEAP[-1] and not begin.effects:
                lasting.adjust()
            bar.update()
        if not (new_users or begin.effects):
            search.adjust()
    if len(search.design.items) < len(rows):
        search.fit_to(design)
    report = ItemRewardReport(
        effects=search.report(),
        new_users=search.new_users,
        base_loss=search.base_loss,
        item_loss=search.item_loss,
        loss=float(search.losses.mean()),
    )
    search.save(file, model, report)
    return model, report


def refit_item_reward_model(
    first: Path,
    store: EpisodeStore,
    folder: Path,
    seed: int,
) -> ItemRewardModel:
    """Fit the effects that `fit_item_reward_model` kept in the folder `first`, as strong as there,
    to other rows of the view `store`."""
    tensors, metadata = load_tensors(first / FITTED)
    report = ItemRewardReport(**metadata)
    model = ItemRewardModel(reward_model_sizes(store))
    lags = MEMORY if report.new_users else model.lags
    rows = RewardRows.of(store, lags, _MAX_ROWS, seed)
    set_statistics(model, rows, rows, store)
    design = Design.of(model, rows)
    if "interest" in report.kept:
        design = _follow_users(model, design, store, rows)
    begin = Beginning.of(first, FITTED, design)
    search = EffectSearch(design, design, begin)
    if report.new_users:
        search.kept = {name: begin.spreads[name] for name in LASTING if name in begin.spreads}
        search.fit_to(design)
        search.forget_users()
        if "tastes" in begin.spreads:
            search.sessions = model, rows.history, rows.history
            search.set_tastes(tensors["tastes.root"])
    search.kept = begin.spreads
    search.fit_to(search.design)
    search.save(folder / FITTED, model, report)
    return model


def fit_training_users(
    train: EpisodeStore,
    folder: Path,
    seed: int,
    weighted: bool = True,
    first: Path | None = None,
) -> tuple[ItemRewardModel, TrainingUsersReport]:
    """Fit the effects of training users, or read them, as `fit_item_reward_model` does. A fifth of
    the rows of `draw_sessions` chooses; they are `weighted` by propensities, if there are any."""
    sizes = {**reward_model_sizes(train), "followed": 0}
    model = ItemRewardModel(sizes)
    file = folder / _USERS_FITTED
    if file.exists():
        return model, _read_fit(file, model, TrainingUsersReport)
    sessions = draw_sessions(train, seed)
    states = train.item_states
    weights = None
    episodes, steps = sessions.all_steps()
    rows = RewardRows.at(sessions, episodes, steps, model.lags)
    set_statistics(model, rows, rows, train)
    # What the session shows of tastes is known already: states are features and observations.
    model.state_std[: states.size - states.user_features.shape[1]] = torch.inf
    if weighted:
        weights = weigh_by_propensity(sessions, episodes, steps, len(model.item))
    design = Design.of(model, rows, weights)
    begin = Beginning.of(first, _USERS_FITTED, design)
    fewer = begin.effects and not weighted
    search = EffectSearch(_select_some(design, seed) if fewer else design, None, begin)
    with progress(len(EFFECTS), "training users", "effects") as bar:
        for name in EFFECTS:
            search.add(name)
            bar.update()
    held_out = search.held_out
    scores = held_out.predictor(search.effects)
    line = fit_line(scores, held_out.target, held_out.binary, held_out.weights)
    search.fit_to(design)
    report = TrainingUsersReport(line, search.report())
    search.save(file, model, report)
    return model, report


def score_unseen(
    model: ItemRewardModel,
    tried: Sequence[EffectTried],
    weighted: bool,
    sessions: EpisodeStore,
) -> tuple[RewardRows, Tensor]:
    """All steps of training sessions and their scores (M,), each by effects that are as strong as
    those of the model, but fitted to the other folds; to rows `weighted` by propensities or not."""
    episodes, steps = sessions.all_steps()
    rows = RewardRows.at(sessions, episodes, steps, model.lags)
    weights = weigh_by_propensity(sessions, episodes, steps, len(model.item)) if weighted else None
    design = Design.of(model, rows, weights)
    folds = design.decisions % _FOLDS
    spreads = {effect.effect: effect.spread for effect in tried if effect.kept}
    scores = torch.zeros(len(rows))
    for fold in range(_FOLDS):
        fitted = design.select(folds != fold)
        effects = fit_effects(fitted, fitted.mean_effect(), spreads)
        scores[folds == fold] = design.select(folds == fold).predictor(effects)
    return rows, scores


def draw_sessions(train: EpisodeStore, seed: int) -> EpisodeStore:
    """The training sessions, in an order drawn by `seed`; of many, the first 100,000 steps."""
    return train.select(draw_episodes(train, _MAX_STEPS, [seed, 5]))


def set_statistics(
    model: ItemRewardModel,
    rows: RewardRows,
    held_out: RewardRows,
    train: EpisodeStore,
) -> None:
    """Set the normalisation of states, rewards and embeddings from the training rows, and the
    running rates of items that come and go."""
    states = train.item_states
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
    rewards = rows.rewards.double()
    model.reward_mean.copy_(rewards.mean())
    model.reward_std.copy_(rewards.std(correction=0))
    exact = rows.states.double()
    mean, spread = exact.mean(0), exact.std(0, correction=0)
    del exact  # of a large catalogue, the next one takes as much memory
    model.state_mean.copy_(mean)
    constant = spread <= _CONSTANT * mean.abs().clamp(min=1.0)
    model.state_std.copy_(torch.where(constant, torch.inf, spread))
    mean = states.embeddings[rows.items].double().mean(0)
    exact = states.embeddings.double().sub_(mean)
    length = exact[rows.items].square_().sum(1).mean().sqrt()
    model.vectors.copy_(exact.div_(length.clamp(min=_CONSTANT)))
    model.likeness.start_from(states)
    model.rates = RunningRates.of(train, model.target)
    if model.rates is not None:
        last = torch.tensor([train.column(schema.TIMESTAMP).max()])
        model.latest.copy_(model.rates.rates[model.rates.bins.rows(last)[0]])


def _follow_users(
    model: ItemRewardModel,
    design: Design,
    train: EpisodeStore,
    rows: RewardRows,
) -> Design:
    """The design of `rows` with the interests of users, if these are named; sets what items usually
    get, and what users were shown at every time and at the end of training."""
    model.user_rows = find_user_rows(train.whole)
    if model.user_rows is None:
        return design
    effects = fit_effects(design, design.mean_effect(), dict.fromkeys(("item", "user"), _SPREAD))
    usual = effects["mean"] + effects["item"]
    model.interests.usual.copy_(torch.sigmoid(usual) if design.binary else usual)
    model.interests.add_rows(train.without_long_sessions(), model.target, model.sum_rows)
    return design.add_interests(model, model.sums_before(rows.users, rows.times))


def _are_new(rows: RewardRows, held_out: RewardRows) -> bool:
    """Whether there are users with training rows, but they have hardly any held-out rows."""
    trained = torch.unique(rows.users[rows.users >= 0])
    share = float(torch.isin(held_out.users, trained).float().mean())
    return bool(len(trained)) and share < _LEAST_KNOWN


def _read_fit(file: Path, model: ItemRewardModel, report: Callable[..., _Report]) -> _Report:
    tensors, metadata = load_tensors(file)
    load_weights(file, model, tensors)
    model.eval()
    with damage_explained(file, REMEDY):
        return report(**metadata)


def _select_some(design: Design, seed: int) -> Design:
    order = np.random.default_rng(seed).permutation(len(design.items))
    return design.select(torch.from_numpy(order < _WARM_ROWS))
