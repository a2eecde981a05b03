"""Counterfactual copies of the training episodes: reward model, generator, gates (Algorithm 1)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ucfrec import schema
from ucfrec.counterfactual.action_augmentation import ActionGenerator, logged_actions
from ucfrec.counterfactual.clusters import ActionSupport
from ucfrec.counterfactual.generators import CSGConfig, make_generator, state_clusters
from ucfrec.counterfactual.reward_model import CRMConfig, EffectsMean, EffectTransitions
from ucfrec.counterfactual.reward_model_fit import Read, fit_crm, sample_steps, sample_transitions
from ucfrec.counterfactual.state_augmentation import (
    AugmentationReport,
    AugmentConfig,
    augment,
    candidates,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay
from ucfrec.errors import InputError
from ucfrec.processes import random_state_kept
from ucfrec.user_model.reward_fit import fit_item_reward_model

CRM: Final = "crm"
"""Folder of the reward model."""
MODELS: Final = ("item-reward", CRM, "csg")
"""Folders of the checkpoints of `counterfactual_augmentation`; which of them there are depends on
the settings."""
_CPU: Final = torch.device("cpu")


def require_rewards_vary(train: EpisodeStore) -> None:
    """Check that the training rewards are not all equal, which a reward model cannot learn from.

    Raises:
        InputError: all training rewards are equal.
    """
    rewards = train.column_batches(schema.REWARD)
    values = np.unique([extreme for (part,) in rewards for extreme in (part.min(), part.max())])
    if len(values) == 1:
        raise InputError(
            f"all {train.n_steps:,} training rewards of {train.path} equal {values[0]:g}: there is "
            "nothing for a reward model to learn; check the reward expression, or set "
            "augment.copies=0"
        )


@random_state_kept()
def counterfactual_augmentation(
    train: EpisodeStore,
    validation: EpisodeStore,
    crm_config: CRMConfig,
    csg_config: CSGConfig,
    config: AugmentConfig,
    folder: Path,
    seed: int,
    device: torch.device = _CPU,
) -> tuple[Overlay, AugmentationReport]:
    """Fit reward model and generator, and make copies (lines 1 to 3 of Algorithm 1).

    Args:
        train: view to fit both models to and to copy episodes from.
        validation: view for early stopping and for the quality of the reward model.
        folder: of the checkpoints, which training resumes from.
        device: where both models are fitted and edits are made.

    Raises:
        InputError: all training rewards are equal, or there are no held-out steps.
    """
    limit = max(crm_config.max_transitions, csg_config.max_transitions)
    mean: EffectsMean | None = None
    read: Read = EpisodeStore.transitions
    if crm_config.mean == "effects" and train.has_items:
        model, _ = fit_item_reward_model(train, validation, folder / "item-reward", seed)
        mean, read = EffectsMean(model), EffectTransitions(model)
    sampled = sample_steps(train, limit, seed)
    training = read(train, *sampled)
    held_out = sample_transitions(validation, limit // 10, seed, read)
    crm, crm_report = fit_crm(training, held_out, crm_config, folder / CRM, seed, mean, device)
    if not config.copies:
        # Nothing proposes states, so no generator is trained.
        csg_config = replace(csg_config, kind="noise")
    clusters = None
    if config.actions or csg_config.kind == "tangent":
        clusters = state_clusters(training, crm, csg_config, seed)
    generator = make_generator(training, crm, csg_config, folder / "csg", seed, clusters)
    overlay, report = augment(train, crm, crm_report, generator, config, seed, read)
    if clusters is None or not config.actions:
        return overlay, report
    states = crm.normalised_states(training.states.to(device)).cpu()
    labels = clusters.nearest(states).numpy()
    support = ActionSupport(labels, logged_actions(train, *sampled))
    actions = ActionGenerator(train, crm, clusters, support, report.epsilon_r, report.delta, read)
    places = candidates(train, config, np.random.default_rng(seed))
    copies, actions_report = actions.propose(*places, config.actions, seed)
    return overlay.joined(copies), replace(report, actions=actions_report)


def interventions(
    view: EpisodeStore, dimensions: Sequence[int], seed: int, copies: int = 2
) -> Overlay:
    """Copies of every episode of `view` under do(d ~ marginal), d being `dimensions`.

    Values are drawn, jointly, from the steps of the view. Copies 0, 2, … draw once an episode, as
    an intervention that stays put; copies 1, 3, … at every step.

    Args:
        view: a view without an overlay.
    """
    rng = np.random.default_rng(seed)
    episodes, steps = view.all_steps()
    states = view.windows(episodes, steps, 1).states[:, 0].numpy()
    edited = []
    for copy in range(copies):
        by_episode = rng.integers(len(steps), size=view.n_episodes)[episodes]
        sources = by_episode if copy % 2 == 0 else rng.integers(len(steps), size=len(steps))
        changed = states.copy()
        changed[:, list(dimensions)] = states[sources][:, list(dimensions)]
        edited.append(changed)
    numbers = np.arange(copies)[:, None] * view.n_episodes + episodes
    return Overlay(
        copy_source=np.tile(view.episode_ids, copies),
        edit_copy=numbers.reshape(-1),
        edit_step=np.tile(steps, copies),
        edit_state=np.concatenate(edited),
    )
