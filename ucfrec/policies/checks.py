"""What every policy must hold before it is trained: it sees no answer that it must predict."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.processes import random_state_kept

_WINDOWS = 8
_TOLERANCE = 1e-6
"""Of features, relative to the largest: sums in another order differ by less."""


@random_state_kept()
@torch.no_grad()
def require_sound(policy: SequencePolicy, train: EpisodeStore, name: str) -> None:
    """Check a new policy with two forward passes that differ in what it must not read.

    Row t of `features` is what predicts a_t. It may depend on what was known before a_t: states and
    returns-to-go up to t, actions and rewards before t. The check changes all the rest from some
    step of each window on.

    Args:
        policy: before its training; put in evaluation mode meanwhile.
        train: the training episodes, of which a few windows are read.

    Raises:
        InputError: features or predictions depend on the action, the reward or later steps, or
            have another shape than the head takes.
    """
    windows = _sample(train, policy.config.context)
    back = torch.arange(_WINDOWS) % windows.mask.sum(1)
    back[::2] = 0  # what acting computes is the last row
    cuts = policy.config.context - 1 - back
    other = _changed(windows, cuts, policy)
    was_training = policy.training
    policy.eval()
    try:
        first, second = _features(policy, windows, name), _features(policy, other, name)
        acts = [_predictions(policy, each, name)[::2] for each in (windows, other)]
    finally:
        policy.train(was_training)
    known = windows.mask & (torch.arange(policy.config.context) <= cuts[:, None])
    if not (_alike(first[known], second[known]) and _alike(*acts)):
        raise InputError(
            f"the policy {name!r} reads what it is to predict: its output at a step depends on the "
            "action or reward of that step, or on a later step; shift the actions and rewards by "
            "one step, or mask later ones"
        )


def _sample(train: EpisodeStore, length: int) -> Windows:
    """Windows that end at steps spread over the training episodes."""
    steps = np.linspace(0, train.n_steps - 1, _WINDOWS).astype(np.int64)
    episodes, _ = train.locate(steps)
    lasts = train.lengths[episodes] - 1
    return train.windows(episodes, lasts, length)


def _changed(windows: Windows, cuts: Tensor, policy: SequencePolicy) -> Windows:
    """Windows with other actions and rewards from the steps `cuts` (B,) on, and other states and
    returns-to-go after them."""
    at = torch.arange(windows.mask.shape[1])
    late, later = at >= cuts[:, None], at > cuts[:, None]
    if isinstance(policy.head, ItemHead):
        n_items = len(policy.head.embeddings)
        actions = torch.where(late, (windows.actions + 1) % n_items, windows.actions)
    else:
        actions = windows.actions + late.unsqueeze(-1)
    return replace(
        windows,
        actions=actions,
        rewards=windows.rewards + late,
        returns_to_go=windows.returns_to_go + later,
        states=windows.states + later.unsqueeze(-1),
    )


def _features(policy: SequencePolicy, windows: Windows, name: str) -> Tensor:
    features = policy.features(policy.normalized(windows))
    expected = (*windows.mask.shape, policy.config.dim)
    if not isinstance(features, Tensor) or features.shape[:2] != expected[:2] or features.ndim != 3:
        raise _shape(name, "features", features, expected)
    return features


def _predictions(policy: SequencePolicy, windows: Windows, name: str) -> Tensor:
    batch = len(windows.mask)
    size = windows.actions.shape[-1] if windows.actions.ndim == 3 else None
    expected = (batch, len(policy.head.embeddings) if size is None else size)  # type: ignore[arg-type]
    try:
        found = policy.act(windows)
    except RuntimeError as error:
        raise InputError(
            f"the policy {name!r} cannot act on windows of {windows.mask.shape[1]} steps "
            f"({error!s:.200}); its features must be (batch, steps, policy.dim), which is "
            f"{policy.config.dim}"
        ) from error
    if not isinstance(found, Tensor) or found.shape != expected:
        raise _shape(name, "predictions", found, expected)
    return found


def _shape(name: str, what: str, found: object, expected: tuple[int, ...]) -> InputError:
    shape = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
    return InputError(
        f"the policy {name!r} gives {what} of shape {shape} where {expected} is needed"
    )


def _alike(first: Tensor, second: Tensor) -> bool:
    scale = float(first.nan_to_num(0, 0, 0).abs().max()) if first.numel() else 0.0
    return torch.allclose(first, second, rtol=0, atol=_TOLERANCE * scale, equal_nan=True)
