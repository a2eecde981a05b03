"""Checkpoints: one safetensors file each, with metadata as JSON in the file's header."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import torch
import xxhash
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import atomic_file
from ucfrec.fitting.average import PREFIX, WeightAverage, averages

REMEDY: Final = "restore it or train again"
"""What to do about a damaged file."""
_OPTIMIZER = "optimizer."
_Module = TypeVar("_Module", bound=nn.Module)


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write named tensors and metadata that JSON can represent, atomically.

    Raises:
        InputError: the disk is full, or the folder is not writable.
    """
    plain = _apart(tensors)
    with atomic_file(path) as scratch:
        scratch.touch()
        mode = scratch.stat().st_mode
        try:
            about = json.dumps(metadata)
            # One entry: safetensors writes several in any order, and files of equal content are to
            # be equal.
            save_file(plain, scratch, metadata={"about": f"{about}\n{_checksum(plain, about)}"})
            # safetensors restricts its files to their owner; give them the usual permissions.
            scratch.chmod(mode)
        except SafetensorError as error:
            raise InputError(
                f"{path} cannot be written ({error}); free disk space and run the command again"
            ) from None


def _apart(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors on the CPU; safetensors refuses those that share memory, so these are copies."""
    plain: dict[str, Tensor] = {}
    taken = set()
    for name, tensor in tensors.items():
        plain_tensor = tensor.detach().contiguous().cpu()
        place = plain_tensor.untyped_storage().data_ptr()
        plain[name] = plain_tensor.clone() if place in taken else plain_tensor
        taken.add(place)
    return plain


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors, on the CPU, and the metadata that `save_tensors` wrote.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        # safetensors may call whatever it cannot read a missing file.
        if not path.is_file():
            raise InputError(f"{path} does not exist")
        with safe_open(path, framework="pt") as file:
            stated = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is damaged ({error}); {REMEDY}") from None
    about, _, checksum = stated.get("about", "{}").partition("\n")
    if checksum != _checksum(tensors, about):
        raise InputError(f"{path} is damaged (its checksum differs); restore it or train again")
    with damage_explained(path, REMEDY):
        return tensors, dict(json.loads(about))


def _checksum(tensors: Mapping[str, Tensor], about: str) -> str:
    """XXH3 (64 bits, hexadecimal) of names, types, shapes and values of tensors, and of a text."""
    digest = xxhash.xxh3_64(about.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        if tensor.numel():
            digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def save_training(
    path: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    counters: dict[str, Any],
    average: WeightAverage | None = None,
) -> None:
    """Write everything that resuming a training needs: weights, optimizer state and counters.

    Raises:
        InputError: the disk is full, or the folder is not writable.
    """
    tensors = dict(module.state_dict())
    for index, moments in optimizer.state_dict()["state"].items():
        for key, value in moments.items():
            tensors[f"{_OPTIMIZER}{index}.{key}"] = value
    if average is not None:
        means, steps = average.state()
        tensors, counters = tensors | means, counters | steps
    save_tensors(path, tensors, counters)


def load_training(
    path: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    average: WeightAverage | None = None,
) -> dict[str, Any]:
    """Restore `module`, `optimizer` and `average`, in place, from what `save_training` wrote.

    Raises:
        InputError: the file is missing or damaged, or holds weights of another architecture.
    """
    tensors, counters = load_tensors(path)
    state: dict[int, dict[str, Tensor]] = {}
    with damage_explained(path, REMEDY):
        for name in [name for name in tensors if name.startswith(_OPTIMIZER)]:
            index, key = name.removeprefix(_OPTIMIZER).split(".")
            state.setdefault(int(index), {})[key] = tensors.pop(name)
    means = {name: tensors.pop(name) for name in [*tensors] if name.startswith(PREFIX)}
    load_weights(path, module, tensors)
    with damage_explained(path, REMEDY):
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": state, "param_groups": groups})
        if average is not None:
            average.restore(means, counters)
    return counters


def load_trained(path: Path) -> dict[str, Tensor]:
    """The trained weights in a file of `save_tensors` or `save_training`: averages where it has
    them, without what only resuming needs.

    Raises:
        InputError: the file is missing or damaged.
    """
    tensors, counters = load_tensors(path)
    weights = {n: t for n, t in tensors.items() if not n.startswith((_OPTIMIZER, PREFIX))}
    with damage_explained(path, REMEDY):
        return weights | averages(tensors, weights, counters)


def load_module(path: Path, build: Callable[[], _Module], tensors: dict[str, Tensor]) -> _Module:
    """Build a module and load `tensors` into it.

    The sizes of a module come from a record that may state any. They are compared with those of the
    tensors, which a file holds, before memory is allocated.

    Args:
        path: where `tensors` were read from, for messages.

    Raises:
        InputError: they are the weights of another architecture.
    """
    try:
        with torch.device("meta"):
            unfilled: nn.Module | None = build()
    except Exception:  # a constructor that needs memory, or one whose error shows below
        unfilled = None
    if unfilled is not None:
        load_weights(path, unfilled, tensors, assign=True)
    with damage_explained(path, REMEDY):
        module = build()
    load_weights(path, module, tensors)
    return module


def load_weights(
    path: Path, module: nn.Module, tensors: dict[str, Tensor], assign: bool = False
) -> None:
    """Load `tensors` into `module`; `path`, where they were read from, is for the message.

    Args:
        assign: whether the tensors become those of the module; otherwise they are copied.

    Raises:
        InputError: they are the weights of another architecture.
    """
    try:
        module.load_state_dict(tensors, assign=assign)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise InputError(
            f"{path} holds weights of another architecture ({first}); use the settings that it was "
            "trained with, or another folder"
        ) from None
