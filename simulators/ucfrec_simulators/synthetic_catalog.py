"""A synthetic catalogue of tagged items with an exit rule and an exactly known optimal policy."""

from typing import Final

import numpy as np
import pyarrow as pa
from gymnasium import spaces

from ucfrec.acting.rollout import Actor, Memoryless, Uniform
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators.behaviors import SessionMixture
from ucfrec_simulators.session_env import AnyEnv, SessionsEnv, draw_categories

CLUSTERS: Final = 8
FACTORS: Final = 4
NO_TAG: Final = -1


class SyntheticCatalog(SessionsEnv):
    """One item per step, clicked or not; repeating a tag too soon ends the session.

    Every item has one tag. User u clicks item i with a fixed probability p(u, i): a logistic
    function of u's taste for i's tag (a cluster's taste plus an individual one), of the product of
    latent factors, and of i's quality. Reward: 1 for a click, else 0. The session terminates in
    the step whose item has a tag that already occurred among the `boredom_window` − 1 items
    before (the exit rule of the Kuaishou simulators with threshold 0 and no last-step exception);
    that step's reward counts. It is truncated after `max_turn` steps. Items may repeat.

    Observation (n_tags + 4,): the user's tastes and factors plus noise that is fixed for the user.
    `info["user_id"]` (N,): the user of the next step, 0 to n_users − 1.

    Args:
        num_envs: number of parallel sessions, N.
        n_items, n_tags, n_users: sizes of the environment.
        boredom_window: items among which a tag may occur only once.
        max_turn: largest number of steps of a session.
        environment_seed: seed of users and items; independent of the seed of `reset`.

    Raises:
        InputError: fewer tags than `boredom_window`, or fewer items than tags.
    """

    def __init__(
        self,
        num_envs: int = 1,
        n_items: int = 200,
        n_tags: int = 12,
        n_users: int = 2000,
        boredom_window: int = 4,
        max_turn: int = 20,
        environment_seed: int = 0,
    ) -> None:
        if not boredom_window <= n_tags <= n_items:
            raise InputError(
                f"boredom_window ≤ n_tags ≤ n_items must hold, got {boredom_window}, {n_tags}, "
                f"{n_items}"
            )
        environment = np.random.default_rng([environment_seed, 31])
        self.tags: IntArray = environment.permutation(np.arange(n_items) % n_tags)
        """(n_items,) tag of each item."""
        centres = environment.normal(0, 1, (CLUSTERS, n_tags))
        individual = environment.normal(0, 0.6, (n_users, n_tags))
        tastes = centres[environment.integers(CLUSTERS, size=n_users)] + individual
        factors = environment.normal(0, 1, (n_users, FACTORS))
        match = factors @ environment.normal(0, 1, (FACTORS, n_items)) / np.sqrt(FACTORS)
        quality = environment.normal(0, 0.5, n_items)
        self.logits = -2.5 + tastes[:, self.tags] + 0.7 * match + quality
        """(n_users, n_items) log-odds of a click."""
        self.click_probabilities: Float64Array = 1 / (1 + np.exp(-self.logits))
        """(n_users, n_items) probabilities of a click."""
        features = np.concatenate([tastes, factors], axis=1)
        self._features = (features + environment.normal(0, 0.5, features.shape)).astype(np.float32)
        self.boredom_window, self.max_turn = boredom_window, max_turn
        self.users: IntArray = np.zeros(num_envs, dtype=np.int64)
        """(N,) user of each session."""
        self.turns: IntArray = np.zeros(num_envs, dtype=np.int64)
        """(N,) number of items shown so far."""
        self.recent_tags: IntArray = np.full((num_envs, boredom_window - 1), NO_TAG)
        """(N, boredom_window − 1) tags of the last items, the latest last; padded with −1."""
        super().__init__(
            num_envs,
            spaces.Box(-np.inf, np.inf, (features.shape[1],), dtype=np.float32),
            spaces.Discrete(n_items),
        )

    def item_features(self) -> pa.Table:
        """One row per item: `item_id` and its tag one-hot as `tag_0`, `tag_1`, …."""
        hot = np.eye(self.tags.max() + 1, dtype=np.float32)[self.tags]
        columns = {f"tag_{tag}": pa.array(column) for tag, column in enumerate(hot.T)}
        return pa.table({"item_id": pa.array(np.arange(len(self.tags))), **columns})

    def favourites(self, probabilities: Float64Array) -> IntArray:
        """The best items (M, boredom_window) of different tags, the best first, by click
        probabilities (M, n_items)."""
        of_tags = (np.flatnonzero(self.tags == tag) for tag in range(self.tags.max() + 1))
        best = [items[probabilities[:, items].argmax(1)] for items in of_tags]
        by_tag = np.stack(best, axis=1)
        order = np.argsort(-np.take_along_axis(probabilities, by_tag, 1), axis=1, kind="stable")
        return np.take_along_axis(by_tag, order[:, : self.boredom_window], axis=1)

    def _begin(self, rows: IntArray) -> None:
        self.users[rows] = self.np_random.integers(len(self.logits), size=len(rows))
        self.turns[rows] = 0
        self.recent_tags[rows] = NO_TAG

    def _play(self, actions: Array) -> tuple[Float32Array, BoolArray, BoolArray]:
        tags = self.tags[actions]
        chances = self.click_probabilities[self.users, actions]
        clicks = self.np_random.random(self.num_envs) < chances
        bored = (self.recent_tags == tags[:, None]).any(axis=1)
        self.recent_tags = np.column_stack([self.recent_tags, tags])[:, 1:]
        self.turns += 1
        return clicks.astype(np.float32), bored, (self.turns >= self.max_turn) & ~bored

    def _observe(self) -> Float32Array:
        return self._features[self.users]

    def _describe(self) -> dict[str, Array]:
        return {"user_id": self.users.copy()}


class Rotation(Memoryless):
    """Show each user's favourites in turn, and the best again in the last step.

    With the true probabilities it is optimal. Proof:

    Let m₁ ≥ m₂ ≥ … be the user's best probability in each tag, N the satiation window, T =
    `max_turn`, and S(t) the sum of the first t terms of m₁, …, m_N, m₁, …. Clicks do not affect
    later steps, so fixed sequences of items suffice. If a sequence ends with step t ≤ T, its
    first t − 1 steps did not end the session, so any N successive ones of them have different
    tags. Cut into blocks of N from the start, they return at most S(t − 1) in expectation, and
    the last step at most m₁. As S grows with t, no sequence returns more than S(T − 1) + m₁. The
    favourites in turn for T − 1 steps never repeat a tag too soon and return S(T − 1); the last
    step may end the session and returns m₁.
    """

    def __init__(self, environment: SyntheticCatalog, favourites: IntArray) -> None:
        self._environment, self._favourites = environment, favourites

    def act(
        self, observations: Float32Array, live: BoolArray
    ) -> tuple[IntArray, Float32Array | None]:
        """The next favourite (N,) of each session's user; propensities (N,) are 1."""
        environment = self._environment
        last = environment.turns == environment.max_turn - 1
        rank = np.where(last, 0, environment.turns % environment.boredom_window)
        chosen = self._favourites[environment.users, rank]
        return chosen, np.ones(len(chosen), dtype=np.float32)


class SoftmaxGuess(Memoryless):
    """Softmax policy over erroneous log-odds with uniform exploration; its propensities are exact.

    Args:
        error: standard deviation of the fixed error of each (user, item) log-odds.
        temperature: temperature of the softmax.
        epsilon: probability of a uniformly drawn item.
        variety: penalty, in log-odds, of items whose tag was shown recently.
    """

    def __init__(
        self,
        environment: SyntheticCatalog,
        seed: int,
        error: float,
        temperature: float,
        epsilon: float,
        variety: float,
    ) -> None:
        self._environment = environment
        self._temperature, self._epsilon, self._variety = temperature, epsilon, variety
        self._generator = np.random.default_rng([seed, 4, round(1000 * error)])
        # The error does not depend on the seed, so the seed does not change the policy's quality.
        errors = np.random.default_rng([0, 5, round(1000 * error)])
        self._guess = environment.logits + error * errors.standard_normal(environment.logits.shape)

    def probabilities(self) -> Float64Array:
        """(N, n_items) probability of each item in the next step."""
        environment = self._environment
        repeated = (environment.recent_tags[:, :, None] == environment.tags).any(axis=1)
        scores = self._guess[environment.users] - self._variety * repeated
        scores = scores / self._temperature
        weights = np.exp(scores - scores.max(axis=1, keepdims=True))
        greedy = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray((1 - self._epsilon) * greedy + self._epsilon / scores.shape[1])

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, Float32Array]:
        """Draw items (N,); returns them and their propensities (N,)."""
        probabilities = self.probabilities()
        chosen = draw_categories(probabilities, self._generator.random(len(probabilities)))
        return chosen, probabilities[np.arange(len(chosen)), chosen].astype(np.float32)


def _catalog(env: AnyEnv) -> SyntheticCatalog:
    """The catalogue within `env`, whose policies refuse any other environment."""
    if not isinstance(env.unwrapped, SyntheticCatalog):
        raise InputError(f"this behavior policy serves SyntheticCatalog, not {type(env).__name__}")
    return env.unwrapped


def optimal(env: AnyEnv, seed: int) -> Rotation:
    """The optimal policy: `Rotation` with the true probabilities; `seed` is unused."""
    environment = _catalog(env)
    return Rotation(environment, environment.favourites(environment.click_probabilities))


def popular(env: AnyEnv, seed: int) -> Rotation:
    """`Rotation` by mean probabilities over users: a non-personalised policy; `seed` is unused."""
    environment = _catalog(env)
    favourites = environment.favourites(environment.click_probabilities.mean(axis=0, keepdims=True))
    return Rotation(environment, np.tile(favourites, (len(environment.logits), 1)))


QUALITIES: Final = (
    (2.0, 1.0, 0.3, 0.0, 0.30),
    (1.5, 0.7, 0.2, 2.0, 0.30),
    (1.0, 0.5, 0.1, 4.0, 0.20),
)
"""Error, temperature, epsilon, variety and share of sessions of each policy of the mixture."""


def mixture(env: AnyEnv, seed: int) -> SessionMixture:
    """A logging policy of medium mean quality and high variance between sessions.

    A fifth of the sessions get uniform items, the others one of the policies of `QUALITIES`.
    """
    actors, shares = list[Actor]([Uniform(env, seed)]), [0.2]
    for error, temperature, epsilon, variety, share in QUALITIES:
        actors.append(SoftmaxGuess(_catalog(env), seed, error, temperature, epsilon, variety))
        shares.append(share)
    return SessionMixture(actors, shares, seed)


def softmax(env: AnyEnv, seed: int) -> SoftmaxGuess:
    """A logging policy that tries much: other policies can be evaluated on its logs."""
    knobs = {"error": 0.5, "temperature": 5.0, "epsilon": 0.1, "variety": 0.0}
    return SoftmaxGuess(_catalog(env), seed, **knobs)


SIMULATOR: Final = Simulator(
    summary="built-in users and 200 tagged items with a known best policy: one item a step, clicks",
    make=lambda num_envs, folder: SyntheticCatalog(num_envs),
    behaviors={
        **{"random": Uniform, "popular": popular, "mixture": mixture},
        **{"softmax": softmax, "optimal": optimal},
    },
    feedback="is_click",
)
