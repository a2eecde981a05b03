"""The methods of the tables."""

from collections.abc import Mapping
from dataclasses import dataclass
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
    screening: str | None = None
    """One of `ucfrec.runs.screened.SCREENINGS` for logs with observations; None for none."""


METHODS: Final[Mapping[str, Method]] = {
    "popular": Method("popular", conditioned=False),
    "item-rate": Method("item-rate", ("rule.choose=false",), conditioned=False, vectors=False),
    "item-rate-mask": Method(
        "item-rate",
        ("rule.choose=false", "rule.default_tag_window=10"),
        conditioned=False,
        vectors=False,
    ),
    "item-knn": Method("item-knn", conditioned=False, vectors=False),
    "sasrec": Method("sasrec", conditioned=False),
    "bc": Method("bc", conditioned=False),
    "bc-25": Method("bc", ("policy.best_share=0.25",), conditioned=False),
    "bc-10": Method("bc", ("policy.best_share=0.1",), conditioned=False),
    "crm-greedy": Method("crm-greedy", ("rule.choose=false",), conditioned=False),
    "dt": Method("dt"),
    "dt4rec": Method("dt4rec"),
    "cdt4rec": Method("cdt4rec"),
    "edt4rec": Method("edt4rec"),
    "ucf-wo-count": Method("ucf", ("augment.copies=0",)),
    "ucf-wo-arch": Method("dt", ("augment.copies=1",)),
    "ucf-paper": Method("ucf-paper"),
    "ucf": Method("ucf"),
}
"""Methods by their name in the tables; `ucf-wo-count` and `ucf-wo-arch` are Table 3's ablations."""
ADDITIONS: Final[Mapping[str, Method]] = {
    "dt-exposure": Method("dt", ("policy.exposure=true",)),
    "ucf-wo-exposure": Method("ucf", ("policy.exposure=false",), vectors=False),
    "ucf-wo-tilt": Method("ucf", ("rule.tilts=[0]",), vectors=False),
    "ucf-wo-rule": Method("ucf", ("rule.choose=false",), vectors=False),
    "ucf-weights": Method("ucf", ("policy.advantage_weights=true",)),
    "ucf-max-return": Method("ucf", ("policy.max_return=true",)),
}
"""UCF without one of what this project added to the paper, or with another, and DT with exposure
features, by their name in the table of additions."""
SCREENED: Final[Mapping[str, Method]] = {
    "ucf-screened": Method("ucf", screening="copies"),
    "ucf-dropped": Method("ucf", screening="drop"),
}
"""UCF with copies that intervene on the observation columns that screening flags, and UCF without
these columns, by their name in the distractor table."""
