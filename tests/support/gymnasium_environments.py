"""Small Gymnasium environments, registered under names that start with `ucfrec-test/`."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

LENGTH = 5
ITEMS = 4


class Echo(gymnasium.Env[Any, Any]):
    """Five steps; the reward of item a is a, that of a vector its sum. Observed are a session's
    `secret` number and the category `step`, with `whole` only that; `notes` has no fixed size.
    `users` is the `user_id` of every `info`; `reset` tells `visitors`, of a session each."""

    def __init__(self, actions: Any, whole=False, users=None, notes=False, visitors=()) -> None:
        self.action_space, self._whole, self._users = actions, whole, users
        entries = {"step": spaces.Discrete(LENGTH + 1)}
        entries["secret"] = spaces.Box(0, 1, (2, 1), dtype=np.float64)
        if notes:
            entries["notes"] = spaces.Sequence(spaces.Discrete(3))
        self.observation_space = entries["step"] if whole else spaces.Dict(entries)
        self.vectors = np.arange(2.0 * ITEMS).reshape(ITEMS, 2)
        self.played: list[Any] = []
        self._visitors = iter(visitors)

    def _observation(self) -> Any:
        if self._whole:
            return self._step
        return {"step": self._step, "secret": np.full((2, 1), self._secret), "notes": (1, 2)}

    def _info(self) -> dict[str, Any]:
        info = {"shape that changes": np.zeros(self._step)}
        return info if self._users is None else info | {"user_id": self._users}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._step, self._secret = 0, self.np_random.random()
        user = next(self._visitors, None)
        return self._observation(), self._info() | ({} if user is None else {"user_id": user})

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.played.append(action)
        self._step += 1
        reward = float(np.sum(action))
        return self._observation(), reward, False, self._step == LENGTH, self._info()


ACTIONS: dict[str, spaces.Space[Any]] = {
    "Discrete": spaces.Discrete(ITEMS),
    "Discrete-from-3": spaces.Discrete(ITEMS, start=3),
    "MultiDiscrete": spaces.MultiDiscrete([ITEMS]),
    "Box": spaces.Box(-1, 2, (3,), dtype=np.float64),
    "Slate": spaces.MultiDiscrete([ITEMS, ITEMS]),
    "Matrix": spaces.Box(-1, 1, (2, 2)),
}
_OF_ITEMS: dict[str, dict[str, Any]] = {
    "Whole": {"whole": True},
    "Users": {"users": 77},
    "Visitors": {"visitors": range(1000, 1009)},
    "Some-visitors": {"visitors": (1000, None)},
    "Names": {"users": "Ann"},
    "Notes": {"notes": True},
}
_ARGUMENTS = {name: {"actions": space} for name, space in ACTIONS.items()}
_ARGUMENTS |= {name: {"actions": ACTIONS["Discrete"], **own} for name, own in _OF_ITEMS.items()}
for _name, _arguments in _ARGUMENTS.items():
    gymnasium.register(f"ucfrec-test/{_name}-v0", Echo, kwargs=_arguments)
