"""VirtualTB-v0 (Shi et al., AAAI 2019) with its three published networks, for parallel sessions."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import nn

from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators.behaviors import SessionMixture
from ucfrec_simulators.session_env import AnyEnv, data_folder, draw_categories
from ucfrec_simulators.taobao import ddpg
from ucfrec_simulators.taobao.environment import (
    ACTION_DIM,
    ATTRIBUTES,
    LONGEST_SESSION,
    MAX_CLICKS,
    PAGE_INDICES,
    USER_BITS,
    TaobaoEnv,
    best_constant_actor,
    mix_blends,
)

SOURCE: Final = "https://github.com/eyounx/VirtualTaobao (virtualTB/data)"
NOISE_DIM: Final = 128
CLICK_LEVELS: Final = MAX_CLICKS + 1


class VirtualTaobao(TaobaoEnv):
    """The published simulator's dynamics, with one forward pass for N sessions.

    As in the original, a user is drawn by the generator network from uniform noise, with each
    attribute sampled from its softmax. The session's length, at least one page, is sampled from the
    leave network. Clicks and page index are sampled from the two softmaxes of the action network,
    whose inputs are user, pages turned before, and action. Actions are not clipped. One difference:
    the last observation of a session (`info["final_obs"]`) has its user and last clicks, where the
    original has the next user.

    To start M sessions, uniforms of shape (M, 128) for the noise, (M, 11) for the attributes and
    (M,) for the lengths are drawn from `np_random`, in this order; each step draws (N, 2) uniforms
    for clicks and page index.

    Args:
        folder: has `generator_model.pt`, `leave_model.pt` and `action_model.pt`.
        num_envs: number of parallel sessions, N.

    Raises:
        InputError: a network is missing or is not the published one.
    """

    def __init__(self, folder: Path | str, num_envs: int = 1) -> None:
        super().__init__(num_envs)
        folder = Path(folder)
        self._generator_model = _load(folder / "generator_model.pt", (NOISE_DIM, 128, USER_BITS))
        sizes = (USER_BITS, 128, 256, LONGEST_SESSION + 1)
        self._leave_model = _load(folder / "leave_model.pt", sizes)
        sizes = (USER_BITS + 1 + ACTION_DIM, 128, 256, CLICK_LEVELS + PAGE_INDICES)
        self._action_model = _load(folder / "action_model.pt", sizes)

    def sample_users(
        self, count: int, generator: np.random.Generator
    ) -> tuple[Float32Array, IntArray]:
        """Draw M = `count` users: one-hot bits (M, 88), and pages they turn (M,), at least 1."""
        noise = torch.from_numpy(generator.random((count, NOISE_DIM), dtype=np.float32))
        uniforms = generator.random((count, len(ATTRIBUTES)))
        with torch.inference_mode():
            groups = self._generator_model(noise).split(ATTRIBUTES, dim=1)
            users = np.concatenate(
                [
                    np.eye(size, dtype=np.float32)[draw_categories(_weights(logits), uniform)]
                    for size, logits, uniform in zip(ATTRIBUTES, groups, uniforms.T, strict=True)
                ],
                axis=1,
            )
            lengths = _weights(self._leave_model(torch.from_numpy(users)))
        # The original checks for the end after a page, so a drawn length of 0 gives one page.
        return users, np.maximum(draw_categories(lengths, generator.random(count)), 1)

    def expected_clicks(
        self, users: Float32Array, pages: Array, actions: Float32Array
    ) -> Float64Array:
        """Exact expected clicks (M,): users (M, 88), pages turned (M,), actions (M, 27)."""
        with torch.inference_mode():
            clicks = self._logits(users, pages, actions)[:, :CLICK_LEVELS].softmax(1).numpy()
        return np.asarray(clicks.astype(np.float64) @ np.arange(CLICK_LEVELS, dtype=np.float64))

    def _respond(
        self, users: Float32Array, pages: IntArray, actions: Float32Array
    ) -> tuple[IntArray, IntArray]:
        with torch.inference_mode():
            logits = self._logits(users, pages, actions)
            clicks, indices = map(_weights, torch.split(logits, [CLICK_LEVELS, PAGE_INDICES], 1))
        uniforms = self.np_random.random((len(users), 2))
        return draw_categories(clicks, uniforms[:, 0]), draw_categories(indices, uniforms[:, 1])

    def _logits(self, users: Float32Array, pages: Array, actions: Float32Array) -> torch.Tensor:
        """Logits (M, 21) of clicks and page indices."""
        page = np.asarray(pages, dtype=np.float32)[:, None]
        inputs = np.concatenate([users, page, actions], axis=1, dtype=np.float32)
        return self._action_model(torch.from_numpy(inputs))  # type: ignore[no-any-return]


def _weights(logits: torch.Tensor) -> Float32Array:
    """Numbers (M, K) proportional to the probabilities; a softmax of few columns takes six times
    as long, and drawing needs no normalisation."""
    return np.asarray((logits - logits.amax(1, keepdim=True)).exp().numpy())


def _load(path: Path, sizes: Sequence[int]) -> nn.Sequential:
    """Load a published state dict into Linear layers of `sizes` with LeakyReLU between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.LeakyReLU(inplace=True)]
    network = nn.Sequential(*layers[:-1])
    remedy = f"put the file from {SOURCE} there, or name the folder that has it"
    if not path.is_file():
        raise InputError(f"{path} is missing; {remedy}")
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:
        # torch documents no closed set of errors for a file that is not a state dict.
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is not the published network ({reason}); {remedy}") from None
    return network.eval().requires_grad_(False)


QUALITIES: Final = ((0.1, 0.3, 0.30), (0.4, 0.3, 0.20), (0.7, 0.4, 0.15), (0.9, 0.4, 0.10))
"""Blends of the mixture: quality, noise, share of sessions."""


def mixture(env: AnyEnv, seed: int) -> SessionMixture:
    """A logging policy of medium mean quality and high variance between sessions.

    A quarter of the sessions get uniform actions, the others a blend of an untuned constant and the
    best constant (`QUALITIES`).
    """
    # The search has a fixed seed, so that `seed` does not change the policy's quality.
    return mix_blends(env, seed, best_constant_actor(env, 0), 0.25, QUALITIES)


SIMULATOR: Final = Simulator(
    summary="VirtualTB-v0 from its published networks: 27 ranking weights per page, 0-10 clicks",
    make=lambda num_envs, folder: VirtualTaobao(folder or data_folder("virtualtaobao"), num_envs),
    behaviors={**ddpg.COMMON, "mixture": mixture},
    feedback="clicks",
)
