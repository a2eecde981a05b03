"""The methods of the tables, their tasks, and the sizes of the benchmark."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from ucfrec.benchmark.cells import Budget, Evaluation, Method, make_augmented_ucf

PLAIN: Final = ("policy.exposure=false", "rule.choose=false")
"""Settings of a policy without the shared components: the best item at the largest training
return."""
SHARED: Final = ("policy.exposure=true", "rule.choose=true")
"""The shared components, which UCF has by default, for any policy of items: exposure features, and
the decision rule chosen on the log, with a reward weight."""
BASELINES: Final[Mapping[str, Method]] = {
    "sasrec": Method("sasrec", conditioned=False),
    "bc": Method("bc", conditioned=False),
    "bc-10": Method("bc", ("policy.best_share=0.1",), conditioned=False),
    "dt": Method("dt"),
    "dt4rec": Method("dt4rec"),
    "cdt4rec": Method("cdt4rec"),
    "edt4rec": Method("edt4rec"),
}
"""The methods of Table 2 beside UCF."""


def _simple(name: str, settings: tuple[str, ...] = (), vectors: bool = True) -> Method:
    return Method(name, ("rule.choose=false", *settings), conditioned=False, vectors=vectors)


def _extend(method: Method, settings: tuple[str, ...], vectors: bool) -> Method:
    return replace(method, settings=(*method.settings, *settings), vectors=vectors)


PEERS: Final[Mapping[str, Method]] = {"gsasrec": Method("gsasrec", conditioned=False)}
"""Strong methods of practice that are trained by gradients; items only."""
PAPER: Final[Mapping[str, Method]] = {
    "ucf-paper": Method("ucf-paper"),
    "ucf-paper-algorithm-5": Method(
        "ucf-paper", ("augment.copies=3", "augment.edits_per_copy=1", "augment.reward_quantile=0.0")
    ),
}
"""UCF as read in the paper, with Appendix H's copies and with Algorithm 5's."""
METHODS: Final[Mapping[str, Method]] = {
    "popular": _simple("popular"),
    "item-rate": _simple("item-rate", vectors=False),
    "item-rate-mask": replace(
        _simple("item-rate", ("rule.default_tag_window=10",), vectors=False), tags=True
    ),
    **{
        name: _simple(name, vectors=False)
        for name in ("item-knn", "recent-clicks", "recent-rate", "boosted")
    },
    "crm-greedy": _simple("crm-greedy"),
    **{name: _extend(method, PLAIN, True) for name, method in BASELINES.items()},
    **{f"{name}+shared": _extend(method, SHARED, False) for name, method in BASELINES.items()},
    **{name: _extend(method, PLAIN, False) for name, method in PEERS.items()},
    **{f"{name}+shared": _extend(method, SHARED, False) for name, method in PEERS.items()},
    **PAPER,
    "ucf-plain": make_augmented_ucf(*PLAIN, vectors=False),
    "ucf-wo-count": Method("ucf"),
    "ucf-wo-arch": Method("dt", ("augment.copies=1", *SHARED)),
    "ucf": make_augmented_ucf(),
}
"""Methods by their name in the tables. A policy's name stands for it as its authors have it,
`+shared` for it with `SHARED`. UCF has these components by default, `ucf-plain` lacks them.
`ucf-wo-count` and `ucf-wo-arch` are Table 3's ablations of `ucf`."""
COMPONENTS: Final[Mapping[str, Method]] = {
    "ucf-wo-exposure": make_augmented_ucf("policy.exposure=false", vectors=False),
    "ucf-wo-reward-weight": make_augmented_ucf(
        "rule.reward_weights=[0]", "rule.lookaheads=[0]", vectors=False
    ),
    "ucf-wo-lookahead": make_augmented_ucf("rule.lookaheads=[0]", vectors=False),
    "ucf-wo-policy": make_augmented_ucf("rule.policy_weights=[0]", vectors=False),
    "ucf-wo-rule": make_augmented_ucf("rule.choose=false", vectors=False),
    "ucf-actions": Method("ucf", ("augment.actions=2",), vectors=False),
    "ucf-both": make_augmented_ucf("augment.actions=2", vectors=False),
}
"""UCF without one of the shared components, or with another one, by their name in the table
`shared`. `ucf-wo-policy` has policy weight 0 wherever it looks ahead."""
MAIN: Final = ("kuairand", "kuairec", "virtual-taobao", "synthetic-catalog", "sardine-boredinf")
SHARED_TASKS: Final = ("kuairand", "synthetic-catalog", "sardine-boredinf")
"""Tasks of the table of shared components, whose actions are items."""
SWEPT: Final = ("synthetic-catalog", "synthetic-taobao")
"""Tasks that can be swept. Not VirtualTaobao: there all sequence policies reach the maximum
return."""
DISTRACTED: Final = {"synthetic-taobao": 0, "synthetic-catalog": 0, "kuairand": 2}
"""Tasks that can have a distractor, and the index of the environment that is evaluated. Of KuaiRand
that is NX_10: all its sessions have the same length, so early exits do not hide the distractor's
effect."""
BUDGETS: Final[Mapping[str, Budget]] = {
    # Sized for two cores: smaller width, fewer steps, smaller logs, fewer tasks beside those of the
    # main table, cheaper settings of two baselines, of the paper's settings only the steps; methods
    # and seeds are not reduced.
    "small": Budget(
        name="small",
        seeds=3,
        logs=2,
        tasks=MAIN,
        tasks_of={"shared": SHARED_TASKS, "sweeps": SWEPT[:1], "distractor": SWEPT[:1]},
        sessions=6000,
        settings=(
            *("policy.dim=64", "train.steps=400", "train.learning_rate=1e-3"),
            *("train.warmup_steps=40", "train.validate_every=100", "train.average=0.0"),
            *("crm.epochs=8", "crm.learning_rate=4e-3", "rule.sessions=50", "rule.evidence=0"),
        ),
        of_policies={"dt4rec": ("policy.negatives=1",), "edt4rec": ("policy.cql_steps=400",)},
        evaluation=Evaluation(episodes=300, seed=1_000_000),
    ),
    "full": Budget(
        name="full",
        seeds=5,
        logs=3,
        tasks=(*MAIN, "sardine-static"),
        tasks_of={"shared": SHARED_TASKS, "sweeps": SWEPT, "distractor": tuple(DISTRACTED)},
        sessions=50_000,
        settings=("train.steps=20000", "train.learning_rate=3e-4", "rule.evidence=0"),
        evaluation=Evaluation(episodes=5000, seed=1_000_000),
    ),
}
