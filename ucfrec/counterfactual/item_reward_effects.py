"""The effects that add up to the expected reward of an item, and their penalised fit."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.counterfactual.item_reward_model import ItemRewardModel
from ucfrec.counterfactual.item_reward_rows import RewardRows

EFFECTS: Final = ("item", "user", "content", "affinity", "exposure", "state", "interaction")
"""In the order in which they are added to the model."""
_ITERATIONS: Final = 100
_TOLERANCE: Final = 1e-6
"""Relative change of the objective at which a fit ends."""
_CHUNK: Final = 65_536

Effects = dict[str, Tensor]
FloatArray = npt.NDArray[np.float64]


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
    """(M, 2 · lags): whether the item is the one shown n steps before, then their likeness."""
    target: Tensor
    """(M,): 1 for the higher of two rewards and 0 for the lower, or standardised rewards."""
    vectors: Tensor
    """(n_items, D) centred embeddings of all items."""
    rows: Tensor
    """(M, D) those of `items`."""
    tags: Tensor
    """(n_items, T) int64, padded with `n_tags`."""
    n_tags: int
    n_users: int
    binary: bool

    @classmethod
    def of(cls, model: ItemRewardModel, rows: RewardRows) -> "Design":
        """The design of `rows`, with the statistics of `model`."""
        likeness, last = model.likeness, len(model.user) - 1
        n_tags = int(likeness.n_tags)
        known = (rows.users >= 0) & (rows.users < last)
        return cls(
            items=rows.items,
            users=torch.where(known, rows.users, last),
            x=model.standardised(rows.states),
            exposure=_exposure(model, rows),
            target=model.target(rows.rewards),
            vectors=model.vectors,
            rows=model.vectors[rows.items],
            tags=torch.where(likeness.tags < 0, n_tags, likeness.tags),
            n_tags=n_tags,
            n_users=last,
            binary=bool(model.binary),
        )

    def zeros(self, name: str) -> Tensor:
        """The effect `name`, all zero, float32."""
        dim, state = self.vectors.shape[1], self.x.shape[1]
        shapes: Mapping[str, tuple[int, ...]] = {
            "mean": (),
            "item": (len(self.vectors),),
            "user": (self.n_users + 1,),
            "content": (self.n_tags + dim,),
            "affinity": (self.n_users + 1, dim),
            "exposure": (self.exposure.shape[1],),
            "state": (state,),
            "interaction": (state, dim),
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
        if "exposure" in effects:
            total = total + self.exposure @ effects["exposure"]
        if "state" in effects:
            total = total + self.x @ effects["state"]
        if "affinity" in effects:
            total = total + (F.embedding(self.users, effects["affinity"]) * self.rows).sum(1)
        if "interaction" in effects:
            total = total + ((self.x @ effects["interaction"]) * self.rows).sum(1)
        return total

    def of_content(self, content: Tensor) -> Tensor:
        """Effects (n_items,) of the items' tags and embeddings."""
        tags = F.pad(content[: self.n_tags], (0, 1))
        return tags[self.tags].sum(1) + self.vectors @ content[self.n_tags :]

    def squares(self, name: str) -> Tensor:
        """Sum over rows of the squares of what each number of the effect `name` multiplies."""
        vectors = self.rows.square()
        sums = self.zeros(name)
        if name == "mean":
            return sums + len(self.items)
        if name == "item":
            return sums.index_add(0, self.items, torch.ones(len(self.items)))
        if name == "user":
            return sums.index_add(0, self.users, torch.ones(len(self.items)))
        if name == "content":
            tags = torch.bincount(self.tags[self.items].flatten(), minlength=self.n_tags + 1)
            return torch.cat([tags[: self.n_tags].float(), vectors.sum(0)])
        if name == "affinity":
            return sums.index_add(0, self.users, vectors)
        if name == "exposure":
            return self.exposure.square().sum(0)
        if name == "state":
            return self.x.square().sum(0)
        return self.x.square().T @ vectors

    def loss(self, predictor: Tensor) -> Tensor:
        """Log loss in nats, or half the squared error of standardised rewards, (M,)."""
        if self.binary:
            return F.binary_cross_entropy_with_logits(predictor, self.target, reduction="none")
        return 0.5 * (predictor - self.target).square()


def _exposure(model: ItemRewardModel, rows: RewardRows) -> Tensor:
    parts = []
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        items, shown = rows.items[part].unsqueeze(1), rows.shown[part]
        likeness = model.likeness
        columns = [
            likeness.to_items(likeness.profile(earlier, torch.ones_like(earlier).float()), items)
            for earlier in shown.unsqueeze(1).unbind(2)
        ]
        parts.append(torch.cat([(shown == items).float(), torch.stack(columns, 1)], 1))
    return torch.cat(parts)


def fit_effects(design: Design, start: Effects, spreads: Mapping[str, float]) -> Effects:
    """Minimise the summed loss of `design` plus the penalties of the effects named in `spreads`.

    The penalty of an effect is that of a Gaussian prior under which its contribution to the
    predictor of a mean row has the standard deviation given as its spread.

    Args:
        design: training rows.
        start: effects to start from; missing ones start at 0.
        spreads: of every effect of the fit.
    """
    from scipy.optimize import minimize

    names = ("mean", *spreads)
    curvature, penalty = 0.25 if design.binary else 1.0, {}
    units = {}
    for name in names:
        squares = design.squares(name)
        share = float(squares.sum() / len(design.items))
        penalty[name] = share / spreads[name] ** 2 if name in spreads else 0.0
        # In these units the objective is about as curved in all numbers.
        units[name] = (curvature * squares + penalty[name]).clamp(min=1e-6).rsqrt()
    shapes = {name: units[name].shape for name in names}
    first = {name: start.get(name, design.zeros(name)) / units[name] for name in names}

    def objective(flat: FloatArray) -> tuple[float, FloatArray]:
        scaled = dict(_unflattened(flat, shapes))
        for value in scaled.values():
            value.requires_grad_(True)
        effects = {name: scaled[name] * units[name] for name in names}
        loss = design.loss(design.predictor(effects)).sum(dtype=torch.float64)
        for name in spreads:
            loss = loss + 0.5 * penalty[name] * effects[name].square().sum(dtype=torch.float64)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss.item(), _flattened({name: scaled[name].grad for name in names})

    found = minimize(
        objective, _flattened(first), jac=True, method="L-BFGS-B",
        options={"maxiter": _ITERATIONS, "ftol": _TOLERANCE, "maxcor": 10},
    )  # fmt: skip
    return {name: value * units[name] for name, value in _unflattened(found.x, shapes)}


def _flattened(values: Mapping[str, Tensor | None]) -> FloatArray:
    return np.concatenate(
        [v.numpy().astype(np.float64).ravel() for v in values.values() if v is not None]
    )


def _unflattened(
    flat: FloatArray, shapes: Mapping[str, torch.Size]
) -> Iterator[tuple[str, Tensor]]:
    start = 0
    for name, shape in shapes.items():
        part = flat[start : start + shape.numel()]
        yield name, torch.from_numpy(part.astype(np.float32)).view(shape)
        start += shape.numel()
