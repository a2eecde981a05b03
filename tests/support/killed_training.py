"""Trains a small module in processes that are killed at random moments, until one gets to the end.

    python killed_training.py SEED FOLDER

Prints how many were killed and what the last loop returned. Each is a fork of one interpreter."""

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.fitting.loop import Fit, LoopConfig, fit

STEPS, EVERY = 162, 3


def module() -> nn.Module:
    """With dropout and with buffers that training moves."""
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(4, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Dropout(0.5), nn.Linear(16, 1)
    )


def batch(generator: np.random.Generator, size: int) -> tuple[Tensor, Tensor]:
    x = torch.from_numpy(generator.normal(size=(size, 4)).astype(np.float32))
    return x, x.square().sum(1, keepdim=True)


def train(folder: Path) -> Fit:
    net = module()
    held_out = batch(np.random.default_rng(99), 64)

    def loss(xy: tuple[Tensor, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        value = F.mse_loss(net(xy[0]), xy[1])
        return value, {"squared_error": value.detach()}

    def validate() -> float:
        return float(F.mse_loss(net(held_out[0]), held_out[1]))

    own = {"learning_rate": 0.05, "warmup_steps": 50, "clip_norm": 1.0, "patience": 0}
    config = LoopConfig(steps=STEPS, batch_size=8, validate_every=EVERY, **own)

    def draw(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        time.sleep(0.001)  # so that no machine is done before it is killed a few times
        return batch(generator, 8)

    return fit(net, draw, loss, config, folder, seed=5, validate=validate)


def optimizer_imported() -> None:
    """A first step imports half of torch, which every life would do again."""
    torch.optim.AdamW(module().parameters()).step()


def life(work: Callable[[Path], None], folder: Path, seconds: float) -> bool:
    """Work on `folder` in a fork that is killed after `seconds`; whether it came to its end."""
    child = os.fork()
    if child == 0:
        try:
            work(folder)
            os._exit(0)
        finally:
            os._exit(1)
    killed_at, ended, status = time.monotonic() + seconds, 0, 0
    while not ended and time.monotonic() < killed_at:
        time.sleep(min(0.01, max(0.0, killed_at - time.monotonic())))
        ended, status = os.waitpid(child, os.WNOHANG)
    if not ended:
        os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return False
    if os.WEXITSTATUS(status):
        raise SystemExit("training failed")
    return True


def recorded(folder: Path) -> None:
    (folder / "fit.json").write_text(json.dumps(vars(train(folder))))


def main() -> None:
    torch.set_num_threads(1)
    optimizer_imported()
    moments = random.Random(int(sys.argv[1]))
    folder, killed = Path(sys.argv[2]), 0
    # Lives grow longer, so that a slow machine comes to an end as well.
    while not life(recorded, folder, moments.uniform(0.0, 0.07) * 1.2**killed):
        killed += 1
    print(json.dumps({"killed": killed, **json.loads((folder / "fit.json").read_text())}))


if __name__ == "__main__":
    main()
