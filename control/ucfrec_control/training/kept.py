"""The last checkpoints of a training, with raw and with averaged weights."""

from pathlib import Path
from typing import Final

from ucfrec.fitting.checkpoint import load_raw, load_tensors, load_trained, save_tensors
from ucfrec.fitting.loop import Callbacks, LoopConfig

KEPT: Final = 5
"""Checkpoints that are kept of a training."""
RAW, AVERAGED = "raw", "averaged"
"""The weights of a step themselves, and their exponential moving average."""
_LOADERS: Final = {RAW: load_raw, AVERAGED: load_trained}
WEIGHTS: Final = tuple(_LOADERS)


def kept_steps(config: LoopConfig) -> list[int]:
    """Steps of the last checkpoints of a training, at most `KEPT`, the last first."""
    earlier = range(config.validate_every, config.steps, config.validate_every)
    return [config.steps, *reversed(earlier)][:KEPT]


def checkpoint_name(weights: str, step: int) -> str:
    """Name of a kept checkpoint, as `TrainedPolicy.load` takes it."""
    return f"{weights}-{step}"


def keeping(run: Path, config: LoopConfig) -> Callbacks:
    """Callbacks of a training that keep its last checkpoints in the run folder."""
    folder = run / "policy"
    last = folder / "last.safetensors"
    steps = kept_steps(config)

    def keep(step: int) -> None:
        for weights, loaded in _LOADERS.items():
            path = folder / f"{checkpoint_name(weights, step)}.safetensors"
            if step in steps and not path.exists():
                save_tensors(path, loaded(last), {"step": step})

    if last.exists():  # the training may have been interrupted before it was kept
        keep(int(load_tensors(last)[1]["step"]))
    return Callbacks(on_validation=lambda step, logged: keep(step))
