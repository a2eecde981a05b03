"""Files of a training that hold tensors with metadata (safetensors)."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import atomic_file, require_file

REMEDY: Final = "restore it or train again"
"""What to do about a damaged file."""
_Module = TypeVar("_Module", bound=nn.Module)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write named tensors and metadata that JSON can represent, atomically."""
    plain: dict[str, Tensor] = {}
    places = set()
    for name, tensor in tensors.items():
        plain[name] = tensor.detach().contiguous().cpu()
        place = plain[name].untyped_storage().data_ptr()
        if place in places:  # safetensors refuses tensors that share memory
            plain[name] = plain[name].clone()
        places.add(place)
    with atomic_file(path) as scratch:
        scratch.touch()
        mode = scratch.stat().st_mode
        try:
            # One entry: safetensors writes several in any order, and files of equal content are to
            # be equal.
            save_file(plain, scratch, metadata={"about": json.dumps(metadata)})
        except SafetensorError as error:
            raise InputError(
                f"{path} cannot be written ({error}); free disk space and run the command again"
            ) from None
        # safetensors restricts its files to their owner; give them the usual permissions.
        scratch.chmod(mode)


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors, on the CPU, and the metadata that `save_tensors` wrote."""
    # safetensors may call whatever it cannot read a missing file.
    require_file(path, REMEDY)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("about", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return tensors, dict(metadata)
    except (SafetensorError, OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); {REMEDY}") from None


def load_module(path: Path, build: Callable[[], _Module], tensors: dict[str, Tensor]) -> _Module:
    """Build a module and load `tensors` into it, which were read from `path`.

    The sizes of a module come from a record that may state any. They are compared with those of the
    tensors, which a file holds, before memory is allocated.
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
    path: Path, module: nn.Module, tensors: Mapping[str, Tensor], assign: bool = False
) -> None:
    """Load `tensors`, which were read from `path`, into `module`; copied unless `assign`.

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
