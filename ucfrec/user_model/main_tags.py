"""The main tag of each item, and how often in a row items of one main tag were liked."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.item_counts import LIKED
from ucfrec.episodes.states import ItemStates


@dataclass(frozen=True)
class MainTags:
    """The tag that each item is most typical of, and what counts as liked.

    An item is typical of a tag if its embedding points to where those of the tag's items do.
    """

    tags: Tensor
    """(n_items,) int64; −1 for items without tags."""
    reward_low: float
    reward_high: float
    """Rewards that are scaled to 0 and 1."""

    @classmethod
    def of(cls, states: ItemStates) -> "MainTags":
        """The main tags of a store's items."""
        tags, ends = states.tags, (states.reward_low, states.reward_high)
        if not tags.shape[1]:
            return cls(torch.full((len(states.embeddings),), -1), *ends)
        directions = F.normalize(states.embeddings.double(), dim=1)
        n_tags = int(tags.max()) + 1
        places = torch.where(tags < 0, n_tags, tags)
        sums = directions.new_zeros(n_tags + 1, directions.shape[1])
        for column in places.unbind(1):
            sums.index_add_(0, column, directions)
        centres = F.normalize(sums, dim=1)
        columns = [(centres[column] * directions).sum(1) for column in places.unbind(1)]
        typical = torch.stack(columns, 1).masked_fill(tags < 0, -torch.inf)
        return cls(tags.gather(1, typical.argmax(1, keepdim=True))[:, 0], *ends)

    def liked(self, rewards: Tensor) -> Tensor:
        """Whether the items with the rewards (...) were liked."""
        return (rewards - self.reward_low) / (self.reward_high - self.reward_low) >= LIKED

    def runs(self, shown: Shown) -> Tensor:
        """In how many steps in a row, up to each earlier one, one main tag was liked, (B, N).

        0 where the item was not liked, has no tags, or none was shown. Only what `shown` holds is
        counted.
        """
        liked = self.liked(shown.rewards) & (shown.items >= 0)
        tags = torch.where(liked, self.tags[shown.items], -1)
        lengths = []
        before, length = torch.full((len(tags),), -1), torch.zeros(len(tags), dtype=torch.int64)
        for tag in reversed(tags.unbind(1)):
            length = (torch.where(tag == before, length, 0) + 1).masked_fill(tag < 0, 0)
            before = tag
            lengths.append(length)
        return torch.stack(lengths[::-1], 1) if lengths else torch.zeros_like(shown.items)

    def tired(self, shown: Shown, run: int) -> Tensor:
        """Main tag (B,) of the `run` items shown last, if all had it and were liked; else −1."""
        items, rewards = (each[:, :run] for each in shown)
        tags = self.tags[items.clamp(min=0)]
        alike = (tags == tags[:, :1]) & (items >= 0) & self.liked(rewards)
        return torch.where(alike.all(1) & (items.shape[1] >= run), tags[:, 0], -1)
