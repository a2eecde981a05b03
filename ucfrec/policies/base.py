"""Base of all sequence policies: configuration, normalisation, action loss."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.episodes.exposure import ExposureTerm, Likeness
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Exposed, Windows
from ucfrec.errors import InputError
from ucfrec.policies.heads import Head, ItemHead, VectorHead
from ucfrec.settings import Dropout, Width, require, settings_table

_CLIP = 10.0
"""Standardised states beyond this many standard deviations are clipped."""
_KNOTS = 6
"""Returns-to-go at which an exposure term has weights of its own."""

Context = Annotated[int, Field(ge=1, le=4096)]
Layers = Annotated[int, Field(ge=1, le=128)]
Heads = Annotated[int, Field(ge=1, le=1024)]
Kernel = Annotated[int, Field(ge=1, le=4096)]
Returns = Literal["auto", "session", "horizon"]
Timesteps = Annotated[int, Field(ge=1, le=10_000_000)]


@settings_table("policy")
class PolicyConfig:
    """Settings of every sequence policy."""

    context: Context = 20
    """K, steps of history that a prediction uses."""
    dim: Width = 128
    """d, width of the model."""
    dropout: Dropout = 0.1
    """Share of the model's activations that is set to 0 in training."""
    return_scale: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """Returns-to-go are divided by this; 0 selects the largest absolute training return."""
    max_timestep: Timesteps = 1000
    """Rows of the timestep embedding; later steps share the last row. 1 hides the time."""
    return_to_go: Returns = "auto"
    """What returns-to-go count: the whole rest of the `session`, or the next `horizon` steps.
    `auto` is the horizon where the sessions of the log are users, whose rest shows how many rows a
    user has left, and otherwise the session."""
    horizon: Annotated[int, Field(ge=1, le=10**6)] = 1
    """Steps that returns-to-go of a horizon count."""
    exposure: bool = False
    """Whether the logits of items depend on what the session was shown lately: on repetitions, and
    on shared tags or, without tags, on similar embeddings."""
    exposure_window: Annotated[int, Field(ge=1, le=1000)] = 10
    """Earlier steps that count as lately, as far as `context` reaches."""
    best_share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the training episodes to learn from, those with the highest returns; for `bc`, 0.1
    is the 10% BC of Chen et al. (2021)."""

    sampled_above: Annotated[int, Field(ge=0, le=10**12)] = 10_000
    """Items above which training takes the softmax over sampled items instead of all, at a cost
    that does not grow with the catalogue. Validation losses are those of all items."""
    sampled_items: Annotated[int, Field(ge=1, le=10**7)] = 2048
    """Items that are sampled for a training batch of a large catalogue."""

    def returns(self, session_by: str | None) -> ReturnToGo:
        """What returns-to-go count in a log whose sessions are made `session_by`."""
        definition = self.return_to_go
        if definition == "auto":
            definition = "horizon" if session_by == "user" else "session"
        return ReturnToGo(definition, self.horizon)


class SequencePolicy(nn.Module, ABC):
    """Predicts a_t from returns-to-go and states up to t and actions before t.

    Subclasses implement `features`. Statistics of the data (normalisation, item embeddings) are
    buffers, so that a checkpoint is complete.
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    augmented: ClassVar[bool] = False
    """Whether the default of `augment.copies` is above 0 for this policy."""
    chosen: ClassVar[tuple[str, ...]] = ()
    """Buffers that `make_solver` chooses on held-out episodes; a refit keeps them."""
    items_only: ClassVar[str] = ""
    """Name of a policy that recommends items and refuses vectors; empty for others."""
    literal: ClassVar[bool] = False
    """Whether items, too, are learned as the paper says: all steps are equally likely to end a
    window, which leaves the last ones of a session in few of them, and no initial value is that of
    `begin_with_items`."""
    presets: ClassVar[Mapping[str, Any]] = {}
    """Defaults of this policy for settings outside the table `policy`, by `table.field`."""

    state_mean: Tensor
    state_std: Tensor
    return_scale: Tensor
    lowest_return_to_go: Tensor
    head: Head

    def __init__(self, config: PolicyConfig, sizes: Mapping[str, int]) -> None:
        """Sizes are `state` S; `action` A, the size of an action vector or of an item's embedding;
        `items`, the number of items, 0 if actions are vectors; and `tags`, the most tags of an
        item, 0 if that is omitted."""
        super().__init__()
        if self.items_only and not sizes["items"]:
            raise InputError(
                f"{self.items_only} recommends items; this store's actions are vectors; use "
                "another policy"
            )
        self.config = config
        self.register_buffer("state_mean", torch.zeros(sizes["state"]))
        self.register_buffer("state_std", torch.ones(sizes["state"]))
        self.register_buffer("return_scale", torch.ones(()))
        self.register_buffer("lowest_return_to_go", torch.tensor(-torch.inf))
        self.head = _new_head(config, sizes)

    @classmethod
    def training_view(
        cls,
        train: EpisodeStore,
        config: PolicyConfig,
        folder: Path,
        seed: int,
    ) -> EpisodeStore:
        """The episodes to train on, derived from the training episodes; by default the share
        `best_share` of them with the highest returns. The folder keeps intermediate results."""
        if config.best_share == 1:
            return train
        count = int(np.ceil(config.best_share * train.n_episodes))
        best = np.argsort(-train.returns, kind="stable")[:count]
        return train.select(np.sort(best))

    def begin_with_items(self) -> None:
        """Let items say more than their places at the begin of a training: embeddings of places
        are small, and products with item vectors are not divided by √d, so that these, which begin
        near 0, learn as fast as the rest. Vectors of items that come and go would be noise."""
        for name, module in self.named_modules():
            if name.endswith(("embed_timestep", "embed_position")):
                draw_normal(module.weight, std=0.02)
            elif name == "head.project":
                draw_normal(module.weight, std=0.02 / self.config.dim**0.5)
                nn.init.zeros_(module.bias)
            elif name == "final_norm":
                nn.init.constant_(module.weight, self.config.dim**0.5)

    def start_from(self, train: EpisodeStore) -> None:
        """Set buffers from the training episodes, before the first update."""

    def make_solver(
        self,
        train: EpisodeStore,
        validation: EpisodeStore | None,
        folder: Path,
        seed: int,
    ) -> Callable[[], None] | None:
        """What fits the policy without the training loop; None if gradients have to. Validation
        episodes are None in a refit, which keeps what was `chosen` on them."""
        return None

    @abstractmethod
    def features(self, windows: Windows) -> Tensor:
        """Inputs (B, K, d) of the action head, from normalised windows.

        Row t ignores a_t, r_t and all later steps, and how much padding is before the session:
        windows are padded to the longest of a batch, and exported graphs to K steps.
        """

    def last_features(self, windows: Windows) -> Tensor:
        """Row K − 1 of `features`, (B, d), for acting; subclasses may omit what it ignores."""
        return self.features(windows)[:, -1]

    def normalize(self, windows: Windows) -> Windows:
        """Standardised states, and returns-to-go divided by `return_scale`.

        These are first raised to the lowest of the training data, whose range they would otherwise
        leave after a session has reached its target return.
        """
        states = standardise(windows.states, self.state_mean, self.state_std)
        returns_to_go = windows.returns_to_go.clamp(min=self.lowest_return_to_go)
        return replace(windows, states=states, returns_to_go=returns_to_go / self.return_scale)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean action loss over all steps of the windows, and scalars to log (Algorithm 6): nats
        for items; for vectors, the squared error relative to the action's range."""
        normalized = self.normalize(windows)
        return self.imitation(self.features(normalized), normalized)

    def imitation(self, features: Tensor, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Action loss over all steps of normalised windows with features (B, K, d)."""
        padded = some_padding(windows.decided)
        exposed = self.exposed(windows, padded)

        def steps(values: Tensor) -> Tensor:  # (B, K, …) -> (M, …)
            return values.flatten(0, 1) if padded is None else values[padded]

        losses = self.head.losses(steps(features), steps(windows.actions), exposed)
        value = losses.mean()
        return value, {"action_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean action loss over the windows' last steps, the validation loss."""
        normalized = self.normalize(windows)
        features, exposed = self.last_features(normalized), self.exposed(normalized, last=True)
        return self.head.losses(features, windows.actions[:, -1], exposed).mean()

    def act(self, windows: Windows) -> Tensor:
        """Predictions at the last step: actions (B, A), or logits over items (B, n_items)."""
        return self.act_and_features(windows)[0]

    def act_and_features(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Predictions at the last step, and the features (B, d) that they are made from."""
        normalized = self.normalize(windows)
        features, exposed = self.last_features(normalized), self.exposed(normalized, last=True)
        return self.head.predict(features, exposed), features

    def exposed(
        self,
        windows: Windows,
        steps: Tensor | None = None,
        last: bool = False,
    ) -> Exposed | None:
        """What was shown before each of the (B·K) steps, before the `steps` of a mask (B, K), or
        before the `last` steps (B,) alone; None without `policy.exposure` and offers."""
        if self.head.exposure is None and windows.offer is None and windows.times is None:
            return None
        lags = 1 if self.head.exposure is None else self.head.exposure.lags
        if last:
            return Exposed.before_last(windows, lags)
        return Exposed.before(windows, lags, steps)


def _new_head(config: PolicyConfig, sizes: Mapping[str, int]) -> Head:
    items, size = sizes["items"], sizes["action"]
    if not items:
        return VectorHead(config.dim, size)
    exposure = None
    lags = min(config.exposure_window, config.context - 1)
    if config.exposure and lags:
        likeness = Likeness(items, size, sizes.get("tags", 0))
        exposure = ExposureTerm(lags, _KNOTS, likeness)
    samples = config.sampled_items if items > config.sampled_above else 0
    return ItemHead(config.dim, items, size, exposure, samples)


def standardise(states: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """States (..., S) in standard deviations from their mean, clipped."""
    return ((states - mean) / std).clamp(-_CLIP, _CLIP)


def require_heads(config: PolicyConfig, heads: int) -> None:
    """Refuse a number of attention heads that does not divide the model's width."""
    require(
        config.dim % heads == 0,
        f"policy.heads is {heads}; it must divide policy.dim, which is {config.dim}",
        "policy.heads",
        "policy.dim",
    )


def some_padding(mask: Tensor) -> Tensor | None:
    """The mask (B, K) of steps that are no padding; None on a CPU, but for exports, if all are."""
    on_cpu = mask.device.type == "cpu" and not torch.compiler.is_compiling()
    return None if on_cpu and bool(mask.all()) else mask


def draw_normal(weight: Tensor, std: float = 1.0) -> Tensor:
    """Fill `weight` from N(0, std²), unless it has no memory, as where sizes are compared with
    those of a file: torch would import its compiler, which takes longer than torch itself."""
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)
    return weight


def embedding(rows: int, size: int) -> nn.Embedding:
    """`nn.Embedding(rows, size)`, with `draw_normal`."""
    return nn.Embedding(rows, size, _weight=draw_normal(torch.empty(rows, size)))


def embed_time(table: nn.Embedding, windows: Windows) -> Tensor:
    """Rows (B, K, d) of the steps' numbers in the table, the last for later ones."""
    return table(windows.timesteps.clamp(max=table.num_embeddings - 1))  # type: ignore[no-any-return]


def init_linear(module: nn.Module) -> None:
    """Initialise all linear layers as GPT-2 does: weights from N(0, 0.02²), biases 0."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            draw_normal(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)


def recurrent(network: nn.GRU, inputs: Tensor, mask: Tensor) -> Tensor:
    """Outputs (B, K, d) of a network with `batch_first` for left-padded inputs (B, K, c), whatever
    the padding before a session: it runs behind the steps. The mask (B, K) is false at padding."""
    length = mask.shape[1]
    padding = (~mask).sum(1, keepdim=True)
    places = torch.arange(length, device=mask.device)

    def roll(x: Tensor, by: Tensor) -> Tensor:
        rolled = (places + by) % length
        return x.gather(1, rolled.unsqueeze(-1).expand_as(x))

    return roll(network(roll(inputs, padding))[0], -padding)
