"""A trained policy in a control loop: one observation in, one action out."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float32Array
from ucfrec.errors import InputError
from ucfrec_control.training.evaluate import Trained, choose_rule, load_run


class ControlPolicy:
    """A trained policy that acts in one environment, with the history of the episode as memory."""

    def __init__(self, trained: Trained, rule: DecisionRule | None) -> None:
        record = trained.record
        self.rule = rule
        """The target return; None for a policy without one."""
        self.observation_size: int = record.sizes["state"] + len(record.dropped_observations)
        self.action_size: int = record.sizes["action"]
        self._actor = trained.actor(1, rule)
        self.reset()

    @classmethod
    def load(
        cls, run: str | Path, *, target: float | None = None, checkpoint: str = "last"
    ) -> "ControlPolicy":
        """Load the policy of a run of `ucfrec-control train`.

        Args:
            target: target return of an episode; None for that of the preset, else the largest of
                the training trajectories.
            checkpoint: `last`, `best` for the lowest validation loss, or `return` for the highest
                return where the training selected by it.

        Raises:
            InputError: `run` is not such a run, its training has not ended, or its policy takes no
                target return, but one is given.
        """
        trained = load_run(Path(run), checkpoint)
        return cls(trained, choose_rule(trained, target))

    def reset(self) -> None:
        """Begin an episode."""
        self._actor.begin(np.zeros(1, dtype=np.int64))
        self._action: Float32Array | None = None

    def act(self, observation: npt.ArrayLike, reward: float | None = None) -> Float32Array:
        """The action (A,) after an observation (O,), in the units of the training data.

        Args:
            reward: of the action before; None, which counts as 0, at the first step, or where there
                is none to observe.

        Raises:
            InputError: the observation or the reward is not finite, or has another size.
        """
        row = np.asarray(observation, dtype=np.float32)
        received = np.array([0.0 if reward is None else reward], dtype=np.float32)
        if row.shape != (self.observation_size,):
            raise InputError(
                f"the observation has shape {row.shape}; the policy was trained on vectors of "
                f"{self.observation_size}"
            )
        if not (np.isfinite(row).all() and np.isfinite(received).all()):
            raise InputError("the observation or the reward is not finite; give numbers")
        if self._action is not None:
            self._actor.observe(self._action, received)
        actions, _ = self._actor.act(row[None], np.ones(1, dtype=bool))
        self._action = np.array(actions, dtype=np.float32)
        return np.array(self._action[0])
