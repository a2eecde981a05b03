"""A mean that ignores padding, and the supervised-attention (mask) loss."""

import torch
from torch import Tensor

EPSILON = 1e-8
"""Added inside the logarithm of Eq. 5 (Table 7)."""


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of `values` where `mask` is true; other values are ignored, even NaN."""
    return values[mask].mean()


def parent_targets(mask: Tensor, window: int, decay: float, previous_action: float) -> Tensor:
    """Target attention q of the row that predicts a_t, over tokens (R_0, s_0, a_0, R_1, …).

    Its parents are Ĝ_t and s_t with weight 1, s_{t−k} with weight decay^k for 1 ≤ k ≤ window, and
    a_{t−1} with weight `previous_action` (Table 7). Padded parents are dropped and the rest is
    normalised to sum to one.

    Args:
        mask: (B, K) bool, true at steps of the episode, false at padding.
        window: number of earlier states that are parents.
        decay: weight of the state k steps earlier is decay^k.
        previous_action: weight of a_{t−1}.

    Returns:
        (B, K, 3K); rows of padded steps are zero.
    """
    batch, length = mask.shape
    back = torch.arange(length).unsqueeze(1) - torch.arange(length)  # (K, K) t − j
    weights = torch.zeros(length, length, 3)
    weights[..., 0] = (back == 0).float()
    weights[..., 1] = torch.where((back >= 0) & (back <= window), decay ** back.clamp(min=0), 0.0)
    weights[..., 2] = previous_action * (back == 1).float()
    weights = (
        weights.to(mask.device) * mask.view(batch, 1, length, 1) * mask.view(batch, length, 1, 1)
    )
    targets = weights.reshape(batch, length, 3 * length)
    return targets / targets.sum(-1, keepdim=True).clamp(min=EPSILON)


def mask_loss(attention: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """Mean cross-entropy (nats) of attention against the causal parents (Eq. 5).

    Args:
        attention: (B, H, K, 3K) probabilities after the softmax, before dropout.
        targets: (B, K, 3K) from `parent_targets`.
        mask: (B, K) bool.
    """
    entropy = -(targets.unsqueeze(1) * torch.log(attention + EPSILON)).sum(-1)  # (B, H, K)
    return masked_mean(entropy.mean(1), mask)
