"""The effects that add up to the expected reward of an item: their penalised fit, their search."""

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.windows import Shown
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors
from ucfrec.user_model.reward import (
    ItemRewardModel,
    compare_to_history,
    list_inputs,
    root_of_tastes,
)
from ucfrec.user_model.reward_report import EffectTried, RewardRows, mean_gain

LASTING = ("running", "item", "interest", "user", "content", "affinity", "position", "above")
"""Effects that are distinguished by users who were shown several items."""
EFFECTS = (*LASTING, "tastes", "exposure", "context", "state", "interaction")
"""In the order in which they are added to the model."""
_ITERATIONS = 100
_HISTORY = 10
"""Steps that L-BFGS remembers, …"""
_REMEMBERED = 3 * 2**23
"""… in at most so many numbers, or 2 steps; twice, for the changes of the gradient."""
_TOLERANCE = 1e-6
"""Relative decrease of the objective in an iteration at which a fit ends."""
_ARMIJO, _SHORTEST = 1e-4, 1e-4
"""Least decrease of a step relative to the slope, and shortest step that is tried."""
_SMALLEST = 1e-6
_SPREADS = tuple(0.05 * 2 ** (k / 2) for k in range(13))
_FIRST = 6
"""Index of the spread that is tried first, 0.4."""
CHEAP = ("item", "user", "content")
"""Effects whose spreads are searched finely, and adjusted to each other."""
_STRIDES = {**dict.fromkeys(CHEAP, (2, 1)), "tastes": ()}
"""Steps of the search of a spread, (2,) for others; one number alone needs no search."""
_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Standard deviations of tastes that are tried, relative to the noise of single steps."""
_FIXED = ("running", "item", "content", "position", "above")
"""Those of items and of lists, which stay as they are where users are forgotten."""
_SHARED = ("exposure", "running", "state", "position", "above", "interest")
"""Effects of numbers of a row, whatever its item."""
_ROWS = 512
"""Rows whose tastes are found at once; more leave the processor's cache."""

Effects = dict[str, Tensor]
_Map = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Design:
    """What the effects of M rows are computed from."""

    items: Tensor
    users: Tensor
    """(M,) int64 places in `fitted_users`; its length stands for other users."""
    x: Tensor
    """(M, S) standardised states."""
    exposure: Tensor
    """(M, 4 · lags): whether the item is that of n steps before, then their likeness; then both
    again, times the earlier reward from 0 to 1."""
    target: Tensor
    """(M,): 1 for the higher of two rewards and 0 for the lower, or standardised rewards."""
    observed: Tensor
    """(M, O) the last of `x`: the observations."""
    vectors: Tensor
    """(n_items, D) centred embeddings of all items."""
    rows: Tensor
    tags: Tensor
    """(n_items, T) int64, padded with `n_tags`."""
    n_tags: int
    fitted_users: Tensor
    """(U,) int64, ascending: numbers of the users whose effects are fitted."""
    binary: bool
    weights: Tensor
    """(M,) how many rows each row counts for."""
    running: Tensor
    """(M, R) inputs of `RunningRates`; R is 0 where items are always available."""
    position: Tensor
    above: Tensor
    """What `list_inputs` give; (M, 0) where there are no lists."""
    interest: Tensor
    """(M, D + 1) products of users' rates and (1, vector) of items, see `Interests`; or (M, 0)."""
    tastes: Tensor
    """(M,) what `UserPosterior` of weight 1 add; zeros if sessions show nothing."""

    @classmethod
    def of(
        cls,
        model: ItemRewardModel,
        rows: RewardRows,
        weights: Tensor | None = None,
        fitted_users: Tensor | None = None,
    ) -> "Design":
        """The design of `rows`, by statistics of `model`; by default users' effects are fitted."""
        likeness = model.likeness
        if fitted_users is None:
            fitted_users = torch.unique(rows.users[rows.users >= 0])
        n_tags = int(likeness.n_tags)
        x, history = model.standardise(rows.states), rows.history.latest(model.lags)
        repeated = (history.items == rows.items.unsqueeze(1)).float()
        alike = compare_to_history(likeness, history.items, rows.items)
        both = torch.cat([repeated, alike], 1)
        liked = model.scale_rewards(history.rewards).repeat(1, 2)
        position, above = list_inputs(likeness, rows.above, rows.items)
        none = torch.zeros(len(rows), 0)
        design = cls(
            items=rows.items,
            users=_find_users(fitted_users, rows.users),
            x=x,
            observed=x[:, x.shape[1] - rows.observations :],
            exposure=torch.cat([both, both * liked], 1),
            target=model.target(rows.rewards),
            vectors=model.vectors,
            rows=model.vectors[rows.items],
            tags=torch.where(likeness.tags < 0, n_tags, likeness.tags),
            n_tags=n_tags,
            fitted_users=fitted_users,
            binary=bool(model.binary),
            weights=torch.ones(len(rows)) if weights is None else weights,
            running=none
            if rows.offer is None or model.rates is None
            else model.rates.inputs(rows.offer, rows.items),
            position=position if rows.above.shape[1] else none,
            above=above if rows.above.shape[1] else none,
            interest=none,
            tastes=torch.zeros(len(rows)),
        )
        if model.user_rows is None:
            return design
        return design.add_interests(model, model.sums_before(rows.users, rows.times))

    def select(self, rows: Tensor) -> "Design":
        """The design of the rows where a bool mask (M,) is true."""
        of_items = ("vectors", "tags", "n_tags", "fitted_users", "binary")
        names = [part.name for part in dataclasses.fields(self) if part.name not in of_items]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def add_interests(self, model: ItemRewardModel, sums: Tensor) -> "Design":
        """The same rows, of users with `sums` (M, D + 2) of what they were shown until then."""
        inputs = F.pad(self.rows, (1, 0), value=1.0)
        return replace(self, interest=model.interests.rates(sums) * inputs)

    def forget_users(self) -> "Design":
        """The same rows as if no user were known."""
        return replace(self, users=torch.full_like(self.users, len(self.fitted_users)))

    def zeros(self, name: str) -> Tensor:
        """The effect `name`, all zero, float32."""
        dim, state = self.vectors.shape[1], self.x.shape[1]
        shapes: Mapping[str, tuple[int, ...]] = {
            "mean": (),
            "tastes": (),
            "item": (len(self.vectors),),
            "user": (len(self.fitted_users) + 1,),
            "content": (self.n_tags + dim,),
            "affinity": (len(self.fitted_users) + 1, dim),
            **{shared: self.inputs(shared).shape[1:] for shared in _SHARED},
            "interaction": (state, dim),
            "context": (self.observed.shape[1], dim),
        }
        return torch.zeros(shapes[name])

    def predictor(self, effects: Effects) -> Tensor:
        """Linear predictors (M,) as the sum of the given effects."""
        terms: dict[str, _Map] = {
            "item": lambda numbers: numbers[self.items],
            "content": lambda numbers: self.sum_content(numbers)[self.items],
            "user": lambda numbers: numbers[self.users],
            "tastes": lambda number: self.tastes * number,
            **{shared: self.inputs(shared).matmul for shared in _SHARED},
            "affinity": lambda rows: (F.embedding(self.users, rows) * self.rows).sum(1),
            "interaction": lambda matrix: ((self.x @ matrix) * self.rows).sum(1),
            "context": lambda matrix: ((self.observed @ matrix) * self.rows).sum(1),
        }
        total = effects["mean"].expand(len(self.items))
        for name, term in terms.items():
            if name in effects:
                total = total + term(effects[name])
        return total

    def sum_content(self, content: Tensor) -> Tensor:
        """Effects (n_items,) of the items' tags and embeddings."""
        tags = F.pad(content[: self.n_tags], (0, 1))
        return tags[self.tags].sum(1) + self.vectors @ content[self.n_tags :]

    def squares(self, name: str) -> Tensor:
        """Weighted sum over rows of the squares of what each number of the effect multiplies."""
        weight, sums = self.weights.unsqueeze(1), self.zeros(name)
        vectors = weight * self.rows.square()
        match name:
            case "mean":
                return sums + self.count
            case "item":
                return sums.index_add(0, self.items, self.weights)
            case "user":
                return sums.index_add(0, self.users, self.weights)
            case "affinity":
                return sums.index_add(0, self.users, vectors)
            case "content":
                tags = self.tags[self.items]
                counts = torch.zeros(self.n_tags + 1)
                counts.index_add_(0, tags.flatten(), weight.expand(tags.shape).flatten())
                return torch.cat([counts[: self.n_tags], vectors.sum(0)])
            case "tastes":
                return (self.weights * self.tastes.square()).sum()
            case _ if name in _SHARED:
                return (weight * self.inputs(name).square()).sum(0)
        return self.inputs(name).square().T @ vectors

    def inputs(self, name: str) -> Tensor:
        """The inputs (M, …) that the effect `name` multiplies, the same for all items of a row."""
        fields = {"context": "observed", "state": "x", "interaction": "x"}
        values: Tensor = getattr(self, fields.get(name, name))
        return values

    @property
    def decisions(self) -> Tensor:
        """(M,) int64 numbers of the decisions that rows in the order of a log belong to."""
        return (~self.position.any(1)).cumsum(0) - 1

    @property
    def count(self) -> float:
        """The sum of the weights."""
        return float(self.weights.sum(dtype=torch.float64))

    def penalty(self, name: str, spread: float) -> float:
        """Precision of the Gaussian prior of the effect `name` under which it adds a number of the
        standard deviation `spread` to the predictor of a mean row."""
        return float(self.squares(name).sum()) / self.count / spread**2

    def loss(self, predictor: Tensor) -> Tensor:
        """Weighted log loss in nats, or half the squared error of standardised rewards, (M,)."""
        if self.binary:
            return F.binary_cross_entropy_with_logits(
                predictor, self.target, self.weights, reduction="none"
            )
        return self.weights * (0.5 * (predictor - self.target).square())

    def mean_effect(self) -> Effects:
        """The effect `mean` alone, of the weighted mean of what is predicted."""
        mean = (self.weights * self.target).sum() / self.weights.sum()
        return {"mean": torch.logit(mean, _SMALLEST) if self.binary else mean}


def fit_effects(
    design: Design,
    start: Effects,
    spreads: Mapping[str, float],
    fixed: Effects | None = None,
) -> Effects:
    """Minimise the summed loss of `design` plus penalties on the effects of given `spreads`, from
    `start`, or 0; `fixed` effects are part of the predictor, and of the result, as they are."""
    constant, curvature = fixed or {}, 0.25 if design.binary else 1.0
    penalty = {name: design.penalty(name, spreads[name]) for name in spreads}
    first, inverses = Effects(), dict[str, _Map]()
    for name in ("mean", *spreads):
        scale, inverses[name] = _scale(design, name, curvature, penalty.get(name, 0.0))
        first[name] = scale(start.get(name, design.zeros(name)))
    sizes = [value.numel() for value in first.values()]

    def unpack(numbers: Tensor) -> Effects:
        parts = zip(first.items(), torch.split(numbers, sizes), strict=True)
        return {name: inverses[name](part.view(value.shape)) for (name, value), part in parts}

    def objective(numbers: Tensor) -> Tensor:
        effects = unpack(numbers)
        loss = design.loss(design.predictor(constant | effects)).sum(dtype=torch.float64)
        for name in spreads:
            loss = loss + 0.5 * penalty[name] * effects[name].square().sum(dtype=torch.float64)
        return loss

    numbers = torch.cat([part.flatten() for part in first.values()])
    return constant | unpack(minimum(objective, numbers))


def minimum(objective: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """The numbers (P,) at which a convex function is lowest, by L-BFGS from `start`; the first step
    has the right length if the second derivative is about 1 in all directions."""

    def evaluate(at: Tensor) -> tuple[float, Tensor]:
        at = at.detach().requires_grad_(True)
        value = objective(at)
        (gradient,) = torch.autograd.grad(value, at)
        return value.item(), gradient

    at, (value, gradient) = start, evaluate(start)
    steps = max(2, min(_HISTORY, _REMEMBERED // len(start)))
    history: deque[tuple[Tensor, Tensor]] = deque(maxlen=steps)
    for _ in range(_ITERATIONS):
        direction = -_newton(gradient, history)
        slope, length = float(gradient @ direction), 1.0
        while True:
            following = at + length * direction
            value_there, gradient_there = evaluate(following)
            if value_there <= value + _ARMIJO * length * slope:
                break
            length /= 2
            if length < _SHORTEST:
                return at
        change = gradient_there - gradient
        if float(change @ direction) > 0:
            history.append((following - at, change))
        decrease = value - value_there
        at, value, gradient = following, value_there, gradient_there
        if decrease <= _TOLERANCE * abs(value):
            break
    return at


def _newton(gradient: Tensor, history: deque[tuple[Tensor, Tensor]]) -> Tensor:
    """The gradient times the inverse of the second derivative that `history` gives."""
    result, weights = gradient.clone(), []
    for step, change in reversed(history):
        weights.append(float(step @ result) / float(step @ change))
        result.sub_(change, alpha=weights[-1])
    if history:
        step, change = history[-1]
        result.mul_(float(step @ change) / float(change @ change))
    for (step, change), weight in zip(history, reversed(weights), strict=True):
        result.add_(step, alpha=weight - float(change @ result) / float(step @ change))
    return result


def _scale(
    design: Design,
    name: str,
    curvature: float,
    penalty: float,
) -> tuple[_Map, _Map]:
    """Maps of an effect to units in which the objective is about evenly curved, and back."""
    if name in _SHARED:
        factor, inverse = _factors(curvature * _moments(design, design.inputs(name)), penalty)
        return factor.matmul, inverse.matmul
    if name in ("context", "interaction"):
        # The curvature is about a Kronecker product of two second moments, each with a part of the
        # penalty.
        scale = (curvature / design.count) ** 0.5
        of_states = scale * _moments(design, design.inputs(name))
        of_items = scale * _moments(design, design.rows)
        ratio = float(of_states.diagonal().mean() / of_items.diagonal().mean())
        left, left_inverse = _factors(of_states, (penalty * ratio) ** 0.5)
        right, right_inverse = _factors(of_items, (penalty / ratio) ** 0.5)
        return lambda x: left @ x @ right.T, lambda x: left_inverse @ x @ right_inverse.T
    unit = (curvature * design.squares(name) + penalty).clamp(min=_SMALLEST).rsqrt()
    return lambda x: x / unit, lambda x: x * unit


def _moments(design: Design, inputs: Tensor) -> Tensor:
    """Weighted second moments, float64: ages and rates of items differ by orders of magnitude."""
    moments = torch.zeros((inputs.shape[1],) * 2, dtype=torch.float64)
    for rows in torch.split(torch.arange(len(inputs)), 2**14):
        part, weights = inputs[rows].double(), design.weights[rows]
        moments += part.T @ (weights.unsqueeze(1) * part)
    return moments


def _factors(moments: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    """U and its inverse with UᵀU = moments + ridge · I, for square matrices."""
    identity = torch.eye(len(moments), dtype=torch.float64)
    upper = torch.linalg.cholesky(moments + (ridge + _SMALLEST) * identity).T
    return upper.float(), torch.linalg.solve_triangular(upper, identity, upper=True).float()


@dataclass(frozen=True)
class Beginning:
    """What a fit to older or fewer rows found, where a search or a fit begins; nothing at first."""

    spreads: dict[str, int]
    """Numbers of the spreads of the effects that it kept."""
    effects: Effects
    """Its effects; those of new users and items are 0."""

    @classmethod
    def of(
        cls,
        folder: Path | None,
        name: str,
        design: Design,
    ) -> "Beginning":
        """Read what `EffectSearch.save` wrote, if there is any, in the sizes of `design`."""
        effects = Effects()
        if folder is None or not (file := folder / name).exists():
            return cls({}, effects)
        with damage_explained(file, REMEDY):
            entries = [EffectTried(**effect) for effect in load_tensors(file)[1]["effects"]]
            for name, old in load_tensors(place_effects(file))[0].items():
                new = design.zeros(name)
                if old.dtype != new.dtype or not old.isfinite().all():
                    raise ValueError(f"{name} has other values than finite float32")
                if name in ("user", "affinity") and new.shape[1:] == old.shape[1:]:
                    # The last row is that of unknown users, and of those who came since.
                    users = F.pad(design.fitted_users, (0, 1), value=-1)
                    effects[name] = old[users.clamp(max=len(old) - 1)]
                elif new.shape == old.shape:
                    effects[name] = old
                elif name == "item" and old.ndim == 1:
                    effects[name] = F.pad(old, (0, len(new) - len(old)))
        numbers = np.abs(np.subtract.outer([e.spread for e in entries], _SPREADS)).argmin(1)
        pairs = zip(entries, numbers.tolist(), strict=True)
        return cls({entry.effect: number for entry, number in pairs if entry.kept}, effects)


class EffectSearch:
    """The effects found so far, one after the other, and their loss on held-out rows."""

    sessions: tuple[ItemRewardModel, Shown, Shown] | None = None
    """For new users: the model, whose `tastes` are set, and what training and held-out rows saw."""

    def __init__(
        self,
        design: Design,
        held_out: Design | None,
        begin: Beginning,
    ) -> None:
        """Held-out rows choose; None for a fifth of the training rows."""
        if held_out is None:
            decisions = design.decisions
            chooses = decisions % 5 == min(4, int(decisions[-1]))
            design, held_out = design.select(~chooses), design.select(chooses)
        self.design, self.held_out, self._begin = design, held_out, begin
        self.effects = design.mean_effect()
        self.kept: dict[str, int] = {}
        """Numbers of the spreads of the effects that are part of the model."""
        self.new_users = False
        self._fixed: Effects = {}
        self._root: Tensor | None = None
        self.losses = self._losses(self.effects)
        self.base_loss = self.item_loss = float(self.losses.mean())
        self._tried: list[EffectTried] = []

    @property
    def _spreads(self) -> dict[str, float]:
        left_out = LASTING if self.new_users else ()
        return {name: _SPREADS[n] for name, n in self.kept.items() if name not in left_out}

    def _find_trained(self) -> Tensor:
        """(U + 1,) bool: users with training rows."""
        count = len(self.design.fitted_users) + 1
        trained = torch.bincount(self.design.users, minlength=count) > 0
        trained[-1] = False
        return trained

    def add(self, name: str) -> None:
        """Add the effect `name` with the best spread, if it lowers the held-out loss."""
        if name == "tastes" and self._root is not None:
            root = self._root

            def loss(scale: float) -> float:
                self.set_tastes(scale * root)
                return float(self._find_best("tastes", _FIRST, ())[2].mean())

            # How much users differ, relative to noise, is chosen by the held-out loss.
            self.set_tastes(min(_SCALES, key=loss) * root)
        no_one = not (self.design.users < len(self.design.fitted_users)).any()
        if not self.design.squares(name).any() or (no_one and name in ("user", "affinity")):
            return
        near, strides = _FIRST, _STRIDES.get(name, (2,))
        if self._begin.effects:
            spreads = self._begin.spreads
            near, strides = spreads.get(name, _FIRST), (1,) if name in spreads else ()
        number, effects, losses = self._find_best(name, near, strides)
        gain, error = mean_gain(self.losses, losses)
        self._tried.append(EffectTried(name, _SPREADS[number], gain, error, gain > error))
        if name == "item":
            self.item_loss = float(losses.mean())
        if gain > error:
            self.effects, self.losses, self.kept[name] = effects, losses, number

    def adjust(self) -> None:
        """Choose the spreads of the effects found so far again, each given the others."""
        for name in [*self._spreads]:
            best = self._find_best(name, self.kept[name], (1,))
            self.kept[name], self.effects, self.losses = best

    def take(self, search: "EffectSearch") -> None:
        """Fit the effects that `search` keeps, with its spreads, to all training rows."""
        self._tried = list(search._tried)
        self.kept = {name: number for name, number in search.kept.items() if name == "item"}
        self.fit_to(self.design)
        self.item_loss = float(self.losses.mean())
        self.kept = dict(search.kept)
        self.fit_to(self.design)

    def forget_users(self) -> None:
        """Fit further effects as for new users, with the effects of items as they are."""
        if self.sessions is not None and "affinity" in self.effects:
            trained = self._find_trained()
            level = self.effects.get("user", torch.zeros(len(trained)))[trained]
            tastes = torch.cat([level.unsqueeze(1), self.effects["affinity"][trained]], 1)
            self._root = root_of_tastes(tastes, F.pad(self.design.rows, (1, 0), value=1.0))
        self.new_users = True
        self._fixed = Effects((name, self.effects[name]) for name in _FIXED if name in self.effects)
        self.design = self.design.forget_users()
        self.effects = fit_effects(self.design, self.design.mean_effect(), {}, self._fixed)
        self.losses = self._losses(self.effects)

    def set_tastes(self, root: Tensor) -> None:
        """Let the sessions tell tastes, whose covariance has the root, beside `effects`."""
        assert self.sessions is not None
        model, *histories = self.sessions
        usual = self.effects["mean"] + self.effects.get("item", torch.zeros(()))
        if "content" in self.effects:
            usual = usual + self.design.sum_content(self.effects["content"])
        model.tastes.usual.copy_(torch.sigmoid(usual) if self.design.binary else usual)
        model.tastes.root.copy_(root)
        model.tastes.weigh(torch.ones(()))

        def add_tastes(design: Design, history: Shown) -> Design:
            parts = []
            for part in torch.split(torch.arange(len(design.items)), _ROWS):
                tastes = model.tastes_after(history.at(part), None)
                parts.append(tastes[:, 0] + (tastes[:, 1:] * design.rows[part]).sum(1))
            return replace(design, tastes=torch.cat(parts))

        self.design = add_tastes(self.design, histories[0])
        self.held_out = add_tastes(self.held_out, histories[1])

    def fit_to(self, design: Design) -> None:
        """Fit the effects that were kept to other rows, from those of an earlier state if any."""
        start, self.design = design.mean_effect() | self._begin.effects, design
        self.effects = fit_effects(design, start, self._spreads, self._fixed)
        self.losses = self._losses(self.effects)

    def report(self) -> tuple[EffectTried, ...]:
        """The effects tried, with the final spreads of those that were kept."""
        return tuple(
            replace(entry, spread=_SPREADS[self.kept[entry.effect]]) if entry.kept else entry
            for entry in self._tried
        )

    def _find_best(
        self,
        name: str,
        number: int,
        strides: tuple[int, ...],
    ) -> tuple[int, Effects, Tensor]:
        """Number of the best spread of the effect `name` near `number`, the fit, and its losses."""
        fits: dict[int, tuple[Effects, Tensor]] = {}

        def loss(index: int) -> float:
            if not 0 <= index < len(_SPREADS):
                return float("inf")
            if index not in fits:
                start = self._begin.effects | self.effects
                if self._begin.effects and fits:
                    start = fits[min(fits, key=lambda i: abs(i - index))][0]
                spreads = self._spreads | {name: _SPREADS[index]}
                effects = fit_effects(self.design, start, spreads, self._fixed)
                fits[index] = effects, self._losses(effects)
            return float(fits[index][1].mean())

        for stride in strides:
            for step in (stride, -stride):
                first = number
                while loss(number + step) < loss(number):
                    number += step
                if number != first:
                    break
        loss(number)
        return number, *fits[number]

    def save(
        self,
        file: Path,
        model: ItemRewardModel,
        report: Any,
    ) -> None:
        """Write the model with its effects, the report, and effects beside; `file` comes last."""
        effects = dict(self.effects)
        for name in effects.keys() & {"user", "affinity"}:
            effects[name] = self._expand_users(effects[name], len(model.user))
        model.set_effects(effects, self.design.sum_content)
        file.parent.mkdir(parents=True, exist_ok=True)
        save_tensors(place_effects(file), effects, {})
        save_tensors(file, model.state_dict(), dataclasses.asdict(report))

    def _expand_users(self, effect: Tensor, count: int) -> Tensor:
        """An effect of users by their numbers in the store, 0 for those without rows."""
        table = effect.new_zeros((count, *effect.shape[1:]))
        table[F.pad(self.design.fitted_users, (0, 1), value=-1)] = effect
        return table

    def _losses(self, effects: Effects) -> Tensor:
        return self.held_out.loss(self.held_out.predictor(effects)).double()


def _find_users(fitted_users: Tensor, users: Tensor) -> Tensor:
    """Places (M,) of users in `fitted_users` (U,), ascending; U for others."""
    places = torch.searchsorted(fitted_users, users)
    is_fitted = F.pad(fitted_users, (0, 1), value=-2)[places] == users
    return torch.where(is_fitted, places, len(fitted_users))


def place_effects(file: Path) -> Path:
    return file.with_stem(file.stem + "_effects")
