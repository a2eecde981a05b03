"""Greedy policy: the action with the highest predicted immediate reward."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.counterfactual.reward_model import mlp
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown, Windows
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.policies.heads import VectorHead
from ucfrec.user_model.reward import MEMORY, ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model

_CANDIDATES = 512
"""Number of logged action vectors to choose from."""
_PAIRS = 2**15
"""Pairs of state and action that are evaluated at once."""


class CRMGreedyPolicy(SequencePolicy):
    """Chooses argmax_a E[r | s, a]; disturbances have their prior mean, as future ones are unknown.

    For items, the expected reward is that of `ItemRewardModel`, fitted effect by effect. For action
    vectors, it is that of a network like the first part of the causal reward model
    (`CRMConfig.mean_first`), trained by squared error on standardised rewards; the candidates are a
    sample of the logged action vectors, beyond which the network has no data.
    """

    reward_mean: Tensor
    reward_std: Tensor
    candidates: Tensor

    def __init__(self, config: PolicyConfig, sizes: Mapping[str, int]) -> None:
        if sizes["items"]:
            # The reward model reads so many items before the step.
            config = replace(config, context=max(config.context, MEMORY + 1))
        super().__init__(config, sizes)
        self.model: ItemRewardModel | nn.Sequential
        if sizes["items"]:
            self.model = ItemRewardModel(sizes)
            return
        self.model = mlp(sizes["state"] + sizes["action"], config.dim, 2, 1)
        for name in ("reward_mean", "reward_std"):
            self.register_buffer(name, torch.zeros(()))
        self.register_buffer("candidates", torch.zeros(_CANDIDATES, sizes["action"]))

    def start_from(self, train: EpisodeStore) -> None:
        """For vectors, set the candidates, and the mean and standard deviation of the rewards."""
        if not isinstance(self.head, VectorHead):
            return
        rewards, actions = train.column(schema.REWARD), train.column(schema.ACTION)
        self.reward_mean.fill_(float(rewards.mean()))
        self.reward_std.fill_(max(float(rewards.std()), 1e-6))
        sample = np.random.default_rng(0).integers(len(actions), size=_CANDIDATES)
        self.candidates.copy_(torch.from_numpy(actions[sample]))

    def make_solver(
        self,
        train: EpisodeStore,
        validation: EpisodeStore | None,
        folder: Path,
        seed: int,
    ) -> Callable[[], None] | None:
        """For items, fits the reward model, on nine tenths of the episodes if none are held out."""
        model = self.model
        if not isinstance(model, ItemRewardModel):
            return None
        if validation is None:
            train, validation = train.divide(np.arange(train.n_episodes) % 10 == 1)
        fit = partial(fit_item_reward_model, train, validation, folder, seed)

        def solve() -> None:
            fitted, _ = fit()
            model.load_state_dict(fitted.state_dict())

        return solve

    def features(self, windows: Windows) -> Tensor:
        """Standardised states (B, K, S)."""
        return windows.states

    def _errors(self, windows: Windows) -> Tensor:
        """Squared errors (B, K) of the predicted standardised rewards of action vectors."""
        inputs = torch.cat([self.normalize(windows).states, windows.actions], dim=-1)
        assert isinstance(self.model, nn.Sequential)
        predicted = self.model(inputs).squeeze(-1)
        standard = (windows.rewards - self.reward_mean) / self.reward_std
        return F.mse_loss(predicted, standard, reduction="none")

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error of standardised rewards over all steps, and scalars to log."""
        value = self._errors(windows)[windows.mask].mean()
        return value, {"reward_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean squared error of standardised rewards over the windows' last steps."""
        model = self.model
        if not isinstance(model, ItemRewardModel):
            return self._errors(windows)[:, -1].mean()
        states, items = windows.states[:, -1], windows.actions[:, -1]
        predicted = model.expect(model.score(states, Shown.before_last(windows), None, items))
        errors = (windows.rewards[:, -1] - predicted) / model.reward_std
        return errors.square().mean()

    def act(self, windows: Windows) -> Tensor:
        """At the last step: scores of all items (B, n_items) as of `ItemRewardModel.scores`, for
        users that are not known, or the best action vectors (B, A)."""
        if isinstance(self.model, ItemRewardModel):
            return self.model.scores(windows.states[:, -1], Shown.before_last(windows))
        states = self.normalize(windows).states[:, -1]
        first, remaining = self.model[0], self.model[1:]
        assert isinstance(first, nn.Linear)
        # The first layer is linear: its state part is computed once per state and its action part
        # once per candidate, instead of both once per pair.
        size = states.shape[1]
        of_actions = F.linear(self.candidates, first.weight[:, size:], first.bias)
        of_states = F.linear(states, first.weight[:, :size])
        chunks = torch.split(of_states, max(1, _PAIRS // len(of_actions)))
        values = [remaining(rows.unsqueeze(1) + of_actions).squeeze(-1) for rows in chunks]
        return self.candidates[torch.cat(values).argmax(1)]
