"""The effects that add up to the expected reward of an item, and their penalised fit."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_report import RewardRows

EFFECTS: Final = (
    *("item", "user", "content", "affinity", "tastes", "exposure"),
    *("context", "state", "interaction"),
)
"""In the order in which they are added to the model."""
_ITERATIONS: Final = 100
_HISTORY: Final = 10
"""Steps that L-BFGS remembers."""
_TOLERANCE: Final = 1e-6
"""Relative decrease of the objective in an iteration at which a fit ends."""
_ARMIJO, _SHORTEST = 1e-4, 1e-4
"""Least decrease of a step relative to the slope, and shortest step that is tried."""
_SMALLEST: Final = 1e-6
_CHUNK: Final = 65_536

Effects = dict[str, Tensor]


@dataclass(frozen=True)
class Design:
    """What the effects of M rows are computed from."""

    items: Tensor
    """(M,) int64."""
    users: Tensor
    """(M,) int64; the last number is that of unknown users."""
    x: Tensor
    """(M, S) standardised states."""
    exposure: Tensor
    """(M, 4 · lags): whether the item is the one shown n steps before, then their likeness; then
    both again, times the earlier item's reward on a scale from 0 to 1."""
    target: Tensor
    """(M,): 1 for the higher of two rewards and 0 for the lower, or standardised rewards."""
    observed: Tensor
    """(M, O) the last of `x`: the observations."""
    vectors: Tensor
    """(n_items, D) centred embeddings of all items."""
    rows: Tensor
    """(M, D) those of `items`."""
    tags: Tensor
    """(n_items, T) int64, padded with `n_tags`."""
    n_tags: int
    n_users: int
    binary: bool
    weights: Tensor
    """(M,) how many rows each row counts for."""
    tastes: Tensor
    """(M,) what `UserPosterior` of weight 1 add; zeros if sessions show nothing."""

    @classmethod
    def of(
        cls, model: ItemRewardModel, rows: RewardRows, weights: Tensor | None = None
    ) -> "Design":
        """The design of `rows`, with the statistics of `model`; without `weights` all count one."""
        likeness, last = model.likeness, len(model.user) - 1
        n_tags = int(likeness.n_tags)
        x = model.standardised(rows.states)
        is_known = (rows.users >= 0) & (rows.users < last)
        return cls(
            items=rows.items,
            users=torch.where(is_known, rows.users, last),
            x=x,
            observed=x[:, x.shape[1] - rows.observations :],
            exposure=_exposure(model, rows),
            target=model.target(rows.rewards),
            vectors=model.vectors,
            rows=model.vectors[rows.items],
            tags=torch.where(likeness.tags < 0, n_tags, likeness.tags),
            n_tags=n_tags,
            n_users=last,
            binary=bool(model.binary),
            weights=torch.ones(len(rows)) if weights is None else weights,
            tastes=torch.zeros(len(rows)),
        )

    def select(self, rows: Tensor) -> "Design":
        """The design of the rows where a bool mask (M,) is true."""
        return replace(
            self,
            items=self.items[rows],
            users=self.users[rows],
            x=self.x[rows],
            observed=self.observed[rows],
            exposure=self.exposure[rows],
            target=self.target[rows],
            rows=self.rows[rows],
            weights=self.weights[rows],
            tastes=self.tastes[rows],
        )

    def of_unknown_users(self) -> "Design":
        """The same rows as if no user were known."""
        return replace(self, users=torch.full_like(self.users, self.n_users))

    def zeros(self, name: str) -> Tensor:
        """The effect `name`, all zero, float32."""
        dim, state = self.vectors.shape[1], self.x.shape[1]
        shapes: Mapping[str, tuple[int, ...]] = {
            "mean": (),
            "tastes": (),
            "item": (len(self.vectors),),
            "user": (self.n_users + 1,),
            "content": (self.n_tags + dim,),
            "affinity": (self.n_users + 1, dim),
            "exposure": (self.exposure.shape[1],),
            "state": (state,),
            "interaction": (state, dim),
            "context": (self.observed.shape[1], dim),
        }
        return torch.zeros(shapes[name])

    def predictor(self, effects: Effects) -> Tensor:
        """Linear predictors (M,) as the sum of the given effects."""
        total = effects["mean"].expand(len(self.items))
        if "item" in effects:
            total = total + effects["item"][self.items]
        if "content" in effects:
            total = total + self.of_content(effects["content"])[self.items]
        if "user" in effects:
            total = total + effects["user"][self.users]
        if "tastes" in effects:
            total = total + self.tastes * effects["tastes"]
        if "exposure" in effects:
            total = total + self.exposure @ effects["exposure"]
        if "state" in effects:
            total = total + self.x @ effects["state"]
        if "affinity" in effects:
            total = total + (F.embedding(self.users, effects["affinity"]) * self.rows).sum(1)
        if "interaction" in effects:
            total = total + ((self.x @ effects["interaction"]) * self.rows).sum(1)
        if "context" in effects:
            total = total + ((self.observed @ effects["context"]) * self.rows).sum(1)
        return total

    def of_content(self, content: Tensor) -> Tensor:
        """Effects (n_items,) of the items' tags and embeddings."""
        tags = F.pad(content[: self.n_tags], (0, 1))
        return tags[self.tags].sum(1) + self.vectors @ content[self.n_tags :]

    def squares(self, name: str) -> Tensor:
        """Weighted sum over rows of the squares of what each number of the effect multiplies."""
        weight = self.weights.unsqueeze(1)
        vectors, sums = weight * self.rows.square(), self.zeros(name)
        match name:
            case "mean":
                return sums + self.count
            case "item":
                return sums.index_add(0, self.items, self.weights)
            case "user":
                return sums.index_add(0, self.users, self.weights)
            case "content":
                tags = self.tags[self.items]
                counts = torch.zeros(self.n_tags + 1)
                counts.index_add_(0, tags.flatten(), weight.expand(tags.shape).flatten())
                return torch.cat([counts[: self.n_tags], vectors.sum(0)])
            case "affinity":
                return sums.index_add(0, self.users, vectors)
            case "context":
                return self.observed.square().T @ vectors
            case "tastes":
                return (self.weights * self.tastes.square()).sum()
            case "exposure":
                return (weight * self.exposure.square()).sum(0)
            case "state":
                return (weight * self.x.square()).sum(0)
        return self.x.square().T @ vectors

    @property
    def count(self) -> float:
        """The sum of the weights."""
        return float(self.weights.sum(dtype=torch.float64))

    def penalty(self, name: str, spread: float) -> float:
        """Precision of the prior of the effect `name`, twice the factor of its squares.

        Under a Gaussian prior of this precision, the effect's contribution to the predictor of a
        mean row has the standard deviation `spread`.
        """
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


def _exposure(model: ItemRewardModel, rows: RewardRows) -> Tensor:
    parts = []
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        items, shown = rows.items[part].unsqueeze(1), rows.shown.at(part).latest(model.lags)
        liked, alike = model.liked(shown.rewards), model.likeness.between(shown.items, items)
        repeated = (shown.items == items).float()
        parts.append(torch.cat([repeated, alike, repeated * liked, alike * liked], 1))
    return torch.cat(parts)


def fit_effects(
    design: Design, start: Effects, spreads: Mapping[str, float], fixed: Effects | None = None
) -> Effects:
    """Minimise the summed loss of `design` plus penalties on the effects named in `spreads`.

    Args:
        start: effects to start from; missing ones start at 0.
        spreads: of every effect of the fit; see `Design.penalty`.
        fixed: effects that are part of the predictor, and of the result, as they are.
    """
    constant = fixed or {}
    names = ("mean", *spreads)
    curvature = 0.25 if design.binary else 1.0
    penalty = {name: design.penalty(name, spreads[name]) for name in spreads}
    units = {name: _units(design, name, curvature, penalty.get(name, 0.0)) for name in names}
    first = {name: units[name].of(start.get(name, design.zeros(name))) for name in names}
    sizes = [value.numel() for value in first.values()]

    def effects_of(numbers: Tensor) -> Effects:
        parts = zip(first.items(), torch.split(numbers, sizes), strict=True)
        return {
            name: units[name].effect(part.view(first_numbers.shape))
            for (name, first_numbers), part in parts
        }

    def objective(numbers: Tensor) -> Tensor:
        effects = effects_of(numbers)
        loss = design.loss(design.predictor(constant | effects)).sum(dtype=torch.float64)
        for name in spreads:
            loss = loss + 0.5 * penalty[name] * effects[name].square().sum(dtype=torch.float64)
        return loss

    start_numbers = torch.cat([part.flatten() for part in first.values()])
    return constant | effects_of(minimum(objective, start_numbers))


def minimum(objective: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """The numbers (P,) at which a convex function is lowest, by L-BFGS from `start`.

    Its second derivative should be about 1 in all directions, because the first step, and the first
    step that every line search tries, has the length that this implies.
    """

    def evaluated(at: Tensor) -> tuple[float, Tensor]:
        at = at.detach().requires_grad_(True)
        value = objective(at)
        (gradient,) = torch.autograd.grad(value, at)
        return value.item(), gradient

    at, (value, gradient) = start, evaluated(start)
    history: deque[tuple[Tensor, Tensor]] = deque(maxlen=_HISTORY)
    for _ in range(_ITERATIONS):
        direction = -_newton(gradient, history)
        slope, length = float(gradient @ direction), 1.0
        while True:
            following = at + length * direction
            value_there, gradient_there = evaluated(following)
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


@dataclass(frozen=True)
class _Units:
    """Units of an effect in which the objective is about as curved in all directions."""

    effect: Callable[[Tensor], Tensor]
    """The effect, from numbers in these units."""
    of: Callable[[Tensor], Tensor]
    """Its inverse."""


def _units(design: Design, name: str, curvature: float, penalty: float) -> _Units:
    if name in ("state", "exposure"):
        inputs = design.x if name == "state" else design.exposure
        factor, inverse = _factors(curvature * _moments(design, inputs), penalty)
        return _Units(lambda numbers: inverse @ numbers, lambda effect: factor @ effect)
    if name in ("context", "interaction"):
        x = design.observed if name == "context" else design.x
        # The curvature is about a Kronecker product of two second moments, each with a part of the
        # penalty.
        scale = (curvature / design.count) ** 0.5
        of_states, of_items = (scale * _moments(design, rows) for rows in (x, design.rows))
        ratio = float(of_states.diagonal().mean() / of_items.diagonal().mean())
        left, left_inverse = _factors(of_states, (penalty * ratio) ** 0.5)
        right, right_inverse = _factors(of_items, (penalty / ratio) ** 0.5)
        return _Units(
            lambda numbers: left_inverse @ numbers @ right_inverse.T,
            lambda effect: left @ effect @ right.T,
        )
    unit = (curvature * design.squares(name) + penalty).clamp(min=_SMALLEST).rsqrt()
    return _Units(lambda numbers: numbers * unit, lambda effect: effect / unit)


def _moments(design: Design, inputs: Tensor) -> Tensor:
    return inputs.T @ (design.weights.unsqueeze(1) * inputs)


def _factors(moments: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    """U and its inverse with UᵀU = moments + ridge · I, for square matrices."""
    whole = moments.double() + (ridge + _SMALLEST) * torch.eye(len(moments), dtype=torch.float64)
    upper = torch.linalg.cholesky(whole).T
    identity = torch.eye(len(moments), dtype=torch.float64)
    return upper.float(), torch.linalg.solve_triangular(upper, identity, upper=True).float()
