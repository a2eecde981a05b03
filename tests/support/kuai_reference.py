"""A plain reading of the Kuaishou environments' rules, one user at a time."""

from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np

from ucfrec_simulators.kuai.environment import ExitRule, Rewards


class Plain:
    """One session as the published code simulates it, its slices included."""

    def __init__(self, tags: list[tuple[int, ...]], rule: ExitRule) -> None:
        self.tags, self.rule, self.shown = tags, rule, list[int]()

    def step(self, item: int) -> tuple[bool, bool]:
        """Whether the user leaves by the rule, and whether the session is over."""
        t, rule = len(self.shown), self.rule
        first = t - rule.window if rule.sliced else max(0, t - rule.window)
        pooled = Counter(tag for shown in self.shown[first:t] for tag in self._of(shown))
        self.shown.append(item)
        bored = t > 0 and any(pooled[tag] > rule.threshold for tag in self._of(item))
        return bored, bored or t >= rule.max_turn - 1

    def _of(self, item: int) -> tuple[int, ...]:
        return self.tags[item] or (-1,)


class OneUser(gym.Env[np.ndarray, int]):
    """One user's environment in plain Python."""

    def __init__(self, rewards: Rewards, tags: list[tuple[int, ...]], rule: ExitRule) -> None:
        self.rewards, self.tags, self.rule = rewards, tags, rule
        high = np.array([rewards.shape[0], len(tags)], dtype=np.float32)
        self.observation_space = gym.spaces.Box(np.zeros(2, dtype=np.float32), high)
        self.action_space = gym.spaces.Discrete(len(tags))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.user = int(self.np_random.integers(self.rewards.shape[0]))
        self.session = Plain(self.tags, self.rule)
        return np.array([self.user, len(self.tags)], dtype=np.float32), {"user_id": self.user}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        bored, over = self.session.step(int(action))
        reward = float(self.rewards[np.array([self.user]), np.array([action])][0])
        observation = np.array([self.user, action], dtype=np.float32)
        return observation, reward, bored, over and not bored, {"user_id": self.user}
