"""What a policy must hold, to be checked in the tests of the package that it comes from."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.processes import random_state_kept

RESERVED = frozenset(
    {"state_mean", "state_std", "return_scale", "lowest_return_to_go", "head"}
    | {"normalize", "imitation", "act_and_features", "exposed"}
)
"""Names that no subclass of `SequencePolicy` may define; of its instances, `head` may be replaced
by another with the same methods."""
_WINDOWS = 8
_TOLERANCE = 1e-6
"""Of features, relative to the largest: sums in another order differ by less."""
_ROUNDING = 1e-4
"""The same of windows of another length: products differ by more."""


@random_state_kept()
@torch.no_grad()
def check_policy(
    policy: SequencePolicy,
    train: EpisodeStore,
    sizes: Mapping[str, int],
) -> None:
    """Check a policy with forward passes that differ in what it must not read.

    Row t of `features` predicts a_t. It may depend on what was known before: states and
    returns-to-go up to t, actions and rewards before t. The check changes all the rest from some
    step of each window on, and the padding. It also builds the policy again, with the `sizes` that
    it was built with, from its parameters and buffers, as a saved run is read.

    Raises:
        InputError: features or predictions depend on the action, the reward or later steps, on
            padding, on chance or on state outside parameters and buffers, or have another shape
            than the head takes; the loss is no pair; or the class defines a reserved name.
    """
    classes = type(policy).__mro__
    own_classes = classes[: classes.index(SequencePolicy)]
    if taken := sorted(RESERVED.intersection(name for kind in own_classes for name in vars(kind))):
        _refuse(policy, f"defines {', '.join(taken)}, which SequencePolicy keeps for itself")
    was_training = policy.training
    policy.eval()
    try:
        _check_answer(policy, train)
        windows = _sample(train, policy.config.context)
        most = max(policy.config.context // 2, 1)
        padded = _sample(train, policy.config.context, most)
        rows = [_outputs(policy, part) for part in (padded, padded.last(most))]
        (features, acts), (short_features, short_acts) = rows
        alike = _alike(short_features[:, -1], features[:, -1], _ROUNDING)
        if not (alike and _alike(short_acts, acts, _ROUNDING)):
            _refuse(
                policy,
                "depends on how much padding is before a session; leave steps out where "
                "windows.mask is false (for a recurrent network: ucfrec.policies.base.recurrent)",
            )
        if policy.make_solver(train, None, Path(), 0) is None:
            with torch.enable_grad():
                pair = policy.loss(windows.at(slice(0, 2)))
            shaped = isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], dict)
            if not (shaped and isinstance(pair[0], Tensor) and pair[0].ndim == 0):
                _refuse(policy, "has a loss that gives no scalar tensor and dict of scalars to log")
        saved = type(policy)(policy.config, sizes)
        saved.load_state_dict(policy.state_dict())
        if not _alike(policy.act(windows), saved.eval().act(windows), _ROUNDING):
            _refuse(policy, "keeps state outside parameters and buffers; use register_buffer")
    finally:
        policy.train(was_training)


def _refuse(policy: SequencePolicy, reason: str) -> None:
    raise InputError(f"the policy {type(policy).__name__} {reason}")


def _check_answer(policy: SequencePolicy, train: EpisodeStore) -> None:
    context = policy.config.context
    windows = _sample(train, context)
    back = torch.arange(_WINDOWS) % windows.mask.sum(1)
    back[::2] = 0  # what acting computes is the last row
    cuts = context - 1 - back
    at = torch.arange(context)
    late, later = at >= cuts[:, None], at > cuts[:, None]
    if isinstance(policy.head, ItemHead):
        n_items = len(policy.head.embeddings)
        actions = torch.where(late, (windows.actions + 1) % n_items, windows.actions)
    else:
        actions = windows.actions + late.unsqueeze(-1)
    changed = replace(
        windows,
        actions=actions,
        rewards=windows.rewards + late,
        returns_to_go=windows.returns_to_go + later,
        states=windows.states + later.unsqueeze(-1),
    )
    first, acts = _outputs(policy, windows)
    second, other_acts = _outputs(policy, changed)
    unchanged = windows.mask & ~later
    same_features = _alike(first[unchanged], second[unchanged])
    if same_features and _alike(acts[::2], other_acts[::2]):
        return
    if not _alike(first, _outputs(policy, windows)[0]):
        _refuse(policy, "gives other features for the same windows; draw only if self.training")
    _refuse(
        policy,
        "reads what it is to predict: its output at a step depends on the action or reward of that "
        "step, or on a later step; shift the actions and rewards by one step, or mask later ones",
    )


def _sample(train: EpisodeStore, length: int, most: int | None = None) -> Windows:
    """Windows of at most `most` steps that end at steps spread over the training episodes."""
    steps = np.linspace(0, train.n_steps - 1, _WINDOWS).astype(np.int64)
    episodes, _ = train.locate(steps)
    lasts = train.lengths[episodes] - 1
    return train.windows(episodes, lasts if most is None else lasts.clip(max=most - 1), length)


def _outputs(policy: SequencePolicy, windows: Windows) -> tuple[Tensor, Tensor]:
    """Features (B, K, d) and predictions (B, A) or (B, n_items)."""
    features = policy.features(policy.normalize(windows))
    shape = tuple(windows.mask.shape)
    if not isinstance(features, Tensor) or features.ndim != 3 or features.shape[:2] != shape:
        _refuse(policy, f"must give features of shape {(*shape, policy.config.dim)}")
    return features, policy.act(windows)


def _alike(first: Tensor, second: Tensor, tolerance: float = _TOLERANCE) -> bool:
    scale = float(first.nan_to_num(0, 0, 0).abs().max())
    return torch.allclose(first, second, rtol=0, atol=tolerance * scale, equal_nan=True)
