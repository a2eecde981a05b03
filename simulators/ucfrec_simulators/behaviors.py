"""Built-in behavior policies shared by the environments; each is an
`ucfrec.acting.rollout.Actor`."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from ucfrec.acting.rollout import Actor, Memoryless
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray


def truncated_normal(
    mean: Float32Array, scale: float, generator: np.random.Generator
) -> tuple[Float32Array, Float32Array]:
    """Draw from a normal around `mean` that is truncated to the box [−1, 1]^A, not clipped to it.

    Clipping would put probability mass on the faces of the box, where no density exists. The
    truncated normal has a density everywhere in the box. The densities returned are exact for the
    float32 actions returned.

    Args:
        mean: (N, A) inside the box.
        scale: standard deviation of the normal before truncation.

    Returns:
        Array (N, A), and their densities (N,): products over the dimensions, which may exceed 1.
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

    def __init__(self, rule: Callable[[Float32Array], Float32Array]) -> None:
        self._rule = rule

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, None]:
        """Apply the rule, (N, A)."""
        return self._rule(observations), None


def repeat_action(action: Float32Array) -> Rule:
    """The same action vector (A,) at every step."""
    return Rule(lambda observations: np.tile(action, (len(observations), 1)))


class Blend(Memoryless):
    """A policy of stated quality: `clip(q · target + (1 − q) · default + noise · ξ, −1, 1)`.

    `target` is the action of another actor and `default` a fixed vector (A,). Quality q is 0 for
    the default and 1 for the target; ξ is standard normal, drawn at every step.
    """

    def __init__(
        self, target: Actor, default: Float32Array, quality: float, noise: float, seed: int
    ) -> None:
        self._target, self._default = target, default
        self._quality, self._noise = quality, noise
        # The quality is part of the seed so that components of one mixture draw independently.
        self._generator = np.random.default_rng([seed, 2, round(1000 * quality)])

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, None]:
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

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Array (N, A) or (N,) of the sessions' actors; propensities (N,) if all report them."""
        choices = [actor.act(observations, live) for actor in self._actors]
        rows = np.arange(len(observations))
        actions = np.stack([chosen for chosen, _ in choices])[self.component, rows]
        propensities = [propensity for _, propensity in choices if propensity is not None]
        if len(propensities) < len(choices):
            return actions, None
        return actions, np.stack(propensities)[self.component, rows]

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Pass the actions taken and rewards (N,) to every actor."""
        for actor in self._actors:
            actor.observe(actions, rewards)
