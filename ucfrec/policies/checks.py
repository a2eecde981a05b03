"""What every policy must hold before it is trained: it sees no answer that it must predict."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import BUILT_IN
from ucfrec.processes import random_state_kept

_WINDOWS = 8
_TOLERANCE = 1e-6
"""Of features, relative to the largest: sums in another order differ by less."""
_ROUNDING = 1e-4
"""The same of windows of another length, or of another device: products differ by more."""


@contextmanager
def blamed(name: str, place: str) -> Iterator[None]:
    """Name the plug-in whose code the block runs in the error that it raises.

    Args:
        name: of the policy; errors of a built-in one are bugs and pass unchanged.
        place: words for the code.

    Raises:
        InputError: the code raised something else.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        if name in BUILT_IN:
            raise
        raise InputError(
            f"the policy {name!r} fails in {place} ({type(error).__name__}: {error!s:.200}); "
            "`ucfrec --debug` shows the line"
        ) from error


@random_state_kept()
@torch.no_grad()
def require_sound(policy: SequencePolicy, train: EpisodeStore, name: str) -> None:
    """Check a new policy with forward passes that differ in what it must not read.

    Row t of `features` is what predicts a_t. It may depend on what was known before a_t: states and
    returns-to-go up to t, actions and rewards before t. The check changes all the rest from some
    step of each window on, and the padding before the session.

    Args:
        policy: before its training; put in evaluation mode meanwhile.
        train: the training episodes, of which a few windows are read.

    Raises:
        InputError: features or predictions depend on the action, the reward or later steps, on
            padding or on chance, or have another shape than the head takes; or a method of a
            plug-in fails.
    """
    was_training = policy.training
    policy.eval()
    try:
        _require_no_answer_read(policy, train, name)
        _require_no_padding_read(policy, train, name)
        if name not in BUILT_IN:
            _require_loss(policy, _sample(train, policy.config.context), name)
    finally:
        policy.train(was_training)


@random_state_kept()
@torch.no_grad()
def require_whole(
    policy: SequencePolicy, rebuilt: SequencePolicy, train: EpisodeStore, name: str
) -> None:
    """Check that a policy is the same when it is built again from its parameters and buffers.

    Args:
        policy: put in evaluation mode meanwhile.
        rebuilt: in evaluation mode, on the same device.
        train: the training episodes, of which a few windows are read.

    Raises:
        InputError: it predicts something else.
    """
    windows = _sample(train, policy.config.context).to(policy.state_mean.device)
    was_training = policy.training
    policy.eval()
    try:
        acts = [_predictions(each, windows, name) for each in (policy, rebuilt)]
    finally:
        policy.train(was_training)
    if not _alike(*acts, tolerance=_ROUNDING):
        raise InputError(
            f"the policy {name!r} keeps state outside parameters and buffers, which its file does "
            "not have; use register_buffer"
        )


def _require_no_answer_read(policy: SequencePolicy, train: EpisodeStore, name: str) -> None:
    windows = _sample(train, policy.config.context)
    back = torch.arange(_WINDOWS) % windows.mask.sum(1)
    back[::2] = 0  # what acting computes is the last row
    cuts = policy.config.context - 1 - back
    other = _changed(windows, cuts, policy)
    first, second = _features(policy, windows, name), _features(policy, other, name)
    acts = [_predictions(policy, each, name)[::2] for each in (windows, other)]
    known = windows.mask & (torch.arange(policy.config.context) <= cuts[:, None])
    if _alike(first[known], second[known]) and _alike(*acts):
        return
    if not _alike(first, _features(policy, windows, name)):
        raise InputError(
            f"the policy {name!r} gives other features for the same windows; draw random numbers "
            "only if self.training"
        )
    raise InputError(
        f"the policy {name!r} reads what it is to predict: its output at a step depends on the "
        "action or reward of that step, or on a later step; shift the actions and rewards by "
        "one step, or mask later ones"
    )


def _require_no_padding_read(policy: SequencePolicy, train: EpisodeStore, name: str) -> None:
    length = policy.config.context
    most = max(length // 2, 1)
    padded = _sample(train, length, most)
    short = padded.last(most)
    features = [_features(policy, each, name)[:, -1] for each in (short, padded)]
    acts = [_predictions(policy, each, name) for each in (short, padded)]
    if not (_alike(*features, tolerance=_ROUNDING) and _alike(*acts, tolerance=_ROUNDING)):
        raise InputError(
            f"the policy {name!r} depends on how much padding is before a session; leave steps out "
            "where windows.mask is false (for a recurrent network: ucfrec.policies.layers."
            "recurrent)"
        )


def _require_loss(policy: SequencePolicy, windows: Windows, name: str) -> None:
    with blamed(name, "loss"), torch.enable_grad():
        found = policy.loss(windows.at(slice(0, 2)))
    pair = found if isinstance(found, tuple) and len(found) == 2 else (None, None)
    if not (isinstance(pair[0], Tensor) and pair[0].ndim == 0 and isinstance(pair[1], dict)):
        raise InputError(
            f"the loss of the policy {name!r} gives a {type(found).__name__}; it must give a "
            "scalar tensor and a dict of scalars to log"
        )


def _sample(train: EpisodeStore, length: int, most: int | None = None) -> Windows:
    """Windows that end at steps spread over the training episodes.

    Args:
        most: number of steps that each has at most; None for as many as there are.
    """
    steps = np.linspace(0, train.n_steps - 1, _WINDOWS).astype(np.int64)
    episodes, _ = train.locate(steps)
    lasts = train.lengths[episodes] - 1
    return train.windows(episodes, lasts if most is None else lasts.clip(max=most - 1), length)


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
    with blamed(name, "features"):
        features = policy.features(policy.normalized(windows))
    expected = (*windows.mask.shape, policy.config.dim)
    if not isinstance(features, Tensor) or features.shape[:2] != expected[:2] or features.ndim != 3:
        raise _shape(name, "features", features, expected)
    return features


def _predictions(policy: SequencePolicy, windows: Windows, name: str) -> Tensor:
    batch = len(windows.mask)
    size = windows.actions.shape[-1] if windows.actions.ndim == 3 else None
    expected = (batch, len(policy.head.embeddings) if size is None else size)  # type: ignore[arg-type]
    with blamed(name, "act"):
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


def _alike(first: Tensor, second: Tensor, *, tolerance: float = _TOLERANCE) -> bool:
    scale = float(first.nan_to_num(0, 0, 0).abs().max()) if first.numel() else 0.0
    return torch.allclose(first, second, rtol=0, atol=tolerance * scale, equal_nan=True)
