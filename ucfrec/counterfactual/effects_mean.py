"""The reward model of items as the expected reward of the causal reward model."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from ucfrec.arrays import IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Transitions
from ucfrec.user_model.reward import CLIP, ItemRewardModel
from ucfrec.user_model.reward_rows import RewardRows


class EffectsMean(nn.Module):
    """E[r | s, a] of an `ItemRewardModel`, as a differentiable function of states.

    Actions are those of `transitions`: the item's vector, then the part of the linear predictor
    that does not depend on the state.
    """

    state_mean: Tensor
    state_std: Tensor
    state: Tensor
    interaction: Tensor
    reward: Tensor

    def __init__(self, model: ItemRewardModel) -> None:
        super().__init__()
        self.binary = bool(model.binary)
        for name in ("state_mean", "state_std", "state", "interaction"):
            self.register_buffer(name, model.get_buffer(name).clone())
        ends = (model.reward_low, model.reward_high - model.reward_low)
        units = ends if self.binary else (model.reward_mean, model.reward_std)
        self.register_buffer("reward", torch.stack(units))

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """Expected rewards (...), in reward units, of states (..., S) and actions (..., D + 1)."""
        x = ((states - self.state_mean) / self.state_std).clamp(-CLIP, CLIP)
        vectors, fixed = actions[..., :-1], actions[..., -1]
        scores = fixed + x @ self.state + ((x @ self.interaction) * vectors).sum(-1)
        start, unit = self.reward
        rewards: Tensor = start + unit * (torch.sigmoid(scores) if self.binary else scores)
        return rewards


class EffectTransitions:
    """Reads transitions whose actions `EffectsMean` understands."""

    def __init__(self, model: ItemRewardModel) -> None:
        self._model = model

    @torch.no_grad()
    def __call__(self, view: EpisodeStore, episodes: IntArray, steps: IntArray) -> Transitions:
        """Single steps of a view without augmented episodes, as `EpisodeStore.transitions`.

        Actions are (M, D + 1): the vectors of the items, then what of their scores does not depend
        on the state.
        """
        model = self._model
        read = view.transitions(episodes, steps)
        rows = RewardRows.at(view, episodes, steps, model.reach)
        fixed = model.fixed_part(rows.shown, rows.users, rows.items)
        return replace(read, actions=torch.cat([model.vectors[rows.items], fixed[:, None]], 1))
