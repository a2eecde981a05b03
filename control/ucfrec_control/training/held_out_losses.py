"""How much a trained policy's held-out loss depends on a distractor."""

from dataclasses import replace

import numpy as np
import torch

from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.screened import without_columns
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy

_BATCHES, _BATCH = 8, 512


@torch.no_grad()
def held_out_losses(trained: TrainedPolicy, store: EpisodeStore) -> dict[str, float]:
    """Mean action loss at 4,096 steps of validation episodes.

    Unlike scores, the losses do not vary with the course of the rollout.

    Returns:
        `loss` with the logged states, and `loss_at_zero` with every distractor fixed to 0.
    """
    dropped = trained.dropped
    _, validation = training_views(without_columns(store, dropped))
    generator = np.random.default_rng(0)
    added = [each["dimension"] for each in trained.record.data.others.get("distractors", [])]
    dimensions = [d - sum(other < d for other in dropped) for d in added if d not in dropped]
    losses = []
    for _ in range(_BATCHES):
        steps = validation.draw_steps(generator, _BATCH)
        windows = validation.windows(*steps, trained.policy.config.context)
        fixed = windows.states.clone()
        fixed[..., dimensions] = 0.0
        both = (windows, replace(windows, states=fixed))
        losses.append([float(trained.policy.action_loss(each)) for each in both])
    loss, at_zero = np.mean(losses, axis=0)
    return {"loss": float(loss), "loss_at_zero": float(at_zero)}
