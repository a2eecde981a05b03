"""What models of future reward see of a logged step, kept on disk in bounded memory."""

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Array, Float32Array
from ucfrec.off_policy.score import ScoredSteps
from ucfrec.runs.trained_policy import TrainedPolicy

_PRODUCTS = 256
_LOWEST_SCORE = -20.0
ROWS_AT_ONCE = 8192
_NUMBERS_AT_ONCE = 2**22
"""Of the rows that are in memory at a time; long rows are read fewer at once."""


@dataclass(frozen=True)
class StepInputs:
    """B logged steps as the models see them."""

    context: Tensor
    """(B, C): the state (S), the return that is left of the target, and last-layer features of the
    policy's window, which item-knn and crm-greedy lack."""
    state_size: int
    """S."""
    chosen: Tensor
    """(B, D) embedding of the logged item; zeros for an item that the run does not know."""
    shown: Tensor
    """(B, D) mean embedding over the items that the evaluated policy shows."""
    scores: Tensor
    """(B, 2) logarithm of the policy's probability of the logged item, and its mean over the items
    that the evaluated policy shows; an unknown item has the mean."""

    def features(self) -> tuple[Float32Array, Float32Array]:
        """Features (B, P) of state and logged item, and their mean over the evaluated policy's."""
        return (
            self._cross(self.chosen, self.scores[:, [0]]),
            self._cross(self.shown, self.scores[:, [1]]),
        )

    def _cross(self, items: Tensor, score: Tensor) -> Float32Array:
        """Features (B, P), linear in item embeddings (B, D) and score (B, 1): a constant 1, the
        context, the item, and products of the two.

        The three embeddings at the start of a state (`ucfrec.episodes.states.ItemStates`) and the
        return left are multiplied with the item's own, dimension by dimension. The rest of the
        state (user, observation) is multiplied with as many of the item's first dimensions as
        `_PRODUCTS` allows.
        """
        dim, size = items.shape[1], self.state_size
        left = self.context[:, [size]]
        embeddings, others = self.context[:, : 3 * dim], self.context[:, 3 * dim : size]
        leading = items[:, : _PRODUCTS // max(others.shape[1], 1)]
        products = (others.unsqueeze(2) * leading.unsqueeze(1)).flatten(1)
        ones, matches = torch.ones(len(items), 1), embeddings * items.repeat(1, 3)
        parts = [ones, self.context, items, score, matches, left * items, products]
        return np.asarray(torch.cat(parts, dim=1))


def make_inputs(trained: TrainedPolicy, batch: ScoredSteps) -> tuple[Array, Tensor, StepInputs]:
    """Compute the policy's probability and the models' inputs for B logged steps.

    An item that the run does not know (−1) has probability 0 and an embedding of zeros.

    Returns:
        The evaluated policy's probability (B,) of the logged item, and (B, n_items) of all items;
        and what the models see.
    """
    assert trained.item_states is not None
    embeddings = trained.item_states.embeddings
    known, column = batch.items >= 0, batch.items[:, None].clamp(min=0)
    probabilities = batch.log_probabilities.exp()
    target = probabilities.gather(1, column)[:, 0].double() * known
    # What the policy thinks of an item counts for the models also where the rule takes the best.
    scores = batch.scores.log_softmax(-1).clamp(min=_LOWEST_SCORE)
    mean_score = (probabilities * scores).sum(1)
    score = torch.where(known, scores.gather(1, column)[:, 0], mean_score)
    context = [batch.states, batch.returns_left[:, None]]
    context += [] if batch.features is None else [batch.features]
    inputs = StepInputs(
        context=torch.cat([part.float() for part in context], dim=1),
        state_size=batch.states.shape[1],
        chosen=embeddings[batch.items] * known[:, None],
        shown=probabilities @ embeddings,
        scores=torch.stack([score, mean_score], dim=1),
    )
    return target.clamp(0, 1).numpy(), probabilities, inputs


class InputsFile:
    """Inputs of N steps in a file without a name: some hundred numbers a step, none in memory."""

    def __init__(self, steps: int) -> None:
        self._steps, self._end = steps, 0
        self._rows = array_on_disk((0, 0))
        self._sizes: list[int] = []
        self._state_size = 0

    def append(self, inputs: StepInputs) -> None:
        """Write the next steps."""
        parts = (inputs.context, inputs.chosen, inputs.shown, inputs.scores)
        self._sizes = [part.shape[1] for part in parts]
        self._state_size = inputs.state_size
        if not self._end:
            self._rows = array_on_disk((self._steps, sum(self._sizes)))
        begin, self._end = self._end, self._end + len(inputs.context)
        self._rows[begin : self._end] = torch.cat(parts, dim=1).numpy()

    def chunks(self) -> Iterator[tuple[Float32Array, Float32Array]]:
        """All steps in order, some thousand at once, as `StepInputs.features`."""
        return (inputs.features() for inputs in self._read())

    def states(self) -> Iterator[Float32Array]:
        """(B, S) states of all steps in order, some thousand at once."""
        return (np.asarray(one.context[:, : one.state_size]) for one in self._read())

    def _read(self) -> Iterator[StepInputs]:
        at_once = max(1, min(ROWS_AT_ONCE, _NUMBERS_AT_ONCE // self._rows.shape[1]))
        for begin in range(0, self._steps, at_once):
            rows = torch.from_numpy(np.array(self._rows[begin : begin + at_once]))
            context, chosen, shown, scores = torch.split(rows, self._sizes, dim=1)
            yield StepInputs(context, self._state_size, chosen, shown, scores)


def array_on_disk(shape: tuple[int, int]) -> Float32Array:
    """An array of zeros whose memory the system can take back, writing it to a file without a name.

    Raises:
        OSError: the disk of the system's temporary folder is full.
    """
    if 0 in shape:
        return np.zeros(shape, dtype=np.float32)
    with tempfile.TemporaryFile(prefix="ucfrec-") as file:
        if hasattr(os, "posix_fallocate"):  # not on macOS
            # A full disk is an error now; later it would be the end of the process.
            os.posix_fallocate(file.fileno(), 0, 4 * shape[0] * shape[1])
        return np.memmap(file, np.float32, "r+", shape=shape)
