"""Where actions enter and leave a policy: vectors, or items of a catalogue."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SAMPLED_SOFTMAX_ABOVE = 100_000
"""Items beyond which the loss samples the softmax's denominator."""
SAMPLED_NEGATIVES = 4096


class VectorHead(nn.Module):
    """Continuous actions: a linear layer and tanh, trained by squared error (Algorithm 6)."""

    scale: Tensor

    def __init__(self, dim: int, size: int) -> None:
        super().__init__()
        self.register_buffer("scale", torch.ones(size))
        self.embed_action = nn.Linear(size, dim)
        self.out = nn.Linear(dim, size)

    def embed(self, actions: Tensor) -> Tensor:
        """(B, K, A) to (B, K, d)."""
        return self.embed_action(actions / self.scale)  # type: ignore[no-any-return]

    def predict(self, features: Tensor) -> Tensor:
        """(..., d) to actions (..., A), each within ± `scale`, the largest value in the logs."""
        return torch.tanh(self.out(features)) * self.scale

    def loss(self, features: Tensor, actions: Tensor) -> Tensor:
        """Mean squared error over M steps: features (M, d), actions (M, A)."""
        return F.mse_loss(self.predict(features) / self.scale, actions / self.scale)


class ItemHead(nn.Module):
    """Items: dot products with item vectors, trained by negative log-likelihood (Algorithm 6).

    An item's vector is a projection of its fixed embedding, which cold items have too, plus a
    correction learned for the item itself. The bias starts at the log of the item's share of the
    training steps, so that an untrained policy recommends what is popular.
    """

    embeddings: Tensor
    counts: Tensor

    def __init__(self, dim: int, n_items: int, embedding_size: int) -> None:
        super().__init__()
        self.register_buffer("embeddings", torch.zeros(n_items, embedding_size))
        self.register_buffer("counts", torch.ones(n_items))
        self.project = nn.Linear(embedding_size, dim)
        self.correction = nn.Parameter(torch.zeros(n_items, dim))
        self.bias = nn.Parameter(torch.zeros(n_items))

    def start_from(self, embeddings: Tensor, counts: Tensor) -> None:
        """Take over the embeddings (n_items, D) and training counts (n_items,) of a store."""
        self.embeddings.copy_(embeddings)
        self.counts.copy_(counts + 1)
        with torch.no_grad():
            self.bias.copy_(torch.log(self.counts / self.counts.sum()))

    def vectors(self, items: Tensor) -> Tensor:
        """(...,) int64 items to (..., d)."""
        return self.project(self.embeddings[items]) + self.correction[items]  # type: ignore[no-any-return]

    def embed(self, actions: Tensor) -> Tensor:
        """(B, K) int64 to (B, K, d)."""
        return self.vectors(actions)

    def predict(self, features: Tensor) -> Tensor:
        """(..., d) to logits over all items (..., n_items)."""
        vectors = self.project(self.embeddings) + self.correction
        logits: Tensor = features @ vectors.T / features.shape[-1] ** 0.5 + self.bias
        return logits

    def loss(self, features: Tensor, actions: Tensor) -> Tensor:
        """Mean negative log-likelihood over M steps: features (M, d), actions (M,)."""
        if len(self.counts) <= SAMPLED_SOFTMAX_ABOVE:
            return F.cross_entropy(self.predict(features), actions)
        return self.sampled_loss(features, actions, SAMPLED_NEGATIVES)

    def sampled_loss(self, features: Tensor, actions: Tensor, negatives: int) -> Tensor:
        """The same over a sampled denominator, corrected by log Q.

        Negatives come from the smoothed popularity Q; subtracting log Q from every logit keeps the
        estimate of the full softmax consistent (Bengio & Senécal, 2008).
        """
        share = self.counts / self.counts.sum()
        drawn = torch.multinomial(share, negatives, replacement=True)
        m, scale = len(actions), features.shape[-1] ** 0.5
        positive = (features * self.vectors(actions)).sum(-1) / scale + self.bias[actions]
        logits = features @ self.vectors(drawn).T / scale + self.bias[drawn]
        logits = logits - torch.log(negatives * share[drawn])
        accidental = drawn.unsqueeze(0) == actions.unsqueeze(1)
        negative = logits.masked_fill(accidental, -torch.inf)
        positive = positive.unsqueeze(1)
        target = torch.zeros(m, dtype=torch.int64, device=features.device)
        return F.cross_entropy(torch.cat([positive, negative], dim=1), target)


Head = VectorHead | ItemHead


def head_from(sizes: Mapping[str, Any], dim: int) -> Head:
    """The head for a store's kind of action."""
    if sizes["items"]:
        return ItemHead(dim, sizes["items"], sizes["action"])
    return VectorHead(dim, sizes["action"])
