"""Built-in behavior policies that worlds share; each is an `ucfrec.acting.rollout.Actor`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from scipy.special import ndtr, ndtri

from ucfrec.acting.rollout import FORBIDDEN, Actor, BoolArray, FloatArray, IntArray

Actions = npt.NDArray[Any]


class Memoryless:
    """An actor that looks at nothing but the present observation."""

    def begin(self, rows: IntArray) -> None:
        """Nothing is carried from step to step."""

    def observe(self, actions: Actions, rewards: FloatArray) -> None:
        """Nothing is carried from step to step."""


class Uniform(Memoryless):
    """Uniformly random actions, of a box or of a catalogue (with their propensity)."""

    def __init__(self, env: VectorEnv[Any, Any, Any], seed: int) -> None:
        self._space = env.single_action_space
        self._generator = np.random.default_rng([seed, 1])
        self._forbidden: IntArray | None = None

    def inform(self, info: Mapping[str, Any]) -> None:
        """Take note of the items that may not be played."""
        self._forbidden = info.get(FORBIDDEN)

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, FloatArray | None]:
        """Draw (N, A) or (N,) actions."""
        count = len(observations)
        if isinstance(self._space, spaces.Discrete):
            n_items = int(self._space.n)
            if self._forbidden is not None:
                return self._allowed_items(self._forbidden, n_items)
            chosen = self._generator.integers(n_items, size=count)
            return chosen, np.full(count, 1.0 / n_items, dtype=np.float32)
        assert isinstance(self._space, spaces.Box)
        low, high = self._space.low, self._space.high
        drawn = self._generator.uniform(low, high, size=(count, *low.shape))
        return drawn.astype(np.float32), None

    def _allowed_items(self, forbidden: IntArray, n_items: int) -> tuple[IntArray, FloatArray]:
        """Draw a place among the items left, and step over each forbidden item up to it."""
        left = n_items - (forbidden >= 0).sum(axis=1)
        chosen = self._generator.integers(left)
        for item in np.sort(np.where(forbidden < 0, n_items, forbidden), axis=1).T:
            chosen += chosen >= item
        return chosen, (1.0 / left).astype(np.float32)


class Constant(Memoryless):
    """The same action vector always."""

    def __init__(self, action: FloatArray) -> None:
        self._action = action

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, None]:
        """Repeat the action, (N, A)."""
        return np.tile(self._action, (len(observations), 1)), None


def truncated_normal(
    mean: FloatArray, scale: float, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw from the normal about `mean` that is cut to the box [−1, 1]^A, not clipped to it.

    Clipping would put probability on the box's faces, where no density exists; the cut normal has
    a density everywhere in the box, and it is returned exactly, for the float32 actions returned.

    Args:
        mean: (N, A) inside the box.

    Returns:
        Actions (N, A), and their densities (N,): products over the dimensions, which may exceed 1.
    """
    center = mean.astype(np.float64)
    below, above = ndtr((-1 - center) / scale), ndtr((1 - center) / scale)
    quantile = below + generator.random(center.shape) * (above - below)
    actions = np.clip(center + scale * ndtri(quantile), -1, 1).astype(np.float32)
    deviation = (actions - center) / scale
    logarithm = -(deviation**2) / 2 - np.log(np.sqrt(2 * np.pi) * scale * (above - below))
    return actions, np.exp(logarithm.sum(axis=1)).astype(np.float32)


class Rule(Memoryless):
    """A deterministic map from observations (N, O) to action vectors (N, A)."""

    def __init__(self, rule: Callable[[FloatArray], FloatArray]) -> None:
        self._rule = rule

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, None]:
        """Apply the rule, (N, A)."""
        return self._rule(observations), None


class Blend(Memoryless):
    """A policy of stated quality: `clip(q · target + (1 − q) · default + noise · ξ, −1, 1)`.

    Quality 0 is an untuned default, 1 the target; ξ is standard normal, drawn anew every step.
    """

    def __init__(
        self, target: Actor, default: FloatArray, quality: float, noise: float, seed: int
    ) -> None:
        self._target, self._default = target, default
        self._quality, self._noise = quality, noise
        # The quality is part of the stream so that components of one mixture draw apart.
        self._generator = np.random.default_rng([seed, 2, round(1000 * quality)])

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, None]:
        """Blend and explore, (N, A)."""
        target, _ = self._target.act(observations, live)
        explored = self._noise * self._generator.standard_normal(target.shape)
        blended = self._quality * target + (1 - self._quality) * self._default + explored
        return np.clip(blended, -1, 1).astype(np.float32), None


class SessionMixture:
    """Each session is served by one of several actors, drawn when it begins.

    The propensity reported is that of the actor drawn: a valid importance-sampling denominator,
    as the draw depends on nothing in the session.
    """

    def __init__(self, actors: Sequence[Actor], weights: Sequence[float], seed: int) -> None:
        self._actors = list(actors)
        self._weights = np.asarray(weights, dtype=np.float64) / np.sum(weights)
        self._generator = np.random.default_rng([seed, 3])
        self.component: IntArray = np.zeros(0, dtype=np.int64)
        """(N,) which actor serves each session now."""

    def begin(self, rows: IntArray) -> None:
        """Draw the actor of each session that starts."""
        if len(rows) and rows.max() >= len(self.component):
            grown = np.zeros(rows.max() + 1, dtype=np.int64)
            grown[: len(self.component)] = self.component
            self.component = grown
        self.component[rows] = self._generator.choice(
            len(self._actors), size=len(rows), p=self._weights
        )
        for actor in self._actors:
            actor.begin(rows)

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, FloatArray | None]:
        """Let every actor choose and keep the choice of the one in charge."""
        choices = [actor.act(observations, live) for actor in self._actors]
        rows = np.arange(len(observations))
        actions = np.stack([chosen for chosen, _ in choices])[self.component, rows]
        known = [propensity for _, propensity in choices if propensity is not None]
        if len(known) < len(choices):
            return actions, None
        return actions, np.stack(known)[self.component, rows]

    def observe(self, actions: Actions, rewards: FloatArray) -> None:
        """Every actor sees what was played."""
        for actor in self._actors:
            actor.observe(actions, rewards)
