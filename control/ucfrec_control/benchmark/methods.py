"""Rows of the control tables: policies and their settings, by the name of the row."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

from ucfrec.benchmark.cells import PAPER_UCF, Method, make_augmented_ucf
from ucfrec_control.training.screening import SCREENING

SCORES, ROBUSTNESS = "control", "robustness"
"""Suites of the rows."""
Methods = dict[str, Method]
_NO_TIME = "policy.max_timestep=1"
_ALGORITHM_5 = ("augment.copies=3", "augment.edits_per_copy=1", "augment.reward_quantile=0.0")
_NO_GATE = "augment.epsilon_r=1e9"
"""Disables the gate on the change of the reward; the limit on a move's length stays."""
LAMBDAS = (0.0, 0.05, 0.1, 0.25, 0.5, 1.0)


def _paper_rows(rows: Mapping[str, tuple[str, ...]]) -> Methods:
    return {f"{PAPER_UCF}-{name}": Method(PAPER_UCF, settings) for name, settings in rows.items()}


PAPER: Methods = {PAPER_UCF: Method(PAPER_UCF), **_paper_rows({"algorithm-5": _ALGORITHM_5})}
"""UCF as read in the paper, with Appendix H's copies and with Algorithm 5's."""
PAPER_ABLATIONS: Methods = {
    **_paper_rows({"wo-count": ("augment.copies=0",)}),
    f"{PAPER_UCF}-wo-arch": Method(
        "dt",
        (
            *("augment.copies=1", "csg.kind=faithful", "csg.max_transitions=1000000000"),
            *("crm.mean_first=false", "crm.learning_rate=3e-4", "crm.epochs=40"),
            *("crm.max_transitions=1000000000", "augment.max_steps=1000000000"),
            "train.average=0.0",
        ),
    ),
}
"""Table 3's ablations of it: the second is DT on its augmented data."""
METHODS: Methods = {
    "bc": Method("bc"),
    "bc-10": Method("bc", ("policy.best_share=0.1",)),
    "bc-25": Method("bc", ("policy.best_share=0.25",)),
    "iql": Method("iql"),
    "cql": Method("cql"),
    "dt": Method("dt"),
    "dt-wo-time": Method("dt", (_NO_TIME,)),
    "dc": Method("dc"),
    "dc-wo-time": Method("dc", (_NO_TIME,)),
    "lsdt": Method("lsdt"),
    "lsdt-wo-time": Method("lsdt", (_NO_TIME,)),
    "ucf": make_augmented_ucf(),
    "ucf-w-time": make_augmented_ucf("policy.max_timestep=1000"),
    **PAPER,
    **PAPER_ABLATIONS,
    "ucf-wo-count": Method("ucf"),
    "ucf-wo-arch": Method("dt", (_NO_TIME, "augment.copies=1")),
}
"""Methods by the name of the table's row; the last two are Table 3's ablations of `ucf`.

UCF's preset has no embedding of time steps, the presets of DT, DC and LSDT have one; `ucf-w-time`
and `…-wo-time` are the reverse. `ucf-wo-arch` has none, as UCF.
"""
WITHOUT_TIME = (
    *("ucf", "ucf-wo-count", "dc-wo-time", "dt-wo-time", "lsdt-wo-time"),
    *("bc", "bc-10", "bc-25"),
)
"""Methods of a training long enough to be trusted: one of each architecture, and cloning."""
WITH_TIME = ("dt", "dc", "lsdt", "ucf-w-time")
"""Methods with embeddings of time steps of which there is one without."""

METHODS_WO_TIME = {"dt": "dt-wo-time", "dc": "dc-wo-time", "lsdt": "lsdt-wo-time", "ucf": "ucf"}
"""The method without embeddings of time steps, by policy."""
_BEST = "-best-25"
"""Suffix of methods that learn from the best quarter of the trajectories."""
_UCF = ("ucf", "ucf-wo-count")
_BASELINES = ("dt-wo-time", "dc-wo-time", "lsdt-wo-time")


def _rows(names: Iterable[str], more: str = "") -> Methods:
    """Rows of `METHODS`, each also with `_BEST`; all names end with `more`."""
    best = ("policy.best_share=0.25",)
    return {
        f"{name}{way}{more}": replace(METHODS[name], settings=METHODS[name].settings + settings)
        for name in names
        for way, settings in (("", ()), (_BEST, best))
    }


MAIN, PURSUING, EQUAL_TIME, LAMBDA = "main", "pursuing", "equal-time", "lambda"
_TABLES: dict[str, Methods] = {
    # In the small budget trainings of x3 take as long as LSDT's, the others as DT's
    # (benchmarks/LOG.md).
    EQUAL_TIME: {
        **{f"{name}-x8": METHODS[name] for name in ("bc", "bc-10", "bc-25")},
        **_rows(_BASELINES),
        **_rows(_UCF, "-x2"),
        **{f"{name}-x3": METHODS[name] for name in _UCF},
    },
    # All but the paper's without embeddings of time steps, as UCF is.
    PURSUING: _rows((*_BASELINES, *_UCF)),
    # Figure 2; the paper's settings have λ 0.1.
    LAMBDA: {
        **{
            f"ucf-lambda-{weight:g}": make_augmented_ucf(f"policy.lambda_mask={weight}")
            for weight in LAMBDAS
        },
        **_paper_rows({f"lambda-{w:g}": (f"policy.lambda_mask={w}",) for w in LAMBDAS if w != 0.1}),
    },
    # Table 9, with the tangent generator and with the paper's.
    "gate": {
        "ucf": make_augmented_ucf(),
        "ucf-wo-gate": make_augmented_ucf(_NO_GATE),
        **_paper_rows({"wo-gate": (_NO_GATE,)}),
    },
    # Table 10: λ_band exists for the paper's network only; for tangent moves the band is widened.
    "band": {
        "ucf": make_augmented_ucf(),
        "ucf-wide": make_augmented_ucf("csg.band=[0.2, 2.0]"),
        "ucf-wo-lower": make_augmented_ucf("csg.band=[0.0, 0.5]"),
        **_paper_rows({"wo-band": ("csg.lambda_band=0.0",), "wo-lower": ("csg.band=[0.0, 0.5]",)}),
    },
}
LONGER = {
    **{f"{name}-x8": 8 for name in ("bc", "bc-10", "bc-25")},
    **{f"{name}{way}-x2": 2 for name in _UCF for way in ("", _BEST)},
    **{f"{name}-x3": 3 for name in _UCF},
}
"""How many times the budget's steps, by method."""
TABLES = {MAIN: METHODS, **{name: rows | PAPER for name, rows in _TABLES.items()}}
"""Rows of each table, as in `METHODS`."""
SCREENED = {
    "ucf-screened": replace(METHODS["ucf"], options={SCREENING: "copies"}),
    "ucf-dropped": replace(METHODS["ucf"], options={SCREENING: "drop"}),
}
"""UCF with augmentation that intervenes on flagged dimensions, and UCF trained without them."""
ROBUST: Methods = {
    **{
        name: METHODS[name]
        for name in (*METHODS_WO_TIME.values(), PAPER_UCF, "ucf-wo-count", "ucf-wo-arch")
    },
    **SCREENED,
}
"""Rows of the robustness table."""
