"""The methods of the tables."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final


@dataclass(frozen=True)
class Method:
    """A policy and its settings: one line of a table."""

    policy: str
    """One of `ucfrec.policies.registry.policy_names`."""
    settings: tuple[str, ...] = ()
    """Settings over the defaults, as for `--set`."""
    conditioned: bool = True
    """Whether it takes a target return."""
    vectors: bool = True
    """Whether it also supports action vectors; False for policies of items only."""
    tags: bool = False
    """Whether it supports only items with tags."""
    screening: str | None = None
    """One of `ucfrec.runs.screened.SCREENINGS` for logs with observations; None for none."""


PLAIN: Final = ("policy.exposure=false", "rule.choose=false")
"""Settings of a learner without this project's additions: the best item at the largest training
return."""
PLUS: Final = ("policy.exposure=true", "rule.choose=true")
"""The additions that UCF has, for any learner of items: exposure features, and the decision rule
chosen on the log, with the reward weight by the reward model."""
LEARNERS: Final[Mapping[str, Method]] = {
    "sasrec": Method("sasrec", conditioned=False),
    "bc": Method("bc", conditioned=False),
    "bc-10": Method("bc", ("policy.best_share=0.1",), conditioned=False),
    "dt": Method("dt"),
    "dt4rec": Method("dt4rec"),
    "cdt4rec": Method("cdt4rec"),
    "edt4rec": Method("edt4rec"),
}
"""The learners of Table 2 beside UCF."""


def _with(method: Method, settings: tuple[str, ...], vectors: bool) -> Method:
    return replace(method, settings=(*method.settings, *settings), vectors=vectors)


PAPER: Final[Mapping[str, Method]] = {
    "ucf-paper": Method("ucf-paper"),
    "ucf-paper-algorithm-5": Method(
        "ucf-paper",
        ("augment.copies=3", "augment.edits_per_copy=1", "augment.reward_quantile=0.0"),
    ),
}
"""UCF as the paper has it, with Appendix H's copies and with Algorithm 5's."""
METHODS: Final[Mapping[str, Method]] = {
    "popular": Method("popular", ("rule.choose=false",), conditioned=False),
    "item-rate": Method("item-rate", ("rule.choose=false",), conditioned=False, vectors=False),
    "item-rate-mask": Method(
        "item-rate",
        ("rule.choose=false", "rule.default_tag_window=10"),
        conditioned=False,
        vectors=False,
        tags=True,
    ),
    "item-knn": Method("item-knn", ("rule.choose=false",), conditioned=False, vectors=False),
    "crm-greedy": Method("crm-greedy", ("rule.choose=false",), conditioned=False),
    **{name: _with(learner, PLAIN, True) for name, learner in LEARNERS.items()},
    **{f"{name}+": _with(learner, PLUS, False) for name, learner in LEARNERS.items()},
    **PAPER,
    "ucf-plain": Method("ucf", PLAIN, vectors=False),
    "ucf-wo-count": Method("ucf", ("augment.copies=0",)),
    "ucf-wo-arch": Method("dt", ("augment.copies=1", *PLUS)),
    "ucf": Method("ucf"),
}
"""Methods by their name in the tables. A learner's name stands for it as its authors have it, `+`
for it with `PLUS`. UCF has these additions by default, `ucf-plain` lacks them. `ucf-wo-count` and
`ucf-wo-arch` are Table 3's ablations of `ucf`."""
ADDITIONS: Final[Mapping[str, Method]] = {
    "ucf-wo-exposure": Method("ucf", ("policy.exposure=false",), vectors=False),
    "ucf-wo-reward_weight": Method("ucf", ("rule.reward_weights=[0]",), vectors=False),
    "ucf-wo-rule": Method("ucf", ("rule.choose=false",), vectors=False),
    "ucf-weights": Method("ucf", ("policy.advantage_weights=true",)),
    "ucf-max-return": Method("ucf", ("policy.max_return=true",)),
    "ucf-actions": Method("ucf", ("augment.copies=0", "augment.actions=2"), vectors=False),
    "ucf-both": Method("ucf", ("augment.actions=2",), vectors=False),
}
"""UCF without one of what this project added to the paper, or with something more, by their name in
the table of additions."""
SCREENED: Final[Mapping[str, Method]] = {
    "ucf-screened": Method("ucf", screening="copies"),
    "ucf-dropped": Method("ucf", screening="drop"),
}
"""UCF with copies that intervene on the observation columns that screening flags, and UCF without
these columns, by their name in the distractor table."""
