"""What models of future reward see of a logged step, kept on disk in bounded memory."""

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Float32Array
from ucfrec.off_policy.score import ScoredSteps

_PRODUCTS = 256
_LOWEST_SCORE = -20.0
ROWS_AT_ONCE = 8192
_NUMBERS_AT_ONCE = 2**22
"""Of the rows that are in memory at a time; long rows are read fewer at once."""


@dataclass(frozen=True)
class StepInputs:
    """B logged steps as the models see them."""

    context: Tensor
    """(B, C): the state (S), then what the policy knows beside it: the return that is left of its
    target, and its own features of the window of earlier steps."""
    state_size: int
    """S."""
    chosen: Tensor
    """(B, D) embedding of the logged item; zeros for an item that the run does not know."""
    shown: Tensor
    """(B, D) mean embedding over the items that the evaluated policy shows."""
    scores: Tensor
    """(B, 2) logarithm of the policy's probability of the logged item, and its mean over the items
    that the evaluated policy shows."""

    def features(self) -> tuple[Float32Array, Float32Array]:
        """Features (B, P) of state and logged item, and their mean over the evaluated policy's."""
        parts = ((self.chosen, 0), (self.shown, 1))
        of_chosen, of_shown = (
            _features(self.context, self.state_size, items, self.scores[:, [column]])
            for items, column in parts
        )
        return of_chosen, of_shown


def context_of(batch: ScoredSteps) -> Tensor:
    """(B, C) state, return left of the target, and last-layer features of the policy's window.

    A policy that is not a network of features (item-knn, crm-greedy) has the first two only.
    """
    parts = [batch.states, batch.returns_left[:, None]]
    parts += [] if batch.features is None else [batch.features]
    return torch.cat([part.float() for part in parts], dim=1)


class InputsFile:
    """Inputs of N steps in a temporary file: some hundred numbers a step on disk, none in memory.

    A context manager; the file is removed at its end.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="ucfrec-")  # noqa: SIM115
        self._sizes: tuple[int, int, int] | None = None

    def __enter__(self) -> "InputsFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, inputs: StepInputs) -> None:
        """Write the next steps."""
        self._sizes = (inputs.context.shape[1], inputs.state_size, inputs.chosen.shape[1])
        parts = (inputs.context, inputs.chosen, inputs.shown, inputs.scores)
        self._file.write(np.asarray(torch.cat(parts, dim=1), dtype=np.float32).tobytes())

    def chunks(self) -> Iterator[tuple[Float32Array, Float32Array]]:
        """All steps in order, some thousand at once, as `StepInputs.features`."""
        return (inputs.features() for inputs in self._inputs())

    def states(self) -> Iterator[Float32Array]:
        """(B, S) states of all steps in order, some thousand at once."""
        return (np.asarray(one.context[:, : one.state_size]) for one in self._inputs())

    def _inputs(self) -> Iterator[StepInputs]:
        assert self._sizes is not None
        context, state, item = self._sizes
        width = context + 2 * item + 2
        self._file.seek(0)
        at_once = max(1, min(ROWS_AT_ONCE, _NUMBERS_AT_ONCE // width))
        while read := self._file.read(4 * width * at_once):
            rows = torch.from_numpy(np.frombuffer(read, dtype=np.float32).reshape(-1, width).copy())
            parts = torch.split(rows, [context, item, item, 2], dim=1)
            yield StepInputs(parts[0], state, parts[1], parts[2], parts[3])


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


def scores_of(
    log_probabilities: Tensor, items: Tensor, shown_probabilities: Tensor
) -> tuple[Tensor, Tensor]:
    """The policy's log-probability (B,) of each item, and its mean (B,) over what is shown.

    Args:
        log_probabilities: (B, n_items).
        items: (B,) numbers; −1, an unknown item, has the mean.
        shown_probabilities: (B, n_items) of the evaluated policy.
    """
    scores = log_probabilities.clamp(min=_LOWEST_SCORE)
    mean = (shown_probabilities * scores).sum(1)
    chosen = scores.gather(1, items[:, None].clamp(min=0))[:, 0]
    return torch.where(items >= 0, chosen, mean), mean


def _features(context: Tensor, state_size: int, items: Tensor, score: Tensor) -> Float32Array:
    """Features (B, P), linear in item embeddings (B, D) and score (B, 1): a constant 1, the
    context, the item, and products of the two.

    The three embeddings at the start of a state (`ucfrec.episodes.states.ItemStates`) and the
    return left are multiplied with the item's own, dimension by dimension. The rest of the state
    (user, observation) is multiplied with as many of the item's first dimensions as `_PRODUCTS`
    allows.
    """
    dim = items.shape[1]
    states, left = context[:, :state_size], context[:, [state_size]]
    led_by, rest = states[:, : 3 * dim], states[:, 3 * dim :]
    leading = items[:, : _PRODUCTS // max(rest.shape[1], 1)]
    products = (rest.unsqueeze(2) * leading.unsqueeze(1)).flatten(1)
    ones = torch.ones(len(items), 1)
    parts = [ones, context, items, score, led_by * items.repeat(1, 3), left * items, products]
    return np.asarray(torch.cat(parts, dim=1))
