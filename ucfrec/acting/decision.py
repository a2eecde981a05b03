"""The decision rule: what turns a trained policy into what is shown, the same wherever it acts."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
import torch
from torch import Tensor

from ucfrec.acting.best_items import best_items
from ucfrec.episodes.exposure import Likeness, Shown
from ucfrec.episodes.item_table import WINDOW
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.provenance import config_hash
from ucfrec.user_model.main_tags import MainTags

if TYPE_CHECKING:
    from ucfrec.user_model.reward import ItemRewardModel


_RANGES: Final = {
    "target": (-1e12, 1e12),
    "floor": (-1e12, 1e12),
    "reward_weight": (0.0, 1e6),
    "temperature": (0.0, 1e6),
    "top_k": (1, 10**9),
    "tag_window": (0, 10**4),
    "tag_run": (0, WINDOW),
}
_COLDEST: Final = 1e-30
"""Temperature below which dividing by it would leave the range of float32."""
_OPTIONAL: Final = ("target", "floor", "top_k")
_WHOLE: Final = ("top_k", "tag_window", "tag_run")


@dataclass(frozen=True)
class DecisionRule:
    """How a trained policy decides: π(i) ∝ [π(i | s, Ĝ) · exp(β · f̂_r(s, i))]^(1/T) over what is
    allowed.

    Policies with vector actions use the target alone.

    Raises:
        InputError: a value is out of range.
    """

    target: float | None
    """Target return in units of the training reward, of a session or of every step (`ReturnToGo`);
    None for the largest return that the policy expects in each state."""
    floor: float | None = None
    """Returns-to-go asked for are held above this, also once a session has reached its target; None
    for no floor."""
    reward_weight: float = 0.0
    """β, weight of the reward model, whose predictions are log-odds of a reward, or rewards in
    standard deviations; 0 for none."""
    temperature: float = 0.0
    """T; items are drawn, or, at 0, the best is taken."""
    top_k: int | None = None
    """Only the so many best items are drawn from; None for all."""
    exclude_seen: bool = False
    """Whether items that the session has shown are left out."""
    tag_window: int = 0
    """Items that share a tag with one of so many shown before are left out, unless none remain."""
    tag_run: int = 0
    """Items with the main tag of the so many shown before are left out, if all of these had it and
    were liked, unless none remain; 0 for no such limit."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is None and name in _OPTIONAL:
                continue
            whole, kinds = name in _WHOLE, (int, np.integer)
            right = isinstance(value, kinds if whole else (*kinds, float, np.floating))
            if not right or isinstance(value, bool) or not low <= value <= high:
                number = "whole number" if whole else "finite number"
                raise InputError(
                    f"the decision rule has {name} {value!r}; give a {number} from {low:g} to "
                    f"{high:g}"
                )
            # Equal rules have equal types, and so the same hash.
            object.__setattr__(self, name, int(value) if whole else float(value) + 0.0)
        if not isinstance(self.exclude_seen, bool):
            raise InputError(
                f"the decision rule has exclude_seen {self.exclude_seen!r}; give true or false"
            )

    def as_dict(self) -> dict[str, Any]:
        """The fields, as a JSON object."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str) -> Self:
        """Rebuild a rule from its `as_dict`.

        Args:
            values: the fields.
            source: where they come from, for messages.

        Raises:
            InputError: a field is unknown, missing, of another type or out of range.
        """
        known = {each.name for each in fields(cls)}
        if "target" not in values or not values.keys() <= known:
            raise InputError(
                f"{source} is not a decision rule: it has the fields {', '.join(values)}; it needs "
                f"target and knows {', '.join(sorted(known))}"
            )
        try:
            return cls(**values)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None

    def __str__(self) -> str:
        target = "the largest return expected" if self.target is None else f"{self.target:g}"
        parts = [f"target {target}"]
        parts += [] if self.floor is None else [f"at least {self.floor:g} at every step"]
        parts += [f"reward weight {self.reward_weight:g}"] if self.reward_weight else []
        parts += [f"the {self.top_k} best"] if self.top_k else []
        parts += ["unseen items"] if self.exclude_seen else []
        parts += [f"no tag of the last {self.tag_window}"] if self.tag_window else []
        parts += (
            [f"no main tag liked more than {self.tag_run} times on end"] if self.tag_run else []
        )
        how = f"drawn at temperature {self.temperature:g}" if self.temperature else "argmax"
        return ", ".join([*parts, how])

    @property
    def hash(self) -> str:
        """12 hexadecimal digits that tell rules apart, for results."""
        values = self.as_dict()
        if not self.tag_run:
            # Rows measured before there were tag runs keep their hash.
            del values["tag_run"]
        return config_hash(values)

    def asked(self, returns: ReturnToGo, collected: Tensor, best: Tensor | None) -> Tensor:
        """What is asked for at the next step, (B,) float64, in reward units.

        Args:
            returns: what returns-to-go count.
            collected: (B,) rewards earlier in the session.
            best: (B,) the largest returns that the policy expects; needed without a target.
        """
        if self.target is None:
            assert best is not None
            asked = best.double()
        else:
            asked = returns.asked(self.target, collected)
        return asked if self.floor is None else asked.clamp(min=self.floor)

    def log_probabilities(self, scores: Tensor) -> Tensor:
        """Log-probabilities (nats) with which items are shown, (B, n_items).

        Args:
            scores: (B, n_items) of `Decider.scores`.
        """
        if self.temperature == 0:
            best = scores.argmax(-1, keepdim=True)
            return torch.full_like(scores, -torch.inf).scatter(1, best, 0.0)
        if self.top_k is not None and self.top_k < scores.shape[1]:
            lowest = scores.topk(self.top_k, dim=-1).values[:, -1:]
            scores = scores.masked_fill(scores < lowest, -torch.inf)
        # Relative to the best, so that no temperature makes every score −∞.
        relative = scores - scores.amax(-1, keepdim=True)
        return (relative / max(self.temperature, _COLDEST)).log_softmax(-1)

    def choose(self, scores: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Items (B,) and the probabilities (B,) with which they were chosen.

        Args:
            scores: (B, n_items) of `Decider.scores`.
            generator: of the draws.
        """
        if self.temperature == 0:
            return scores.argmax(-1), torch.ones(len(scores))
        probabilities = self.log_probabilities(scores).exp()
        items = torch.multinomial(probabilities, 1, generator=generator)
        return items[:, 0], probabilities.gather(1, items)[:, 0]

    def ranked(self, scores: Tensor, k: int, uniforms: Tensor | None) -> Tensor:
        """`k` different items (B, k), best first, or drawn one after the other.

        Once all of the `top_k` items have been drawn, the others follow, best first.

        Args:
            scores: (B, n_items) of `Decider.scores`; k at most n_items.
            k: number of items.
            uniforms: (B, n_items) draws from [0, 1); needed at a temperature above 0.
        """
        if self.temperature > 0:
            assert uniforms is not None
            # The largest sums of log-probability and Gumbel noise are draws without replacement.
            noise = uniforms.double().clamp(min=1e-300)
            drawn = self.log_probabilities(scores) - torch.log(-torch.log(noise))
            found = drawn.topk(k, dim=-1)
            if not torch.isneginf(found.values).any():
                return found.indices
            by_score = scores.argsort(dim=-1, descending=True)
            places = drawn.gather(1, by_score).argsort(dim=-1, descending=True, stable=True)
            return by_score.gather(1, places)[:, :k]
        return best_items(scores, k)


@dataclass(frozen=True)
class Decider:
    """A trained policy under a decision rule."""

    policy: SequencePolicy
    """In evaluation mode."""
    rule: DecisionRule
    returns: ReturnToGo = field(default_factory=ReturnToGo)
    """What the returns-to-go of the training counted."""
    reward_model: "ItemRewardModel | None" = None
    """f̂_r; needed for a reward weight."""
    likeness: Likeness | None = None
    """Tags of the items; needed for a tag window."""
    main_tags: MainTags | None = None
    """Main tags of the items; needed for a tag run."""

    def __post_init__(self) -> None:
        if self.rule.reward_weight and self.reward_model is None:
            raise InputError(
                f"the rule has reward weight {self.rule.reward_weight:g}, but the run has no "
                "reward model of items; train it with --set rule.choose=true, or set the reward "
                "weight to 0"
            )
        if self.rule.tag_window and (self.likeness is None or not self.likeness.tags.shape[1]):
            raise InputError(
                "the rule leaves out items by their tags, but the store has none; give the items a "
                "column of lists, or set the tag window to 0"
            )
        if self.rule.tag_run and (self.main_tags is None or not (self.main_tags.tags >= 0).any()):
            raise InputError(
                "the rule leaves out items by their main tag, but the store has none; give the "
                "items a column of lists, or set the tag run to 0"
            )
        if self.rule.tag_window > self.known:
            raise InputError(
                f"the rule looks at the tags of the last {self.rule.tag_window} items, but of a "
                f"session {self.known} are known ({WINDOW}, or policy.context less 1 if that is "
                f"more); set the tag window to at most {self.known}"
            )

    @property
    def known(self) -> int:
        """The number of items of a session that are known at least, once it has shown them."""
        return max(self.policy.config.context - 1, WINDOW)

    @property
    def reach(self) -> int:
        """Items shown before a step that the reward model and the rule read."""
        of_model = 0 if self.reward_model is None else self.reward_model.reach
        return max(of_model, self.rule.tag_window, self.rule.tag_run)

    @torch.no_grad()
    def asked(self, windows: Windows, collected: Tensor) -> Windows:
        """The windows with the returns-to-go that the rule asks for.

        Args:
            windows: B windows that end with the step to decide.
            collected: (B,) float64 rewards earlier in the session, also before the window.
        """
        best = None
        if self.rule.target is None:
            best = self.policy.max_return(windows.to(self.policy.state_mean.device)).cpu()
        asked = self.rule.asked(self.returns, collected, best)
        returns_to_go = self.returns.before(asked, windows.rewards.cpu())
        mask = windows.mask
        return replace(windows, returns_to_go=returns_to_go.to(mask.device).masked_fill(~mask, 0.0))

    @torch.no_grad()
    def act(self, windows: Windows, collected: Tensor) -> Tensor:
        """The policy's outputs at the last step, on the CPU: see `SequencePolicy.act`."""
        return self.act_and_features(self.asked(windows, collected))[0]

    @torch.no_grad()
    def act_and_features(self, asked: Windows) -> tuple[Tensor, Tensor | None]:
        """The policy's outputs at the last step of windows of `asked`, and the features (B, d) that
        they are made from, on the CPU; None of a learner that is no network of features (item-knn,
        crm-greedy)."""
        policy, moved = self.policy, asked.to(self.policy.state_mean.device)
        if type(policy).act is not SequencePolicy.act:
            return policy.act(moved).cpu(), None
        outputs, features = policy.act_and_features(moved)
        return outputs.cpu(), features.cpu()

    def scores(
        self,
        windows: Windows,
        collected: Tensor,
        forbidden: Tensor | None = None,
        users: Tensor | None = None,
        shown: Shown | None = None,
    ) -> Tensor:
        """log π(i | s, Ĝ) + β f̂_r(s, i), up to a constant per row, −∞ for items left out.

        Args:
            windows: B windows of items that end with the step to decide; its own action and reward
                are not read.
            collected: (B,) float64 rewards earlier in the session, also before the window.
            forbidden: (B, n_items) or (n_items,) bool, items that may not be shown.
            users: (B,) rows of the training store's users, −1 for others; None for unknown ones.
            shown: what the sessions showed before, further back than the windows may reach; None
                for what the windows have.

        Returns:
            (B, n_items).

        Raises:
            InputError: no item is left in some row, or the scores of some row are NaN.
        """
        logits = self.act(windows, collected)
        return self.scores_from(logits, windows, forbidden, users, shown)

    @torch.no_grad()
    def scores_from(
        self,
        logits: Tensor,
        windows: Windows,
        forbidden: Tensor | None = None,
        users: Tensor | None = None,
        shown: Shown | None = None,
    ) -> Tensor:
        """`scores` from the policy's outputs (B, n_items)."""
        scores = self.weighted(logits, windows, users, shown)
        self.require_numbers(scores)
        if forbidden is not None:
            scores = scores.masked_fill(forbidden, -torch.inf)
        before = Shown.before_last(windows)
        earlier = shown or before
        recent = before if self.rule.tag_window < windows.mask.shape[1] else earlier
        scores = self.without_tired_tags(self.without_recent_tags(scores, recent), earlier)
        none = torch.isneginf(scores.amax(1))
        if none.any():
            raise InputError(
                f"in {int(none.sum())} of {len(none)} decisions every item is left out; allow more "
                "candidates, or keep seen items"
            )
        return scores

    @torch.no_grad()
    def weighted(
        self, logits: Tensor, windows: Windows, users: Tensor | None, shown: Shown | None
    ) -> Tensor:
        """The policy's outputs (B, n_items) plus β f̂_r; the arguments are those of `scores`."""
        if not self.rule.reward_weight:
            return logits
        return self.rewards(windows, users, shown).mul_(self.rule.reward_weight).add_(logits)

    @staticmethod
    def require_numbers(scores: Tensor) -> None:
        """Check scores (B, n_items).

        Raises:
            InputError: those of some row are NaN, or infinitely high.
        """
        undefined = ~(scores.amax(1) < torch.inf)
        if undefined.any():
            raise InputError(
                f"in {int(undefined.sum())} of {len(scores)} decisions scores are no numbers, as "
                "weights of the policy or the reward model are NaN or infinite; train again, with "
                "a lower train.learning_rate if the training diverged"
            )

    @torch.no_grad()
    def rewards(
        self, windows: Windows, users: Tensor | None = None, shown: Shown | None = None
    ) -> Tensor:
        """f̂_r (B, n_items) at the last step of the windows, in the reward model's units."""
        assert self.reward_model is not None
        shown = shown or Shown.before_last(windows)
        scores: Tensor = self.reward_model.scores(windows.states[:, -1], shown, users)
        return scores

    def without_recent_tags(self, scores: Tensor, shown: Shown) -> Tensor:
        """Scores (B, n_items), −∞ for items that share a tag with one of the last that sessions
        have shown, if the rule says so and other items remain."""
        if not self.rule.tag_window:
            return scores
        assert self.likeness is not None
        recent = shown.items[:, : self.rule.tag_window]
        alike = self.likeness.to_all(self.likeness.profile(recent, torch.ones(recent.shape)))
        return _left(scores, alike > 0)

    def without_tired_tags(self, scores: Tensor, shown: Shown) -> Tensor:
        """Scores (B, n_items), −∞ for items with the main tag of the last that sessions have shown,
        if the rule says so, users liked enough of them on end, and other items remain."""
        if not self.rule.tag_run:
            return scores
        assert self.main_tags is not None
        tired = self.main_tags.tired(shown, self.rule.tag_run).unsqueeze(1)
        return _left(scores, (self.main_tags.tags == tired) & (tired >= 0))


def _left(scores: Tensor, without: Tensor) -> Tensor:
    """Scores (B, n_items) with −∞ where `without`, but in rows where nothing would remain."""
    left = scores.masked_fill(without, -torch.inf)
    none = torch.isneginf(left.amax(1))
    left[none] = scores[none]
    return left
