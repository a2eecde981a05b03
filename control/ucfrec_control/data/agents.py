"""Agents that Stable-Baselines3 (or its contrib package) saved, read as data.

A saved agent is a zip file: tensors in `policy.pth`, and settings in `data`, a JSON file in which
whatever JSON cannot say is pickled. Unpickling runs what its author wrote. Here the tensors are
read by PyTorch's loader of plain weights, the JSON without its pickled parts, and the network is
rebuilt from the names and shapes of the tensors. What these do not determine is refused.
"""

import io
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn

from ucfrec.acting.rollout import Memoryless
from ucfrec.arrays import BoolArray, Float32Array
from ucfrec.errors import InputError
from ucfrec_control.data.d4rl import first_line

_MOST_BYTES: Final = {"policy.pth": 2**30, "data": 2**26}
"""Sizes beyond which a file is refused before it is unpacked."""
_ACTIVATIONS: Final = {
    activation.__name__: activation for activation in (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU)
}
_LAYER: Final = re.compile(r"(.+)\.(\d+)\.(weight|bias)")
_CLIPPED_MEAN: Final = 2.0
"""Bound of the mean of agents with state-dependent exploration, where the file names no other."""


@dataclass(frozen=True)
class _Kind:
    """Where a family of algorithms keeps the network that acts."""

    hidden: str
    """Prefix of its hidden layers."""
    last: tuple[str, ...]
    """Possible names of its last layer."""
    activation: type[nn.Module]
    """Between the layers, where the file names none."""
    squashed: bool
    """Whether a tanh maps outputs to the action space; else they are clipped to it."""


_KINDS: Final = (
    # SAC, TQC; with state-dependent exploration the last layer is within a sequence.
    _Kind("actor.latent_pi", ("actor.mu", "actor.mu.0"), nn.ReLU, True),
    # PPO, A2C, TRPO
    _Kind("mlp_extractor.policy_net", ("action_net",), nn.Tanh, False),
    # TD3, DDPG: the last layer is the last of the sequence
    _Kind("actor.mu", (), nn.ReLU, True),
)


class Agent(Memoryless):
    """The deterministic action of a saved agent plus Gaussian noise (an `Actor` of `rollout`).

    Args:
        network: maps observations (N, O) to (N, A).
        squashed: whether its outputs, within [−1, 1], are stretched to the action space.
        noise: standard deviation of the noise, in halves of the action space's range.
    """

    def __init__(self, network: nn.Module, squashed: bool, space: Box, noise: float, seed: int):
        self._network, self._squashed = network.eval(), squashed
        self._low, self._high = (side.astype(np.float64) for side in (space.low, space.high))
        self._noise, self._generator = noise, np.random.default_rng(seed)

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Float32Array, None]:
        """Actions (N, A) within the action space, and None."""
        with torch.no_grad():
            out = self._network(torch.as_tensor(observations, dtype=torch.float32))
        mean, half = out.double().numpy(), (self._high - self._low) / 2
        if self._squashed:
            mean = self._low + half * (mean + 1)
        noise = self._noise * half * self._generator.normal(size=mean.shape)
        return np.clip(mean + noise, self._low, self._high).astype(np.float32), None


def read_agent(file: Path, observations: int, space: Box, noise: float, seed: int) -> Agent:
    """Read an agent of Stable-Baselines3, for an environment with observations of this size;
    further arguments as of `Agent`. InputError if the file is missing or damaged, or its network is
    not one of layers that its tensors determine in full (perceptrons of SAC, TQC, TD3, DDPG, PPO,
    A2C or TRPO), or of other sizes."""
    tensors, settings = _contents(file)
    kind, names = _kind_of(file, tensors)
    expected = {name for name in tensors if name.startswith((*names, "log_std", "actor.log_std"))}
    unexpected = [n for n in tensors if n not in expected and n.startswith(("actor.", "features"))]
    if unexpected:
        tensor_name = min(unexpected)
        raise _refusal(file, f"its network has {tensor_name}, which is not a layer of a perceptron")
    for name in (f"{name}.{part}" for name in names for part in ("weight", "bias")):
        if not _is_plain(tensors[name]):
            raise _refusal(file, f"{name} is not of finite numbers stored one by one")
    layers = [tensors[f"{name}.weight"] for name in names]
    for (name, first), (next_name, second) in pairwise(zip(names, layers, strict=True)):
        if first.shape[0] != second.shape[1]:
            sizes = f"{name} has {first.shape[0]} outputs, {next_name} {second.shape[1]} inputs"
            raise _refusal(file, sizes)
    observed, acted = layers[0].shape[1], layers[-1].shape[0]
    if (observed, acted) != (observations, space.shape[0]):
        raise InputError(
            f"{file}: the agent maps observations of size {observed} to actions of size {acted}; "
            f"the environment's are {observations} and {space.shape[0]}"
        )
    kwargs = settings.get("policy_kwargs")
    kwargs = kwargs if isinstance(kwargs, dict) else {}
    activation = kind.activation
    if "activation_fn" in kwargs:  # of which JSON keeps the class's name
        title = str(kwargs["activation_fn"]).removesuffix("'>").rpartition(".")[2]
        if title not in _ACTIVATIONS:
            raise _refusal(file, f"its activation is {kwargs['activation_fn']!r}")
        activation = _ACTIVATIONS[title]
    parts: list[nn.Module] = []
    for name, weight in zip(names, layers, strict=True):
        layer = nn.Linear(weight.shape[1], weight.shape[0])
        layer.load_state_dict({part: tensors[f"{name}.{part}"] for part in ("weight", "bias")})
        parts += [layer, activation()]
    parts.pop()
    if names[-1] == "actor.mu.0" and kind.last:
        bound = kwargs.get("clip_mean", _CLIPPED_MEAN)
        if not isinstance(bound, int | float) or not bound > 0:
            raise _refusal(file, f"its clip_mean is {bound!r}, not a number above 0")
        parts.append(nn.Hardtanh(-float(bound), float(bound)))
    squashed = kind.squashed or kwargs.get("squash_output") is True
    parts += [nn.Tanh()] if squashed else []
    return Agent(nn.Sequential(*parts), squashed, space, noise, seed)


def _contents(file: Path) -> tuple[dict[str, Tensor], Mapping[str, Any]]:
    """Tensors and settings of a saved agent, none of them unpickled."""
    if not file.is_file():
        raise InputError(f"{file} does not exist; name an agent that Stable-Baselines3 saved")
    try:
        with zipfile.ZipFile(file) as archive:
            for name in _MOST_BYTES:
                _require_unpackable(name, archive.getinfo(name).file_size)
            parts = {name: archive.read(name) for name in _MOST_BYTES}
        network = io.BytesIO(parts["policy.pth"])
        if zipfile.is_zipfile(network):
            with zipfile.ZipFile(network) as archive:
                _require_unpackable("policy.pth", sum(i.file_size for i in archive.infolist()))
        network.seek(0)
        tensors = torch.load(network, "cpu", weights_only=True)
        settings = json.loads(parts["data"])
        if not (
            isinstance(settings, dict)
            and isinstance(tensors, dict)
            and all(isinstance(k, str) and isinstance(v, Tensor) for k, v in tensors.items())
        ):
            raise ValueError("its parts are not those of an agent")
    except Exception as error:  # zipfile, json and PyTorch's unpickler raise many types
        raise _refusal(file, f"it cannot be read as data ({first_line(error)})") from None
    return tensors, settings


def _require_unpackable(name: str, size: int) -> None:
    if size > _MOST_BYTES[name]:
        raise ValueError(f"{name} has {size:,} bytes, more than {_MOST_BYTES[name]:,}")


def _kind_of(file: Path, tensors: Mapping[str, Tensor]) -> tuple[_Kind, list[str]]:
    """The family of a network, and the names of its layers from first to last."""
    layers = [match for name in tensors if (match := _LAYER.fullmatch(name))]
    for kind in _KINDS:
        numbers = sorted({int(m[2]) for m in layers if m[1] == kind.hidden and m[3] == "weight"})
        last = [name for name in kind.last if f"{name}.weight" in tensors]
        names = [*(f"{kind.hidden}.{number}" for number in numbers), *last[:1]]
        if not numbers or (kind.last and not last):
            continue
        weights = [tensors[f"{name}.weight"] for name in names]
        biases = [tensors.get(f"{name}.bias") for name in names]
        if all(
            weight.ndim == 2 and bias is not None and bias.shape == weight.shape[:1]
            for weight, bias in zip(weights, biases, strict=True)
        ):
            return kind, names
    raise _refusal(file, "its tensors are not those of a perceptron with vector actions")


def _is_plain(tensor: Tensor) -> bool:
    """Whether it is of finite numbers that are all in the file: a few bytes can claim any shape."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu":
        return False
    if not (tensor.is_floating_point() and tensor.is_contiguous() and tensor.numel()):
        return False
    return bool(tensor.isfinite().all())


def _refusal(file: Path, reason: str) -> InputError:
    return InputError(
        f"{file}: {reason}; agents of SAC, TQC, TD3, DDPG, PPO, A2C and TRPO with perceptrons can "
        "be used, whose files keep the network as plain tensors"
    )
