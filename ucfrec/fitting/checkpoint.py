"""Checkpoints: one safetensors file each, numbers about it in the file's own header."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ucfrec.errors import InputError
from ucfrec.files import atomic_file

_OPTIMIZER = "optimizer."


def save_tensors(path: Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
    """Write named tensors and a JSON-able header, atomically.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    plain = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    with atomic_file(path) as scratch:
        scratch.touch()
        mode = scratch.stat().st_mode
        try:
            save_file(plain, scratch, metadata={"about": json.dumps(about)})
            # safetensors makes files that nobody else may read; runs are shared like other outputs.
            scratch.chmod(mode)
        except SafetensorError as error:
            raise InputError(
                f"{path} cannot be written ({error}); make room and give the same command again"
            ) from None


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_tensors` wrote.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, about  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path} does not exist") from None
    except SafetensorError as error:
        raise InputError(f"{path} is damaged ({error}); restore it or train again") from None


def save_training(
    path: Path, module: nn.Module, optimizer: torch.optim.Optimizer, about: dict[str, Any]
) -> None:
    """Write all that a training loop needs to go on: weights, optimizer moments, counters."""
    tensors = dict(module.state_dict())
    for index, moments in optimizer.state_dict()["state"].items():
        for key, value in moments.items():
            tensors[f"{_OPTIMIZER}{index}.{key}"] = value
    save_tensors(path, tensors, about)


def load_training(
    path: Path, module: nn.Module, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:
    """Restore what `save_training` wrote, in place; returns the counters."""
    tensors, about = load_tensors(path)
    state: dict[int, dict[str, Tensor]] = {}
    for name in [name for name in tensors if name.startswith(_OPTIMIZER)]:
        index, key = name.removeprefix(_OPTIMIZER).split(".")
        state.setdefault(int(index), {})[key] = tensors.pop(name)
    load_weights(path, module, tensors)
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
    return about


def load_weights(path: Path, module: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Put `tensors`, read from `path`, into `module`.

    Raises:
        InputError: they are another architecture's.
    """
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise InputError(f"{path} holds weights of another architecture: {first}") from None
