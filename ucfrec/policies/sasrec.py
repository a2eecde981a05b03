"""SASRec (Kang & McAuley, 2018), which predicts the next action from the earlier actions alone, and
gSASRec (Petrov & Macdonald, 2023), with many negatives and a generalised BCE loss."""

import math
from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Layers, SequencePolicy, embedding
from ucfrec.policies.dt import Block, DTConfig, pass_rows
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.ucf import Dropout, visible_tokens
from ucfrec.settings import Share, settings_table


@settings_table("policy")
class SASRecConfig(DTConfig):
    """Settings of SASRec; two blocks with one head, as in the paper."""

    layers: Layers = 2
    """Transformer blocks, each attention and a perceptron."""


class SASRecPolicy(SequencePolicy):
    """Causal self-attention over a_0, …, a_{t−1}, whose positions count from the newest; states,
    rewards and returns are not used. The loss is the action head's softmax; the paper's contrasts
    the item with a single random item."""

    Config = SASRecConfig
    config: SASRecConfig

    def __init__(self, config: SASRecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed_position = embedding(config.context, config.dim)
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d); row t depends on the actions before t."""
        return self._attend(windows, None)

    def last_features(self, windows: Windows) -> Tensor:
        """Row K − 1 of `features`, (B, d), without what the last block has for other steps."""
        return self._attend(windows, slice(-1, None))[:, 0]

    def _attend(self, windows: Windows, rows: slice | None) -> Tensor:
        """The `rows` of the features."""
        earlier = self.head.embed(windows.actions).roll(1, dims=1)
        # The first step of a window has no earlier action in the window.
        has_earlier = windows.mask & windows.mask.roll(1, dims=1)
        has_earlier[:, 0] = False
        tokens = earlier.masked_fill(~has_earlier.unsqueeze(-1), 0.0)
        positions = self.embed_position.weight[-windows.mask.shape[1] :]
        tokens = self.dropout(tokens + positions)
        features = pass_rows(self.blocks, tokens, visible_tokens(windows.mask), rows)
        return self.final_norm(features)  # type: ignore[no-any-return]


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
    rate α = k / (n_items − 1) (Eq. 10 and 15 of the paper). Here, all steps of a batch share their
    negatives, for speed, and the scores have the head's bias. At the minimum softmax(s) is close to
    the items' probabilities, so the validation loss is that of SASRec.
    """

    Config = GSASRecConfig
    config: GSASRecConfig
    items_only = "gsasrec"

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean gBCE over all steps of the windows, and scalars to log."""
        head = self.head
        assert isinstance(head, ItemHead)
        normalized = self.normalize(windows)
        valid = windows.decided
        features, actions = self.features(normalized)[valid], windows.actions[valid]
        exposed = self.exposed(normalized, valid)
        n_items, negatives, device = len(head.bias), self.config.negatives, features.device
        items = torch.arange(n_items, device=device)  # of a small catalogue, all
        if n_items > negatives:
            items = torch.unique(torch.randint(n_items, (negatives,), device=device))
        rate = min(1.0, (len(items) - 1) / max(1, n_items - 1)) or 1.0
        t = self.config.calibration
        beta = rate * (t * (1 - 1 / rate) + 1 / rate)
        # Where the bias is the log share of an item, the scores are the loss's best ones.
        offset = math.log(beta / rate)
        negative = head.predict(features, exposed, items) + offset
        positive = head.logit(features, actions, exposed) + offset
        is_negative = items != actions.unsqueeze(1)
        against = (F.softplus(negative) * is_negative).sum(1)
        losses = (against - beta * F.logsigmoid(positive)) / (len(items) + 1)
        value = losses.mean()
        return value, {"gbce_loss": value.detach()}
