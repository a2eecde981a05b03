"""Action heads, which embed and predict actions, vectors or items."""

from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.exposure import ExposureTerm
from ucfrec.episodes.offers import columns_of
from ucfrec.episodes.windows import Exposed
from ucfrec.user_model.running import HALF_LIVES_OF_DEMAND, Demand

_AT_ONCE = 2**24
"""Largest number of logits that a loss over all items of a large catalogue keeps at once."""


class Proposal:
    """Draws items with probability Q: half by training counts (n_items,) above 0, half evenly.

    By counts alone, items that the logs hardly show but the policy likes would be drawn too rarely
    for their weight; evenly alone, popular items would (`benchmarks/LOG.md`). Equal parts of
    the unit interval have one draw each: an item's are fewer than two off their expectation.
    """

    def __init__(self, counts: Tensor) -> None:
        share = counts.double() / counts.double().sum()
        self.share = (share + 1 / len(counts)) / 2
        self._cumulative = self.share.cumsum(0)

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        """The items (L,) of `count` draws, ascending, each once, and the logs (L,) of draws over
        their expected number, by torch's global generator."""
        cumulative, device = self._cumulative, self.share.device
        parts = torch.arange(count, device=device)
        points = (parts + torch.rand(count, device=device, dtype=torch.float64)) / count
        draws = torch.searchsorted(cumulative, points * cumulative[-1], right=True)
        draws = draws.clamp(max=len(cumulative) - 1)
        items, copies = torch.unique_consecutive(draws, return_counts=True)
        return items, torch.log(copies / (count * self.share[items])).float()


class VectorHead(nn.Module):
    """Continuous actions: a linear layer and tanh, trained by squared error (Algorithm 6)."""

    exposure: None = None
    scale: Tensor

    def __init__(self, dim: int, size: int) -> None:
        super().__init__()
        self.register_buffer("scale", torch.ones(size))
        self.embed_action = nn.Linear(size, dim)
        self.out = nn.Linear(dim, size)

    def embed(self, actions: Tensor) -> Tensor:
        """Embed actions (B, K, A) as (B, K, d)."""
        return self.embed_action(actions / self.scale)  # type: ignore[no-any-return]

    def predict(self, features: Tensor, exposed: Exposed | None = None) -> Tensor:
        """Actions (..., A) from features (..., d), within ± `scale`, the logs' largest value."""
        return torch.tanh(self.out(features)) * self.scale

    def losses(
        self,
        features: Tensor,
        actions: Tensor,
        exposed: Exposed | None = None,
    ) -> Tensor:
        """Mean squared errors (M,), in units of `scale`, by features (M, d) and actions (M, A)."""
        error = (self.predict(features) - actions) / self.scale
        return error.square().mean(-1)


class ItemHead(nn.Module):
    """Items: dot products with item vectors, trained by negative log-likelihood (Algorithm 6).

    An item's vector is a learned projection of its fixed embedding, which items without training
    steps have too, plus a correction learned per item. The bias begins as the log of the item's
    share of the training steps; `follow` moves it to the shares of the time. With an exposure term,
    what was shown lately moves the logits too: a dot product cannot say "unlike the last item".

    With `samples`, training takes the softmax over items drawn for the batch (`Proposal`) instead
    of all, subtracting the log of their expected number of draws from their logits (Bengio &
    Senécal, 2008), and gradients have rows of the items that took part only. In evaluation mode
    losses are those of all items.
    """

    embeddings: Tensor
    counts: Tensor
    prior: Tensor
    recency: Tensor
    mixture: Tensor

    def __init__(
        self,
        dim: int,
        n_items: int,
        embedding_size: int,
        exposure: ExposureTerm | None = None,
        samples: int = 0,
    ) -> None:
        """Samples are draws for the softmax of a training batch; 0 for that of all items."""
        super().__init__()
        self.samples = samples
        self.exposure = exposure
        self.register_buffer("embeddings", torch.zeros(n_items, embedding_size))
        self.register_buffer("counts", torch.ones(n_items))
        self.register_buffer("prior", torch.zeros(n_items))
        self.register_buffer("recency", torch.zeros(n_items))
        self.register_buffer("mixture", torch.tensor(HALF_LIVES_OF_DEMAND).isinf().float())
        self.project = nn.Linear(embedding_size, dim)
        self.correction = nn.Parameter(torch.zeros(n_items, dim))
        self.bias = nn.Parameter(torch.zeros(n_items))
        self._kept: tuple[tuple[object, ...], Tensor] | None = None
        self._proposal: Proposal | None = None
        self._demand: Demand | None = None

    def start_from(
        self,
        embeddings: Tensor,
        counts: Tensor,
        even: Tensor | None = None,
    ) -> None:
        """Set the embeddings (n_items, D), which are not copied, and, from training counts
        (n_items,), the bias: the log of an item's share, or of its counts over those of `even`
        draws (n_items,) from what was on offer, so that a new item begins as the mean one."""
        self.embeddings = embeddings.to(self.embeddings)
        self.counts.copy_(counts + 1)
        self._proposal = None
        totals = self.counts.sum() if even is None else even + 1
        self.prior.copy_(torch.log(self.counts / totals))
        self.bias.data.copy_(self.prior)

    def follow(self, demand: Demand) -> None:
        """Add to the bias by how much the items' shares at the time of a training step, and in
        evaluation mode the latest, exceed what the bias began with, so that the network learns what
        demand does not say."""
        self.mixture.copy_(demand.mixture)
        self.recency.copy_(demand.logs[-1] - self.prior)
        self._demand = replace(demand, logs=demand.logs.to(self.prior))

    def _sum_bias(self, exposed: Exposed | None, items: Tensor | None, apart: bool) -> Tensor:
        """The bias of `items` (L,), None for all, (L,) or at the times of M training steps (M, L);
        with `apart`, of one item (M,) of each step, (M,)."""
        places = slice(None) if items is None else items
        bias = self.bias if items is None else torch.gather(self.bias, 0, items, sparse_grad=True)
        if not self.training or self._demand is None or exposed is None or exposed.times is None:
            return bias + self.recency[places]
        rows = self._demand.bins.rows(exposed.times)
        rows = rows if apart or items is None else rows.unsqueeze(1)
        return bias + self._demand.logs[rows, places] - self.prior[places]

    def vectors(self, items: Tensor) -> Tensor:
        """Vectors (..., d) of int64 items (...,)."""
        projected: Tensor = self.project(self.embeddings[items])
        if self.samples:
            return projected + F.embedding(items, self.correction, sparse=True)
        return projected + self.correction[items]

    def all_vectors(self) -> Tensor:
        """Vectors (n_items, d) of all items.

        Without gradients they are computed once for each state of the weights. Fused optimizers and
        `.data` change weights without a trace, so gradients and changes of mode end what is kept.
        """
        if self.training or torch.is_grad_enabled():
            self._kept = None
            return self.project(self.embeddings) + self.correction  # type: ignore[no-any-return]
        weights = (self.embeddings, self.correction, self.project.weight, self.project.bias)
        state = tuple((id(weight), weight.data_ptr(), weight._version) for weight in weights)
        if self._kept is None or self._kept[0] != state:
            self._kept = state, self.project(self.embeddings) + self.correction
        return self._kept[1]

    def train(self, mode: bool = True) -> Self:
        """Enter training mode, or with `mode` false evaluation mode."""
        self._kept = None
        return super().train(mode)

    def embed(self, items: Tensor) -> Tensor:
        """Vectors (..., d) of int64 items (...); in evaluation mode without gradients, those kept,
        but for exported graphs."""
        if self.training or torch.is_grad_enabled() or torch.compiler.is_compiling():
            self._kept = None
            return self.vectors(items)
        return F.embedding(items, self.all_vectors())

    def predict(
        self,
        features: Tensor,
        exposed: Exposed | None = None,
        items: Tensor | None = None,
        offset: Tensor | float = 0.0,
    ) -> Tensor:
        """Logits over all items (..., n_items) from features (..., d), or (M, d) with what was
        shown before the M steps, which an exposure term needs; or those (M, L) over `items` (L,),
        ascending, each once, plus an `offset` (L,)."""
        vectors = self.all_vectors() if items is None else self.embed(items)
        bias = self._sum_bias(exposed, items, apart=False) + offset
        # Scaling the features instead of the logits saves two passes over the larger of them.
        features = features / features.shape[-1] ** 0.5
        logits = F.linear(features, vectors, bias if bias.dim() == 1 else None).float()
        logits = logits if bias.dim() == 1 else logits.add_(bias)
        if exposed is None:
            return logits
        if self.exposure is not None:
            logits = self.exposure.added_to(logits, exposed, items)
        if exposed.offer is None:
            return logits
        available = exposed.offer.mask(items).to(logits.device)
        return logits.masked_fill(~available, -torch.inf)

    def losses(
        self,
        features: Tensor,
        actions: Tensor,
        exposed: Exposed | None = None,
    ) -> Tensor:
        """The negative log-likelihood (M,), nats, of steps: features (M, d), actions (M,)."""
        if not self.samples:
            logits = self._predict_with(actions, features, exposed)
            return F.cross_entropy(logits, actions, reduction="none")
        logit = self.logit(features, actions, exposed)
        if not self.training:
            # The softmax over all items, some at once.
            items = torch.arange(len(self.counts), device=features.device)
            parts = [
                self.predict(features, exposed, part).logsumexp(-1)
                for part in torch.split(items, max(1, _AT_ONCE // max(1, len(features))))
            ]
            return torch.stack(parts).logsumexp(0) - logit
        items, logits, _ = self._sample_logits(features, exposed)
        # The logged item counts as itself, not as one that was drawn.
        column = columns_of(actions, items)
        rows = torch.nonzero(column >= 0)[:, 0]
        logits = logits.index_put_((rows, column[rows]), logits.new_tensor(-torch.inf))
        return torch.logaddexp(logits.logsumexp(-1), logit) - logit

    def _predict_with(self, actions: Tensor, features: Tensor, exposed: Exposed | None) -> Tensor:
        """`predict`; the logged items (M,) count as on offer, whatever the table of items says."""
        logits = self.predict(features, exposed)
        if exposed is None or exposed.offer is None:
            return logits
        return logits.scatter(
            1, actions.unsqueeze(1), self.logit(features, actions, exposed).unsqueeze(1)
        )

    def entropy(self, features: Tensor, exposed: Exposed | None = None) -> Tensor:
        """Mean entropy (nats) of the distributions at M steps; estimated from samples as losses."""
        if not (self.samples and self.training):
            logs = self.predict(features, exposed).log_softmax(-1)
            of_all: Tensor = -(logs.exp() * logs).sum(-1).mean()
            return of_all
        _, logits, log_weights = self._sample_logits(features, exposed)
        logs = logits.log_softmax(-1)
        terms = logs.exp() * (logs - log_weights)
        estimate: Tensor = -terms.sum(-1).mean()
        return estimate

    def _sample_logits(
        self, features: Tensor, exposed: Exposed | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Items (L,) as `Proposal.draw`s them, logits (M, L) plus log weights, and these (L,)."""
        if self._proposal is None or self._proposal.share.device != self.counts.device:
            self._proposal = Proposal(self.counts)
        items, log_weights = self._proposal.draw(self.samples)
        return items, self.predict(features, exposed, items, log_weights), log_weights

    def logit(
        self,
        features: Tensor,
        actions: Tensor,
        exposed: Exposed | None,
    ) -> Tensor:
        """Logits (M,) of the logged items."""
        product = (features * self.embed(actions)).sum(-1)
        product = product / features.shape[-1] ** 0.5
        logit: Tensor = product + self._sum_bias(exposed, actions, apart=True)
        if self.exposure is not None and exposed is not None:
            return logit + self.exposure.to_items(exposed, actions.unsqueeze(1))
        return logit


Head = VectorHead | ItemHead
