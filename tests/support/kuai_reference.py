"""A plain reading of the Kuaishou environments' rules, one user at a time."""

from collections import Counter

from ucfrec_simulators.kuai.environment import ExitRule


class Plain:
    """One session by the published rule."""

    def __init__(self, tags: list[tuple[int, ...]], rule: ExitRule) -> None:
        self.tags, self.rule, self.shown = tags, rule, list[int]()

    def step(self, item: int) -> tuple[bool, bool]:
        """Whether the user leaves by the rule, and whether the session is over."""
        t, rule = len(self.shown), self.rule
        first = max(0, t - rule.window)
        pooled = Counter(tag for shown in self.shown[first:t] for tag in self._of(shown))
        self.shown.append(item)
        bored = t > 0 and any(pooled[tag] > rule.threshold for tag in self._of(item))
        return bored, bored or t >= rule.max_turn - 1

    def _of(self, item: int) -> tuple[int, ...]:
        return self.tags[item] or (-1,)
