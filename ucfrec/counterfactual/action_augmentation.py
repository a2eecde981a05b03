"""Augmented trajectories that end with another action and its counterfactual reward."""

import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.counterfactual.clusters import ActionSupport, StateClusters
from ucfrec.counterfactual.reward_model import CausalRewardModel
from ucfrec.counterfactual.reward_model_fit import Read
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay
from ucfrec.files.record import Undefinable

_CHUNK = 4096
_STREAM = 1
"""Keeps the draws apart from others with the same seed."""


@dataclass(frozen=True)
class ActionReport:
    """Other actions that were proposed, and their counterfactual rewards."""

    proposals: int
    """Number of other actions proposed."""
    reproduced: float
    """Share of them at steps whose logged reward the reward model reproduces within ε_r."""
    copies: int
    """Number of action copies: those that, at such steps, change the reward by more than δ."""
    mean_change: Undefinable
    """Mean change of the reward in the copies, in reward units; 0 without copies."""
    earns_more: Undefinable
    """Share of the copies with a higher reward than the logged action; 0 without copies."""


@dataclass(frozen=True)
class ActionGenerator:
    """Proposes other actions at logged steps, with their counterfactual rewards.

    For a logged step (s, a, r), the disturbance z is abduced and kept; another action a' is the
    action of a random training step whose state lies in the same cluster as s; and its reward is
    r' = f̂_r(s, a', z), within the range of the logged rewards.
    """

    view: EpisodeStore
    """The training episodes, without copies."""
    crm: CausalRewardModel
    """The fitted reward model."""
    clusters: StateClusters
    """Of the training states."""
    support: ActionSupport
    """The logged actions of each cluster."""
    epsilon_r: float
    """ε_r: the model must reproduce the logged reward, |f̂_r(s, a, z) − r| ≤ ε_r."""
    delta: float
    """δ, the model's error on held-out steps: rewards r' and r that differ by no more
    cannot be distinguished."""
    read: Read
    """Reads transitions with the actions that the reward model was fitted to."""

    def propose(
        self, episodes: IntArray, steps: IntArray, count: int, seed: int
    ) -> tuple[Overlay, ActionReport]:
        """Propose `count` other actions at each of the given steps, and copy what passes.

        Actions are drawn with replacement; a draw of the logged action itself is not a proposal.

        Args:
            episodes: (M,) positions in the view.
            steps: (M,) steps of those episodes.
            count: actions drawn for each step.
        """
        exact, rng = copy.deepcopy(self.crm).double(), np.random.default_rng([seed, _STREAM])
        chunks = []
        for start in range(0, max(1, len(steps)), _CHUNK):
            part = slice(start, start + _CHUNK)
            chunks.append(self._predicted(exact, episodes[part], steps[part], count, rng))
        proposed = _Proposed(*(np.concatenate(parts) for parts in zip(*chunks, strict=True)))
        rewards = self.view.column(schema.REWARD)
        reward = proposed.reward.clip(rewards.min(), rewards.max()).astype(np.float32)
        change = reward - proposed.logged
        accepted = proposed.reproduced & (np.abs(change) > self.delta)
        report = ActionReport(
            proposals=len(accepted),
            reproduced=float(proposed.reproduced.mean()) if len(accepted) else 0.0,
            copies=int(accepted.sum()),
            mean_change=float(change[accepted].mean()) if accepted.any() else 0.0,
            earns_more=float((change[accepted] > 0).mean()) if accepted.any() else 0.0,
        )
        passed = (
            proposed.episode[accepted],
            proposed.step[accepted],
            proposed.action[accepted],
            reward[accepted],
        )
        return self._copies(*passed), report

    @torch.no_grad()
    def _predicted(
        self,
        exact: CausalRewardModel,
        episodes: IntArray,
        steps: IntArray,
        count: int,
        rng: np.random.Generator,
    ) -> "_Proposed":
        """Draw other actions at each of the given steps, and predict their rewards.

        `exact` is the reward model in float64, so that a later check confirms what passes.
        """
        factual = self.read(self.view, episodes, steps).to(self.crm.device)
        s, a, r = (values.double() for values in (factual.states, factual.actions, factual.rewards))
        z = exact.abduct(s, a, r)
        reproduced = ((exact.predict(s, a, z) - r).abs() <= self.epsilon_r).cpu().numpy()
        rows = np.repeat(np.arange(len(steps)), count)
        states = self.crm.normalised_states(factual.states).cpu()
        labels = self.clusters.nearest(states).numpy()
        actions, drawable = self.support.draw(labels[rows], rng)
        logged = logged_actions(self.view, episodes[rows], steps[rows])
        differs = drawable & np.atleast_2d((actions != logged).T).any(axis=0)
        rows, actions = rows[differs], actions[differs]
        # Copies with these actions, whatever their rewards, show what the reward model reads of
        # them.
        nothing = np.zeros(len(rows), dtype=np.float32)
        copies = self.view.with_overlay(self._copies(episodes[rows], steps[rows], actions, nothing))
        places = self.view.n_episodes + np.arange(len(rows))
        inputs = self.read(copies, places, steps[rows]).actions.to(s)
        at = torch.from_numpy(rows).to(s.device)
        reward = exact.predict(s[at], inputs, z[at]).cpu().numpy()
        outcomes = (r.cpu().numpy()[rows], reproduced[rows])
        return _Proposed(episodes[rows], steps[rows], actions, reward, *outcomes)

    def _copies(
        self, episodes: IntArray, steps: IntArray, actions: Array, rewards: Float32Array
    ) -> Overlay:
        sources, size = self.view.episode_ids[episodes], self.view.state_size
        return Overlay.of_actions(sources, steps, actions, rewards, size)


class _Proposed(NamedTuple):
    """N other actions: position of the episode in the view, step, action, and its reward."""

    episode: IntArray
    step: IntArray
    action: Array
    reward: Float64Array
    logged: Float64Array
    """Reward of the logged action."""
    reproduced: BoolArray
    """Whether the reward model reproduces it."""


def logged_actions(view: EpisodeStore, episodes: IntArray, steps: IntArray) -> Array:
    """The logged actions of M steps, (M,) int64 items or (M, A) float32 vectors."""
    if view.has_items:
        return view.step_values(schema.ITEM, episodes, steps).astype(np.int64)
    return view.step_values(schema.ACTION, episodes, steps)
