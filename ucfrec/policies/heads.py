"""Action heads, which embed and predict actions: vectors, or items of a catalogue."""

from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.exposure import Exposed, ExposureTerm, Likeness

SAMPLED_SOFTMAX_ABOVE = 100_000
"""Number of items above which the loss samples the denominator of the softmax."""
SAMPLED_NEGATIVES = 4096
"""Items sampled for it per batch."""
EXPOSURE_KNOTS = 6
"""Returns-to-go at which an exposure term has weights of its own."""


class VectorHead(nn.Module):
    """Continuous actions: a linear layer and tanh, trained by squared error (Algorithm 6)."""

    scale: Tensor

    def __init__(self, dim: int, size: int) -> None:
        super().__init__()
        self.register_buffer("scale", torch.ones(size))
        self.embed_action = nn.Linear(size, dim)
        self.out = nn.Linear(dim, size)

    def embed(self, actions: Tensor) -> Tensor:
        """Embed actions (B, K, A) as (B, K, d)."""
        return self.embed_action(actions / self.scale)  # type: ignore[no-any-return]

    def predict(self, features: Tensor, exposed: None = None) -> Tensor:
        """Actions (..., A) from features (..., d), within ± `scale`, the logs' largest value."""
        return torch.tanh(self.out(features)) * self.scale

    def loss(self, features: Tensor, actions: Tensor, exposed: None = None) -> Tensor:
        """Mean squared error over M steps in units of `scale`: features (M, d), actions (M, A)."""
        return F.mse_loss(self.predict(features) / self.scale, actions / self.scale)

    def losses(self, features: Tensor, actions: Tensor, exposed: None = None) -> Tensor:
        """The squared error of each of M steps, (M,), whose mean is `loss`."""
        error = (self.predict(features) - actions) / self.scale
        return error.square().mean(-1)


class ItemHead(nn.Module):
    """Items: dot products with item vectors, trained by negative log-likelihood (Algorithm 6).

    An item's vector is a learned projection of its fixed embedding, which items without training
    steps have too, plus a correction learned per item. The bias is initialised to the log of the
    item's share of the training steps, so that an untrained policy recommends popular items.

    With an exposure term, what the session was shown lately moves the logits too; a dot product
    cannot say "unlike what was just shown".
    """

    embeddings: Tensor
    counts: Tensor

    def __init__(
        self, dim: int, n_items: int, embedding_size: int, exposure: ExposureTerm | None = None
    ) -> None:
        super().__init__()
        self.exposure = exposure
        self.register_buffer("embeddings", torch.zeros(n_items, embedding_size))
        self.register_buffer("counts", torch.ones(n_items))
        self.project = nn.Linear(embedding_size, dim)
        self.correction = nn.Parameter(torch.zeros(n_items, dim))
        self.bias = nn.Parameter(torch.zeros(n_items))
        self._kept: tuple[tuple[object, ...], Tensor] | None = None

    def start_from(self, embeddings: Tensor, counts: Tensor) -> None:
        """Set the embeddings (n_items, D) and, from training counts (n_items,), the bias."""
        self.embeddings.copy_(embeddings)
        self.counts.copy_(counts + 1)
        with torch.no_grad():
            self.bias.copy_(torch.log(self.counts / self.counts.sum()))

    def vectors(self, items: Tensor) -> Tensor:
        """Vectors (..., d) of int64 items (...,)."""
        return self.project(self.embeddings[items]) + self.correction[items]  # type: ignore[no-any-return]

    def all_vectors(self) -> Tensor:
        """Vectors (n_items, d) of all items.

        In evaluation mode without gradients they are computed once for each state of the weights.
        Fused optimizers and `.data` change weights without a trace, so whatever trains also ends
        what is kept: gradients, and any change of mode.
        """
        if self.training or torch.is_grad_enabled():
            self._kept = None
            return self.project(self.embeddings) + self.correction  # type: ignore[no-any-return]
        weights = (self.embeddings, self.correction, self.project.weight, self.project.bias)
        state = tuple((id(each), each.data_ptr(), each._version) for each in weights)
        if self._kept is None or self._kept[0] != state:
            self._kept = state, self.project(self.embeddings) + self.correction
        return self._kept[1]

    def train(self, mode: bool = True) -> Self:
        """Enter training mode, or with `mode` false evaluation mode."""
        self._kept = None
        return super().train(mode)

    def embed(self, actions: Tensor) -> Tensor:
        """Embed int64 items (B, K) as (B, K, d)."""
        if self.training or torch.is_grad_enabled():
            self._kept = None
            return self.vectors(actions)
        return F.embedding(actions, self.all_vectors())

    def predict(self, features: Tensor, exposed: Exposed | None = None) -> Tensor:
        """Logits over all items (..., n_items) from features (..., d).

        Args:
            features: (M, d) with `exposed`.
            exposed: what was shown before the M steps; needed with an exposure term.
        """
        # Scaling the features instead of the logits saves two passes over the larger of them.
        scaled = features / features.shape[-1] ** 0.5
        logits: Tensor = F.linear(scaled, self.all_vectors(), self.bias)
        if self.exposure is not None and exposed is not None:
            return self.exposure.added_to(logits, exposed)
        return logits

    def loss(self, features: Tensor, actions: Tensor, exposed: Exposed | None = None) -> Tensor:
        """Mean negative log-likelihood (nats) over M steps: features (M, d), actions (M,)."""
        return self._losses(features, actions, exposed, "mean")

    def losses(self, features: Tensor, actions: Tensor, exposed: Exposed | None = None) -> Tensor:
        """The negative log-likelihood (nats) of each of M steps, (M,), whose mean is `loss`."""
        return self._losses(features, actions, exposed, "none")

    def _losses(
        self, features: Tensor, actions: Tensor, exposed: Exposed | None, reduction: str
    ) -> Tensor:
        if len(self.counts) <= SAMPLED_SOFTMAX_ABOVE:
            return F.cross_entropy(self.predict(features, exposed), actions, reduction=reduction)
        return self.sampled_loss(features, actions, SAMPLED_NEGATIVES, exposed, reduction)

    def sampled_loss(
        self,
        features: Tensor,
        actions: Tensor,
        negatives: int,
        exposed: Exposed | None = None,
        reduction: str = "mean",
    ) -> Tensor:
        """Negative log-likelihood (nats) with `negatives` sampled items in the denominator.

        Negatives are drawn from the smoothed popularity Q; subtracting their log expected counts
        from their logits keeps the estimate of the full softmax consistent (Bengio & Senécal,
        2008). Features are (M, d), actions (M,).
        """
        share = self.counts / self.counts.sum()
        drawn = torch.multinomial(share, negatives, replacement=True)
        m, scale = len(actions), features.shape[-1] ** 0.5
        positive = (features * self.vectors(actions)).sum(-1) / scale + self.bias[actions]
        logits = features @ self.vectors(drawn).T / scale + self.bias[drawn]
        if self.exposure is not None and exposed is not None:
            positive = positive + self.exposure.to_items(exposed, actions.unsqueeze(1))
            logits = logits + self.exposure.to_items(exposed, drawn)
        logits = logits - torch.log(negatives * share[drawn])
        accidental = drawn.unsqueeze(0) == actions.unsqueeze(1)
        negative = logits.masked_fill(accidental, -torch.inf)
        positive = positive.unsqueeze(1)
        target = torch.zeros(m, dtype=torch.int64, device=features.device)
        return F.cross_entropy(torch.cat([positive, negative], dim=1), target, reduction=reduction)


Head = VectorHead | ItemHead


def head_from(sizes: Mapping[str, Any], dim: int, lags: int = 0) -> Head:
    """The head for a store's actions: items if `sizes["items"]` is above 0, otherwise vectors.

    Args:
        sizes: see `ucfrec.policies.base.SequencePolicy`.
        dim: width of the features.
        lags: earlier steps that an exposure term of items reads; 0 for no such term.
    """
    if not sizes["items"]:
        return VectorHead(dim, sizes["action"])
    exposure = None
    if lags:
        likeness = Likeness(sizes["items"], sizes["action"], sizes.get("tags", 0))
        exposure = ExposureTerm(lags, EXPOSURE_KNOTS, likeness)
    return ItemHead(dim, sizes["items"], sizes["action"], exposure)
