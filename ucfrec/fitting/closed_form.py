"""Fitting without a training loop, with the same files as one."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import nn

from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, load_weights, save_tensors
from ucfrec.fitting.loop import SILENT, Callbacks, Fit
from ucfrec.fitting.metrics_log import MetricsLog


def fit_once(
    module: nn.Module,
    solve: Callable[[], None],
    folder: Path,
    validate: Callable[[], float] | None,
    describe: str,
    callbacks: Callbacks = SILENT,
) -> Fit:
    """Fit `module` by one call of `solve`, or read it from `folder` if that was done before.

    Writes the files of `ucfrec.fitting.loop.fit` to `folder`, as after a single step:
    `last.safetensors` and `best.safetensors` (the same weights), `metrics.jsonl` and TensorBoard
    events.

    Args:
        module: fitted in place, and left in evaluation mode.
        solve: sets the weights of `module`.
        validate: the validation loss; called in evaluation mode without gradients. None for none.
        describe: name of the fit in error messages.

    Raises:
        InputError: the validation loss is not finite, or a file is damaged or does not fit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    last = folder / "last.safetensors"
    if last.exists():
        tensors, found = load_tensors(last)
        load_weights(last, module, tensors)
        module.eval()
        return Fit(1, 1, found["best_validation"], found["seconds"])
    start = time.perf_counter()
    solve()
    module.eval()
    with torch.no_grad():
        loss = math.nan if validate is None else validate()
    if validate is not None and not math.isfinite(loss):
        raise InputError(f"{describe}: the validation loss is {loss}; look for extreme values")
    seconds = time.perf_counter() - start
    log = MetricsLog(folder, 0)
    logged = {} if validate is None else {"validation_loss": loss}
    log.add(1, logged)
    log.close()
    about = {"step": 1, "best_step": 1, "best_validation": loss, "seconds": seconds}
    save_tensors(folder / "best.safetensors", module.state_dict(), about)
    save_tensors(last, module.state_dict(), about)
    callbacks.validation(1, logged)
    return Fit(1, 1, loss, seconds)
