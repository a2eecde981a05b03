"""The decision rule: what turns a trained policy into what is shown, the same wherever it acts."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Annotated, Any, Self

import numpy as np
import torch
from pydantic import Field, PlainSerializer, PlainValidator
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.item_table import WINDOW
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.errors import InputError
from ucfrec.provenance import config_hash
from ucfrec.settings import Share, Weight, settings_table

_Return = Annotated[float, Field(ge=-1e12, le=1e12)]
_Items = Annotated[int, Field(ge=1, le=10**9)]
ListTerm = Callable[[Tensor], Tensor]
"""What items (B,) of lists add to the scores (B, n_items) of those below them."""
_COLDEST = 1e-30
"""Temperature below which dividing by it would leave the range of float32."""
_APART = -1e9
"""Difference of scores where the lower one is never drawn."""
_LAST = -1e40
"""Log-probability below those of float32: of items that are drawn once no others are left."""
_FEW = 2**16
"""Scores up to which looking for blocks first costs more."""
_BLOCK = 128
"""Items of the smallest block; maxima of fewer cost more."""


@settings_table("")
class DecisionRule:
    """How a trained policy decides: π(i) ∝ [π(i | s, Ĝ)^w · exp(β · f̂_r(s, i))]^(1/T) over what is
    allowed.

    With a lookahead V, f̂_r is instead r̂ + (1 − p_end) · V, in units of the range of rewards: what
    showing the item is expected to be rewarded with, and what follows if the session goes on.
    Policies with vector actions use the target alone. InputError if a value is out of range.
    """

    target: _Return
    """Target return, in units of the reward, of a session or of every step (`ReturnToGo`)."""
    minimum_target: _Return | None = None
    """Least target return, also once a session has reached its target; None for no minimum."""
    reward_weight: Weight = 0.0
    """Weight β of the reward model's log-odds of a reward, or standardised rewards; 0 for none."""
    policy_weight: Weight = 1.0
    """w, weight of the policy; 0 for none."""
    lookahead: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """V, expected return after the step, in reward units, if the session goes on; 0 for none."""
    temperature: Weight = 0.0
    """T; items are drawn, or, at 0, the best is taken."""
    top_k: _Items | None = None
    """Only this number of best items are drawn from; None for all."""
    by_marginal_gain: bool = False
    """Whether lists are built item by item, by what each adds to those above it, as the reward
    model says: f̂_r then counts how alike they are."""
    exclude_seen: bool = False
    """Whether items that the session has shown are excluded."""
    tag_window: Annotated[int, Field(ge=0, le=10**4)] = 0
    """Items that share a tag with one of this many last items are excluded, unless none remain."""
    tag_run: Annotated[int, Field(ge=0, le=WINDOW)] = 0
    """Items with the main tag of the so many shown before are excluded, if all of these had it and
    were liked, unless none remain; 0 for no such limit."""
    explore: Share = 0.0
    """Share of the requests whose items are drawn uniformly from all that are allowed."""
    explore_top: _Items | None = None
    """Such requests draw from the so many best items only; None for all."""

    def as_dict(self) -> dict[str, Any]:
        """The fields, as a JSON object; equal rules have the same one: 0 is not −0."""
        return {
            name: value + 0.0 if isinstance(value, float) else value
            for name, value in asdict(self).items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str) -> Self:
        """Rebuild a rule from its `as_dict`; InputError, with the `source`, if a field is wrong."""
        try:
            return cls(**values)
        except (InputError, TypeError) as error:
            raise InputError(f"{source} is not a decision rule: {error}") from None

    def __str__(self) -> str:
        has_policy = self.policy_weight > 0
        effect = f"{self.policy_weight:g}" if has_policy else "0 (the policy has no effect)"
        among = f"the {self.explore_top} best items" if self.explore_top else "all items"
        parts = {
            f"target {self.target:g}": has_policy,
            f"at least {self.minimum_target or 0.0:g} at every step": has_policy
            and self.minimum_target is not None,
            f"reward weight {self.reward_weight:g}": self.reward_weight,
            f"lookahead {self.lookahead:g}": self.lookahead,
            f"policy weight {effect}": self.policy_weight != 1,
            f"the {self.top_k} best": self.top_k,
            "lists by marginal gain": self.by_marginal_gain,
            "unseen items": self.exclude_seen,
            f"no tag of the last {self.tag_window}": self.tag_window,
            f"no main tag liked more than {self.tag_run} times in a row": self.tag_run,
            f"drawn at temperature {self.temperature:g}" if self.temperature else "argmax": True,
            f"{self.explore:.3g} of the requests uniformly from {among}": self.explore,
        }
        return ", ".join(text for text, applies in parts.items() if applies)

    @property
    def draws(self) -> bool:
        """Whether the items are random."""
        return self.temperature > 0 or self.explore > 0

    @property
    def looks_ahead(self) -> bool:
        """Whether scores count that a step may end the session."""
        return bool(self.reward_weight and self.lookahead)

    @property
    def hash(self) -> str:
        """12 hexadecimal digits that distinguish rules, for results."""
        return config_hash(self.as_dict())

    def target_returns(self, returns: ReturnToGo, collected: Tensor) -> Tensor:
        """Target returns at the next step, (B,) float64, of sessions that have `collected` (B,)."""
        targets = returns.target_returns(self.target, collected)
        return targets if self.minimum_target is None else targets.clamp(min=self.minimum_target)

    def log_probabilities(
        self,
        scores: Tensor,
        earlier: Tensor | None = None,
        term: ListTerm | None = None,
    ) -> Tensor:
        """Log-probabilities (nats) with which items are shown next in a list, (B, n_items).

        Args:
            scores: (B, n_items) of `Scorer.scores`.
            earlier: (B, P) int64 different items above, −1 for none; None at a first position.
            term: `Scorer.list_term`.
        """
        if term is not None and earlier is not None:
            turns = _Turns(self, scores, term)
            for items in earlier.unbind(1):
                turns.add(items, turns.next())
            joint = turns.joint.log_softmax(0).nan_to_num(nan=0.0, neginf=-torch.inf)
            return (joint.unsqueeze(2) + turns.next()).logsumexp(0).log_softmax(1).float()
        if earlier is None or not earlier.shape[1]:
            modes = self._modes(scores)
            first, *second = (logs.add_(math.log(share)) for share, logs in modes)
            return torch.logaddexp(first, second[0]) if second else first
        positions = torch.where(earlier < 0, scores.shape[1], earlier)
        so_far, never, next_items = list[Tensor](), list[Tensor](), list[Tensor]()
        for share, logs in self._list_modes(scores, positions.shape[1] + 1):
            # A further item that is never drawn stands for none.
            logs = F.pad(logs, (0, 1), value=-torch.inf)
            chances = _conditional(logs, positions).masked_fill(earlier < 0, 0.0)
            left = logs.scatter(1, positions, -torch.inf)[:, :-1].log_softmax(1)
            next_items.append(torch.nan_to_num(left, nan=-torch.inf))
            # Beside the chances of items that are never drawn, others would be rounded away.
            is_drawn = chances > _LAST / 2
            so_far.append(math.log(share) + chances.where(is_drawn, 0.0).sum(1, keepdim=True))
            never.append(chances.where(~is_drawn, 0.0).sum(1, keepdim=True))
        unlikely = torch.stack(never) < torch.stack(never).amax(0)
        shares = torch.stack(so_far).masked_fill(unlikely, -torch.inf).log_softmax(0)
        joint = (shares + torch.stack(next_items)).logsumexp(0)
        return torch.nan_to_num(joint - joint.logsumexp(1, keepdim=True), nan=-torch.inf).float()

    def log_probabilities_of(
        self,
        scores: Tensor,
        lists: Tensor,
        term: ListTerm | None,
    ) -> Tensor:
        """(B,) `log_probabilities` of the last items of lists (B, P) alone, which is faster."""
        earlier, items = lists.tensor_split([-1], dim=1)
        if self.explore or term is not None or not earlier.shape[1]:
            return self.log_probabilities(scores, earlier, term).gather(1, items)[:, 0]
        ((_, logs),) = self._list_modes(scores, lists.shape[1])
        logs = F.pad(logs, (0, 1), value=-torch.inf)
        numbers = torch.where(lists < 0, scores.shape[1], lists)
        last = _conditional(logs, numbers)[:, -1]
        return last.masked_fill((earlier == items).any(1), -torch.inf).float()

    def _list_modes(self, scores: Tensor, length: int) -> list[tuple[float, Tensor]]:
        """`_modes` in float64; in a list of this length, items that they never draw come last."""
        modes = [(share, logs.double()) for share, logs in self._modes(scores)]
        best = best_items(scores, min(length, scores.shape[1]))
        last = _LAST * torch.arange(1, best.shape[1] + 1).double()
        for _, logs in modes:
            logs.scatter_(1, best, logs.gather(1, best).maximum(last))
        return modes

    def choose(self, scores: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Items (B,) of scores (B, n_items), and the probabilities (B,) of choosing them."""
        if not self.draws:
            return _best(scores), torch.ones(len(scores))
        probabilities = self.log_probabilities(scores).exp_()
        items = torch.multinomial(probabilities, 1, generator=generator)
        return items[:, 0], probabilities.gather(1, items)[:, 0]

    def rank_items(
        self,
        scores: Tensor,
        k: int,
        uniforms: Tensor | None,
        term: ListTerm | None = None,
    ) -> tuple[Tensor, Tensor]:
        """`k` different items (B, k) in the order shown, best first or drawn one after the other,
        and their propensities (B, k) float64.

        Once all items that can be drawn have been, the others follow, best first. A propensity is
        the probability that the item is shown at its position, given those at the positions before.

        Args:
            scores: (B, n_items) of `Scorer.scores`; k at most n_items.
            uniforms: (B, n_items + 1) draws from [0, 1), needed if the rule `draws`; the last
                decides whether a request explores.
            term: `Scorer.list_term`; each item is then drawn as the first would be of what is left.
        """
        if term is not None:
            return self._rank_in_turn(scores, k, uniforms, term)
        if not self.draws:
            return best_items(scores, k), torch.ones(len(scores), k, dtype=torch.float64)
        assert uniforms is not None
        modes = self._list_modes(scores, k)
        logs = torch.where(uniforms[:, -1:] < self.explore, modes[-1][1], modes[0][1])
        # The largest sums of log-probability and Gumbel noise are draws without replacement.
        noise = uniforms[:, :-1].double().clamp(min=1e-300)
        items = (logs - torch.log(-torch.log(noise))).topk(k, dim=-1).indices
        if len(modes) == 1:
            return items, _conditional(logs, items).exp()
        exploiting, exploring = (
            math.log(share) + _conditional(logs, items).cumsum(1) for share, logs in modes
        )
        start = torch.zeros(len(items), 1, dtype=torch.float64)
        joint = torch.logaddexp(exploiting, exploring)
        return items, joint.diff(dim=1, prepend=start).exp()

    def _rank_in_turn(
        self,
        scores: Tensor,
        k: int,
        uniforms: Tensor | None,
        term: ListTerm,
    ) -> tuple[Tensor, Tensor]:
        """`rank_items` by scores that change from item to item."""
        if uniforms is None:
            uniforms = scores.new_zeros(len(scores), scores.shape[1] + 1)
        turns, explores = _Turns(self, scores, term), uniforms[:, -1:] < self.explore
        ranked, totals = list[Tensor](), [turns.joint.logsumexp(0)]
        for draws in torch.split(uniforms[:, :k].double(), 1, dim=1):
            modes = turns.next()
            sums = torch.where(explores, modes[-1], modes[0]).exp().cumsum(1)
            levels = draws.clamp(max=1 - 1e-9) * sums[:, -1:]
            items = torch.searchsorted(sums, levels, right=True)[:, 0]
            turns.add(items, modes)
            ranked.append(items)
            totals.append(turns.joint.logsumexp(0))
        log_propensities = torch.stack(totals, 1).diff(dim=1)
        return torch.stack(ranked, 1), log_propensities.exp().clamp(max=1.0)

    def _modes(self, scores: Tensor) -> list[tuple[float, Tensor]]:
        """Ways in which a request may be answered: its share, and log-probabilities (B, n_items) of
        the first item."""
        modes: list[tuple[float, Tensor]] = []
        if self.explore < 1:
            if self.temperature == 0:
                best = _best(scores).unsqueeze(1)
                logs = torch.full_like(scores, -torch.inf).scatter(1, best, 0.0)
            else:
                drawn_from = _only_best(scores, self.top_k)
                # Relative to the best, so that no temperature makes every score −∞.
                relative = drawn_from - drawn_from.amax(-1, keepdim=True)
                logs = relative.div_(max(self.temperature, _COLDEST)).log_softmax(-1)
            modes.append((1 - self.explore, logs))
        if self.explore > 0:
            allowed = _only_best(scores, self.explore_top)
            even = torch.zeros_like(allowed).masked_fill(torch.isneginf(allowed), -torch.inf)
            modes.append((self.explore, even.log_softmax(-1)))
        return modes


class _Turns:
    """Lists of B requests that are built item by item, by scores that change with each."""

    def __init__(self, rule: DecisionRule, scores: Tensor, term: ListTerm) -> None:
        self._rule, self._scores, self._term = rule, scores, term
        self._taken = torch.zeros_like(scores, dtype=torch.bool)
        shares = [share for share in (1 - rule.explore, rule.explore) if share > 0]
        log_shares = torch.tensor(shares).double().log()
        self.joint = log_shares.unsqueeze(1).expand(-1, len(scores))
        """(M, B) log-probabilities of the items so far, and of being answered in each mode."""

    def next(self) -> Tensor:
        """(M, B, n_items) float64 log-probabilities of the next item, in each mode."""
        left = self._scores.masked_fill(self._taken, -torch.inf)
        # Once nothing that may be shown is left, the others follow, the lowest number first.
        fallback = (_APART * torch.arange(left.shape[1])).masked_fill(self._taken, -torch.inf)
        left = torch.where(left.amax(1, keepdim=True) > -torch.inf, left, fallback)
        return torch.stack([logs.double() for _, logs in self._rule._modes(left)])

    def add(self, items: Tensor, modes: Tensor) -> None:
        """Show items (B,) next, −1 for none, drawn from the log-probabilities of `next`."""
        valid, column = (items >= 0).unsqueeze(1), items.clamp(min=0).unsqueeze(1)
        logs = modes.gather(2, column.expand(len(modes), -1, 1))[:, :, 0]
        self.joint = self.joint + logs.masked_fill(~valid[:, 0], 0.0)
        self._scores = self._scores + self._term(column[:, 0]).masked_fill(~valid, 0.0)
        self._taken = self._taken | torch.zeros_like(self._taken).scatter(1, column, valid)


SavedRule = Annotated[
    DecisionRule,
    PlainValidator(
        lambda v: v if isinstance(v, DecisionRule) else DecisionRule.from_dict(v, "the rule")
    ),
    PlainSerializer(DecisionRule.as_dict),
]
"""A rule as an entry of a record."""


def _only_best(scores: Tensor, count: int | None) -> Tensor:
    """The scores (B, n), −∞ but for the `count` best."""
    if count is None or count >= scores.shape[1]:
        return scores
    best = best_items(scores, count)
    return torch.full_like(scores, -torch.inf).scatter(1, best, scores.gather(1, best))


def _conditional(logs: Tensor, items: Tensor) -> Tensor:
    """Log-probabilities of items (B, k) drawn in this order without replacement, each given those
    before it, from the log-probabilities (B, n) float64 of a single draw."""
    of_items = logs.gather(1, items)
    remainder = logs.scatter(1, items, -torch.inf).logsumexp(-1, keepdim=True)
    # What is left before each draw is summed from the end, so that nothing cancels.
    from_last = torch.cat([remainder, of_items.flip(1)], dim=1)
    left = from_last.logcumsumexp(1).flip(1)[:, :-1]
    return (of_items - left).clamp(max=0.0)


def best_items(scores: Tensor, k: int) -> Tensor:
    """Numbers (B, k) of the k highest scores (B, n), best first, and of equal scores the lowest
    number first; k at most n.

    The k best of all lie in the k blocks of items with the highest maxima, so a pass that finds the
    maxima is all that reads every score. A row is read again where its k + 1 best are not distinct.
    """
    if torch.compiler.is_exporting():  # ONNX's TopK puts the lowest number first
        return scores.topk(k, dim=-1).indices
    if k == 1:
        return _best(scores).unsqueeze(1)
    values, numbers = _some_best(scores, min(k + 1, scores.shape[1]))
    ties = values[:, 1:] == values[:, :-1]
    for row in ties.any(1).nonzero()[:, 0].tolist():
        of_row, last = scores[row].numpy(), values[row, k - 1].item()
        above = np.flatnonzero(of_row > last)
        best = np.append(above, np.flatnonzero(of_row == last)[: k - len(above)])
        best = best[np.argsort(-of_row[best], kind="stable")]
        numbers[row, :k] = torch.from_numpy(best)
    return numbers[:, :k]


def _best(scores: Tensor) -> Tensor:
    """Numbers (B,) of the highest scores (B, n), the first of equal ones."""
    # NumPy finds them ten times as fast as torch.
    return torch.from_numpy(scores.numpy().argmax(1))


def _some_best(scores: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The highest scores (B, k) and their numbers; any of equal scores may come first."""
    n = scores.shape[1]
    # Both searches that follow the pass are of about the same size.
    size = max(_BLOCK, round((n / k) ** 0.5))
    blocks = n // size
    if scores.numel() < _FEW or 3 * k > blocks:
        return scores.topk(k, dim=-1)
    maxima = scores[:, : blocks * size].view(len(scores), blocks, size).amax(-1)
    first = maxima.topk(k, dim=-1, sorted=False).indices * size
    numbers = (first.unsqueeze(-1) + torch.arange(size)).flatten(1)
    remainder = torch.arange(blocks * size, n).expand(len(scores), -1)
    numbers = torch.cat([numbers, remainder], dim=1)
    values, places = scores.gather(1, numbers).topk(k, dim=-1)
    return values, numbers.gather(1, places)
