"""The search of effects of the reward model of items, one after the other, by held-out loss."""

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ucfrec.episodes.windows import Shown
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors
from ucfrec.progress import Progress
from ucfrec.user_model.reward import ItemRewardModel, root_of_tastes
from ucfrec.user_model.reward_effects import EFFECTS, Design, Effects, fit_effects
from ucfrec.user_model.reward_report import EffectTried

_SPREADS: Final = tuple(0.05 * 2 ** (k / 2) for k in range(13))
_FIRST: Final = 6
"""Index of the spread that is tried first, 0.4."""
_CHEAP: Final = ("item", "user", "content")
"""Effects whose spreads are searched finely, and adjusted to each other."""
_STRIDES: Final = {**dict.fromkeys(_CHEAP, (2, 1)), "tastes": ()}
"""Steps of the search of a spread, (2,) for others; one number alone needs no search."""
_KNOWN: Final = 0.1
"""Least share of held-out rows of known users that can evaluate the effects in `LASTING`."""
_SCALES: Final = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Standard deviations of tastes that are tried, relative to the noise of single steps."""
LASTING: Final = ("item", "user", "content", "affinity")
"""Effects that are distinguished by users who were shown several items."""
_ROWS: Final = 512
"""Rows whose tastes are found at once; more leave the processor's cache."""


def effects_of_items(effects: Effects) -> Effects:
    return {name: effects[name] for name in ("item", "content") if name in effects}


def set_usual(model: ItemRewardModel, design: Design, effects: Effects) -> None:
    """Set usual rewards of items, for `UserPosterior`, from the effects of mean and items."""
    everywhere = effects["mean"] + effects.get("item", torch.zeros(()))
    if "content" in effects:
        everywhere = everywhere + design.of_content(effects["content"])
    model.tastes.usual.copy_(torch.sigmoid(everywhere) if design.binary else everywhere)


def added_by_tastes(model: ItemRewardModel, shown: Shown, items: Tensor) -> Tensor:
    """What `UserPosterior` of weight 1, after what was shown in M sessions, add to the scores (M,)
    of items (M,)."""
    model.tastes.weigh(1.0)
    added = []
    for start in range(0, len(items), _ROWS):
        part = slice(start, start + _ROWS)
        tastes = model.tastes_after(shown.at(part))
        added.append(tastes[:, 0] + (tastes[:, 1:] * model.vectors[items[part]]).sum(1))
    return torch.cat(added)


@dataclass(frozen=True)
class Beginning:
    """What a fit to older or fewer rows found, where a search or a fit begins."""

    spreads: dict[str, int]
    """Numbers of the spreads of the effects that it kept."""
    effects: Effects
    """Its effects; those of new users and items are 0."""

    @classmethod
    def of(cls, file: Path, design: Design) -> "Beginning | None":
        """Read what `save_fit` wrote, in the sizes of `design`; None if it is not there.

        Raises:
            InputError: a file is damaged.
        """
        if not file.exists():
            return None
        effects = Effects()
        with damage_explained(file, REMEDY):
            entries = [EffectTried(**effect) for effect in load_tensors(file)[1]["effects"]]
            for name, old in load_tensors(_beside(file))[0].items():
                new = design.zeros(name)
                if old.dtype != new.dtype or not old.isfinite().all():
                    raise ValueError(f"{name} has other values than finite float32")
                if new.shape == old.shape:
                    effects[name] = old
                elif name in ("item", "user", "affinity") and new.shape[1:] == old.shape[1:]:
                    # The last row of effects of users is that of unknown ones.
                    known = old if name == "item" else old[:-1]
                    new[: len(known)] = known
                    effects[name] = new
        spreads = np.array(_SPREADS)
        numbers = {
            effect.effect: int(np.abs(spreads - effect.spread).argmin()) for effect in entries
        }
        return cls(
            {effect.effect: numbers[effect.effect] for effect in entries if effect.kept}, effects
        )


def save_fit(
    file: Path, model: ItemRewardModel, effects: Effects, report: Mapping[str, Any]
) -> None:
    """Write a fitted model with its report, and its effects beside it; `file` is complete last."""
    file.parent.mkdir(parents=True, exist_ok=True)
    save_tensors(_beside(file), effects, {})
    save_tensors(file, model.state_dict(), dict(report))


def _beside(file: Path) -> Path:
    return file.with_stem(file.stem + "_effects")


class ShownBefore(NamedTuple):
    """What the sessions of rows showed before them, where users are new."""

    model: ItemRewardModel
    """Its `tastes` are set while effects are searched."""
    training: Shown
    held_out: Shown


class EffectSearch:
    """The effects found so far, and their loss on held-out rows."""

    shown: ShownBefore | None = None
    """Where users are new; needed to learn tastes within the session."""

    def __init__(self, design: Design, held_out: Design, begin: Beginning | None = None) -> None:
        """Args:
        design: training rows.
        held_out: rows that choose.
        begin: where to begin; None for a search from scratch.
        """
        self.design, self.held_out, self._begin = design, held_out, begin
        self.effects = design.mean_effect()
        self.kept: dict[str, int] = {}
        self.new_users = False
        self._fixed: Effects = {}
        self._root: Tensor | None = None
        self.losses = self._losses(self.effects)
        self.base_loss = self.item_loss = float(self.losses.mean())
        self.tried: list[EffectTried] = []

    def add(self, name: str) -> None:
        """Add the effect `name` with the best spread, if it lowers the held-out loss."""
        if name == "tastes" and self._root is not None:
            self._scale_tastes(self._root)
        no_one = bool((self.design.users == self.design.n_users).all())
        if not self.design.squares(name).any() or (no_one and name in ("user", "affinity")):
            return
        near, strides = _FIRST, _STRIDES.get(name, (2,))
        if self._begin is not None:
            spreads = self._begin.spreads
            near, strides = spreads.get(name, _FIRST), (1,) if name in spreads else ()
        at, (effects, losses) = self._best(name, near, strides)
        decrease = self.losses - losses
        gain = float(decrease.mean())
        error = float(decrease.std(correction=0)) / len(decrease) ** 0.5
        self.tried.append(EffectTried(name, _SPREADS[at], gain, error, gain > error))
        if name == "item":
            self.item_loss = float(losses.mean())
        if gain > error:
            self.effects, self.losses, self.kept[name] = effects, losses, at

    def add_all(self, bar: Progress, effects: Collection[str]) -> None:
        """Add every one of `effects` that lowers the held-out loss."""
        search = self.of_training() if self.of_new_users else self
        for name in EFFECTS:
            if search is not self and name not in LASTING:
                self._take(search)
                self._forget_users()
                search = self
            if name in effects:
                search.add(name)
            if name == _CHEAP[-1] and search._begin is None:
                search.adjust()
            bar.update()

    @property
    def of_new_users(self) -> bool:
        """Whether hardly any held-out row is of a user with training rows."""
        seen = self._seen()
        return bool(seen.any()) and float(seen[self.held_out.users].float().mean()) < _KNOWN

    def _seen(self) -> Tensor:
        """(n_users + 1,) bool: users with training rows."""
        seen = torch.bincount(self.design.users, minlength=self.design.n_users + 1) > 0
        seen[-1] = False
        return seen

    def of_training(self) -> "EffectSearch":
        """A search that is evaluated on a fifth of the training rows."""
        rows = len(self.design.items)
        held_back = torch.arange(rows) % 5 == min(4, rows - 1)
        parts = self.design.select(~held_back), self.design.select(held_back)
        return EffectSearch(*parts, self._begin)

    def _take(self, search: "EffectSearch") -> None:
        """Fit the effects that `search` keeps, with its spreads, to all training rows."""
        self.tried, at = list(search.tried), search.kept
        if "item" in at:
            _, (_, losses) = self._best("item", at["item"], ())
            self.item_loss = float(losses.mean())
        for name in at:
            self.kept[name] = at[name]
        if at:
            last = [*at][-1]
            _, (self.effects, self.losses) = self._best(last, at[last], ())

    def _forget_users(self) -> None:
        """Fit further effects as for new users, with the effects of items as they are."""
        if self.shown is not None and "affinity" in self.effects:
            seen = self._seen()
            level = self.effects.get("user", torch.zeros(len(seen)))[seen]
            tastes = torch.cat([level.unsqueeze(1), self.effects["affinity"][seen]], 1)
            self._root = root_of_tastes(tastes, self.design.rows)
        self.new_users, self._fixed = True, effects_of_items(self.effects)
        self.design = self.design.of_unknown_users()
        self.effects = fit_effects(self.design, self.design.mean_effect(), {}, self._fixed)
        self.losses = self._losses(self.effects)

    def _scale_tastes(self, root: Tensor) -> None:
        """Choose how much users differ, relative to noise, by the held-out loss."""
        assert self.shown is not None
        model, *shown = self.shown
        set_usual(model, self.design, self.effects)

        def tell(scale: float) -> None:
            model.tastes.root.copy_(scale * root)
            self.design, self.held_out = (
                replace(design, tastes=added_by_tastes(model, earlier, design.items))
                for design, earlier in zip((self.design, self.held_out), shown, strict=True)
            )

        def loss(scale: float) -> float:
            tell(scale)
            return float(self._best("tastes", _FIRST, ())[1][1].mean())

        tell(min(_SCALES, key=loss))

    def adjust(self) -> None:
        """Choose the spreads of the effects found so far again, each given the others."""
        for name in [*self.kept]:
            self.kept[name], (self.effects, self.losses) = self._best(name, self.kept[name], (1,))

    def fit_to(self, design: Design) -> None:
        """Fit the effects that were kept to other rows."""
        spreads = {name: _SPREADS[number] for name, number in self.kept.items()}
        self.design = design
        # Effects of the earlier state rest on about as many rows; those of the search on few.
        start = self.effects | ({} if self._begin is None else self._begin.effects)
        self.effects = fit_effects(design, start, spreads)
        self.losses = self._losses(self.effects)

    def report(self) -> tuple[EffectTried, ...]:
        """The effects tried, with the final spreads of those that were kept."""
        return tuple(
            dataclasses.replace(entries, spread=_SPREADS[self.kept[entries.effect]])
            if entries.kept
            else entries
            for entries in self.tried
        )

    def _best(
        self, name: str, at: int, strides: tuple[int, ...]
    ) -> tuple[int, tuple[Effects, Tensor]]:
        """Index of the best spread of the effect `name` near `at`, the fit, and its losses."""
        fits: dict[int, tuple[Effects, Tensor]] = {}

        def loss(index: int) -> float:
            if not 0 <= index < len(_SPREADS):
                return float("inf")
            if index not in fits:
                spreads = {effect: _SPREADS[number] for effect, number in self.kept.items()}
                if self.new_users:
                    spreads = {
                        effect: spreads[effect] for effect in spreads if effect not in LASTING
                    }
                spreads[name] = _SPREADS[index]
                start = self.effects
                if self._begin is not None:
                    start = self._begin.effects | start
                    if fits:
                        start = fits[min(fits, key=lambda i: abs(i - index))][0]
                effects = fit_effects(self.design, start, spreads, self._fixed)
                fits[index] = effects, self._losses(effects)
            return float(fits[index][1].mean())

        for stride in strides:
            for step in (stride, -stride):
                start = at
                while loss(at + step) < loss(at):
                    at += step
                if at != start:
                    break
        loss(at)
        return at, fits[at]

    def _losses(self, effects: Effects) -> Tensor:
        return self.held_out.loss(self.held_out.predictor(effects)).double()
