"""Which settings a search varies, and over which values."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from optuna import Trial

from ucfrec.errors import InputError
from ucfrec.files.atomic import read_toml
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class
from ucfrec.runs.config import TABLES, Config, resolve_config

POLICY = "policy"
"""Name of the choice among policies; settings have a dot."""
Value = bool | int | float | str


@dataclass(frozen=True)
class Dimension:
    """Values of one setting: some choices, or a range. InputError if it is neither, or its ends are
    in the wrong order."""

    choices: tuple[Value, ...] = ()
    low: float | None = None
    high: float | None = None
    log: bool = False
    """Whether the range is searched in powers."""

    def __post_init__(self) -> None:
        low, high = self.low, self.high
        is_range = low is not None and high is not None and low < high and (low > 0 or not self.log)
        if bool(self.choices) == is_range:
            raise InputError(
                "give a list of choices, or low and high; give the lower one first, above 0 with "
                "log = true"
            )

    def suggest(self, trial: Trial, name: str) -> Value:
        """The value of this setting in a trial."""
        if self.choices:
            return cast(Value, trial.suggest_categorical(name, self.choices))
        low, high = self.low, self.high
        if isinstance(low, int) and isinstance(high, int):
            return trial.suggest_int(name, low, high, log=self.log)
        return trial.suggest_float(name, low or 0.0, high or 0.0, log=self.log)


Space = Mapping[str, Dimension]
"""Setting, as `table.field`, to its values."""
NETWORK: Space = {
    "train.learning_rate": Dimension(low=1e-4, high=3e-3, log=True),
    "train.steps": Dimension(low=500, high=10_000, log=True),
    "policy.dim": Dimension((32, 64, 128, 256)),
    "policy.dropout": Dimension(low=0.0, high=0.3),
    "augment.copies": Dimension((0, 1)),
    "augment.actions": Dimension((0, 2)),
}
"""Of policies that are trained step by step."""
HISTORY: Space = {
    "policy.context": Dimension((5, 10, 20, 50)),
    "policy.exposure": Dimension((True, False)),
}
"""Of those that read what was shown before, too."""
NEIGHBORS: Space = {"policy.neighbors": Dimension(low=10, high=500, log=True)}
REWARD_WEIGHTS: Space = {"rule.reward_weights": Dimension((0.0, 0.5, 1.0, 2.0, 4.0, 8.0))}
OF_REWARDS = {"augment.copies": 0, "augment.actions": 0, "rule.reward_weights": (0.0,)}
"""Settings that act through a model of rewards, and their values where all rewards are equal."""


def read_space(path: Path) -> Space:
    """Read a TOML file with the tables of a configuration, whose fields are lists of choices or
    ranges `{low = …, high = …, log = true}`. InputError if it has another form."""
    space = {}
    for table, fields in read_toml(path).items():
        if table not in TABLES or not isinstance(fields, dict):
            raise InputError(f"{path}: no table is called {table!r}; use {', '.join(TABLES)}")
        for field, values in fields.items():
            is_range, name = isinstance(values, dict), f"{table}.{field}"
            try:
                space[name] = Dimension(**values) if is_range else Dimension(tuple(values))
            except (TypeError, InputError):
                raise InputError(
                    f"{path}: {name}: write a list of choices, or {{low = …, high = …}}, the lower "
                    "one first, and log = true only above 0"
                ) from None
    return space


@dataclass(frozen=True)
class Search:
    """Policies, their spaces, and the settings that all trials have. InputError if a policy is
    unknown, or a value of a space is not allowed."""

    policies: tuple[str, ...]
    fixed: Mapping[str, Any]
    """Setting to value."""
    by_value: bool
    seed: int
    own_space: Space | None = None
    """The space of every policy; None for each policy's default one."""

    def __post_init__(self) -> None:
        for policy in self.policies:
            for name, of in self.space(policy).items():
                self.config(policy, {name: of.choices[0] if of.choices else of.low or 0})

    def space(self, policy: str) -> Space:
        """The settings that vary: those of the space that are not fixed."""
        space, kind = self.own_space, policy_class(policy)
        if space is None:
            # By the estimated value, every training searches the reward weight itself.
            space = {} if self.by_value else REWARD_WEIGHTS
            if kind.make_solver is SequencePolicy.make_solver:
                space = {**NETWORK, **(HISTORY if kind.Config().context > 1 else {}), **space}
            if hasattr(kind.Config(), "neighbors"):
                space = {**NEIGHBORS, **space}
        return {name: values for name, values in space.items() if name not in self.fixed}

    def config(self, policy: str, values: Mapping[str, Value]) -> Config:
        """The configuration with some values; a single value of a list stands for the list."""
        plain = resolve_config(policy)
        settings: dict[str, Any] = dict(self.fixed)
        for name, value in values.items():
            table, _, field = name.partition(".")
            of_list = isinstance(getattr(getattr(plain, table), field, None), tuple)
            settings[name] = (value,) if of_list else value
        if "rule.reward_weights" in values:
            # Rules with a lookahead have other weights, which would take the place of the trial's.
            settings.setdefault("rule.lookaheads", (0.0,))
        return resolve_config(policy, None, settings, self.seed)

    def suggest(self, trial: Trial) -> tuple[str, dict[str, Value]]:
        """The policy and settings of a trial."""
        policy = self.policies[0]
        if len(self.policies) > 1:
            policy = trial.suggest_categorical(POLICY, self.policies)
        values = {name: choice.suggest(trial, name) for name, choice in self.space(policy).items()}
        return policy, values
