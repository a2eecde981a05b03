"""BPR (Rendle et al., 2009): matrix factorisation by pairs of a liked item and another one."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.episodes.states import least_liked
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import PolicyConfig, SequencePolicy, require_items
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.layers import draw_normal, embedding
from ucfrec.settings import settings_table


@settings_table("policy")
class BPRConfig(PolicyConfig):
    """Settings of BPR; `dim` is the number of factors, `context` − 1 the items that make a user."""


class BPRPolicy(SequencePolicy):
    """Scores items by the product of their factors with the user's, plus a bias per item.

    A user's factors are the mean of factors of the items that the session liked before, as in FISM
    (Kabbur et al., 2013), so that users who are new have some as well. The loss is
    −log σ(s(i) − s(j)) of a liked item i and a uniformly drawn item j. States and returns are not
    used.
    """

    Config = BPRConfig
    config: BPRConfig
    reward_low: Tensor
    reward_high: Tensor

    def __init__(self, config: BPRConfig, sizes: Mapping[str, int]) -> None:
        require_items("bpr", sizes)
        super().__init__(config, sizes)
        self.of_history = embedding(sizes["items"], config.dim)
        draw_normal(self.of_history.weight, std=0.1)
        for name in ("reward_low", "reward_high"):
            self.register_buffer(name, torch.zeros(()))

    def start_from(self, train: EpisodeStore) -> None:
        """Set the range of the rewards, by which a step counts as liked."""
        rewards = train.column(schema.REWARD)
        self.reward_low.fill_(float(rewards.min()))
        self.reward_high.fill_(float(rewards.max()))

    def features(self, windows: Windows) -> Tensor:
        """Factors (B, K, d) of the user before each step."""
        liked = self._liked(windows).unsqueeze(-1)
        sums = (self.of_history(windows.actions) * liked).cumsum(1)
        means = sums / liked.cumsum(1).clamp(min=1)
        return F.pad(means[:, :-1], (0, 0, 1, 0))  # row t is of the steps before t

    def _liked(self, windows: Windows) -> Tensor:
        """(B, K) 1 at liked steps, as of `ucfrec.episodes.states`, otherwise 0."""
        least = least_liked(self.reward_low, self.reward_high)
        return ((windows.rewards >= least) & windows.mask).float()

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean loss over the liked steps of the windows, and scalars to log."""
        head = self.head
        assert isinstance(head, ItemHead)
        normalized, liked = self.normalize(windows), self._liked(windows) > 0
        features, shown = self.features(normalized)[liked], windows.actions[liked]
        exposed = self.exposed(normalized)
        exposed = None if exposed is None else exposed.select(liked.flatten())
        negative = torch.randint(len(head.bias), shown.shape, device=shown.device)
        apart = head.logit(features, shown, exposed) - head.logit(features, negative, exposed)
        value = -F.logsigmoid(apart).sum() / max(1, len(shown))
        return value, {"bpr_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean loss over the liked last steps and all items, the validation loss."""
        liked = self._liked(windows)[:, -1] > 0
        if not bool(liked.any()):
            return windows.rewards.new_zeros(())
        scores, shown = self.act(windows)[liked], windows.actions[liked, -1:]
        return -F.logsigmoid(scores.gather(1, shown) - scores).mean()
