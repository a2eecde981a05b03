"""Built-in behavior policies shared by the worlds; each is an `ucfrec.acting.rollout.Actor`."""

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
    """An actor whose choice depends on the current observation only."""

    def begin(self, rows: IntArray) -> None:
        """Do nothing: there is no state to reset."""

    def observe(self, actions: Actions, rewards: FloatArray) -> None:
        """Do nothing: there is no state to update."""


class Uniform(Memoryless):
    """Uniformly random actions: vectors in a box, or items of a catalogue with their propensity."""

    def __init__(self, env: VectorEnv[Any, Any, Any], seed: int) -> None:
        self._space = env.single_action_space
        self._generator = np.random.default_rng([seed, 1])
        self._forbidden: IntArray | None = None

    def inform(self, info: Mapping[str, Any]) -> None:
        """Read the (N, L) forbidden items of each session from `info`, if the world masks items."""
        self._forbidden = info.get(FORBIDDEN)

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, FloatArray | None]:
        """Draw actions: (N, A) without propensities, or items (N,) with propensities (N,)."""
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
        """Draw uniformly among the allowed items; `forbidden` (N, L) is padded with −1.

        A rank among the allowed items is drawn, then raised by one per forbidden item up to it.
        """
        n_allowed = n_items - (forbidden >= 0).sum(axis=1)
        chosen = self._generator.integers(n_allowed)
        for item in np.sort(np.where(forbidden < 0, n_items, forbidden), axis=1).T:
            chosen += chosen >= item
        return chosen, (1.0 / n_allowed).astype(np.float32)


class Constant(Memoryless):
    """The same action vector (A,) at every step."""

    def __init__(self, action: FloatArray) -> None:
        self._action = action

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, None]:
        """Repeat the action, (N, A)."""
        return np.tile(self._action, (len(observations), 1)), None


def truncated_normal(
    mean: FloatArray, scale: float, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw from a normal around `mean` that is truncated to the box [−1, 1]^A, not clipped to it.

    Clipping would put probability mass on the faces of the box, where no density exists. The
    truncated normal has a density everywhere in the box. The densities returned are exact for the
    float32 actions returned.

    Args:
        mean: (N, A) inside the box.
        scale: standard deviation of the normal before truncation.
        generator: source of the draws.

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

    `target` is the action of another actor and `default` a fixed vector (A,). Quality q is 0 for
    the default and 1 for the target; ξ is standard normal, drawn at every step.
    """

    def __init__(
        self, target: Actor, default: FloatArray, quality: float, noise: float, seed: int
    ) -> None:
        self._target, self._default = target, default
        self._quality, self._noise = quality, noise
        # The quality is part of the seed so that components of one mixture draw independently.
        self._generator = np.random.default_rng([seed, 2, round(1000 * quality)])

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[Actions, None]:
        """Blended actions with exploration noise, (N, A)."""
        target, _ = self._target.act(observations, live)
        explored = self._noise * self._generator.standard_normal(target.shape)
        blended = self._quality * target + (1 - self._quality) * self._default + explored
        return np.clip(blended, -1, 1).astype(np.float32), None


class SessionMixture:
    """Each session is served by one of several actors, drawn when it begins.

    The reported propensity is that of the drawn actor: a valid denominator for importance sampling,
    because the draw does not depend on what happens in the session.
    """

    def __init__(self, actors: Sequence[Actor], weights: Sequence[float], seed: int) -> None:
        self._actors = list(actors)
        self._weights = np.asarray(weights, dtype=np.float64) / np.sum(weights)
        self._generator = np.random.default_rng([seed, 3])
        self.component: IntArray = np.zeros(0, dtype=np.int64)
        """(N,) index of the actor that serves each session."""

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
        """Actions (N, A) or (N,) of the sessions' actors; propensities (N,) if all report them."""
        choices = [actor.act(observations, live) for actor in self._actors]
        rows = np.arange(len(observations))
        actions = np.stack([chosen for chosen, _ in choices])[self.component, rows]
        known = [propensity for _, propensity in choices if propensity is not None]
        if len(known) < len(choices):
            return actions, None
        return actions, np.stack(known)[self.component, rows]

    def observe(self, actions: Actions, rewards: FloatArray) -> None:
        """Pass the played actions and rewards (N,) to every actor."""
        for actor in self._actors:
            actor.observe(actions, rewards)
