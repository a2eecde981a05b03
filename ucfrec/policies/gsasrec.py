"""gSASRec (Petrov & Macdonald, 2023): SASRec with many negatives and a generalised BCE loss."""

import math
from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import require_items
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.sasrec import SASRecConfig, SASRecPolicy
from ucfrec.settings import Share, settings_table


@settings_table("policy")
class GSASRecConfig(SASRecConfig):
    """Settings of gSASRec; negatives and calibration are those of its authors' experiments."""

    negatives: Annotated[int, Field(ge=1, le=10**6)] = 256
    """k, items drawn uniformly as negatives of a training batch."""
    calibration: Share = 0.75
    """t, how far probabilities are calibrated: 0 is the usual binary cross-entropy."""


class GSASRecPolicy(SASRecPolicy):
    """SASRec whose loss takes the shown item as positive and k uniform items as negatives.

    L = −(β log σ(s⁺) + Σ log(1 − σ(s⁻))) / (k + 1), with β = α (t (1 − 1/α) + 1/α) and the sampling
    rate α = k / (n_items − 1) (Eq. 10 and 15 of the paper). Two deviations: all steps of a batch
    share their negatives, for speed, and the scores have the head's bias, which begins at the
    items' popularity. At the minimum softmax(s) is close to the items' probabilities, so the
    validation loss is that of SASRec.
    """

    Config = GSASRecConfig
    config: GSASRecConfig

    def __init__(self, config: GSASRecConfig, sizes: Mapping[str, int]) -> None:
        require_items("gsasrec", sizes)
        super().__init__(config, sizes)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean gBCE over all steps of the windows, and scalars to log."""
        head = self.head
        assert isinstance(head, ItemHead)
        normalized = self.normalized(windows)
        valid = windows.mask
        features, shown = self.features(normalized)[valid], windows.actions[valid]
        exposed = self.exposed(normalized)
        exposed = None if exposed is None else exposed.select(valid.flatten())
        items = self._drawn(len(head.bias))
        rate = min(1.0, (len(items) - 1) / max(1, len(head.bias) - 1)) or 1.0
        t = self.config.calibration
        beta = rate * (t * (1 - 1 / rate) + 1 / rate)
        # Where the bias is the log share of an item, the scores are the loss's best ones.
        offset = math.log(beta / rate)
        negative = head.logits_of(features, items, exposed) + offset
        positive = head.logit(features, shown, exposed) + offset
        others = items != shown.unsqueeze(1)
        against = (F.softplus(negative) * others).sum(1)
        losses = (against - beta * F.logsigmoid(positive)) / (len(items) + 1)
        value = losses.mean()
        return value, {"gbce_loss": value.detach()}

    def _drawn(self, n_items: int) -> Tensor:
        """Items (L,), ascending, each once: k uniform ones, or all of a small catalogue."""
        device = self.state_mean.device
        if n_items <= self.config.negatives:
            return torch.arange(n_items, device=device)
        drawn = torch.randint(n_items, (self.config.negatives,), device=device)
        found: Tensor = torch.unique(drawn)
        return found
