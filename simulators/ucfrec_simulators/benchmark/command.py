"""`ucfrec benchmark recommendation`: what it measures and shows."""

from typing import Final

from ucfrec.benchmark.suite import Benchmark, Shown
from ucfrec.benchmark.tables import distractor_table, method_table, sweep_table
from ucfrec_simulators.benchmark.measure import MEASUREMENT
from ucfrec_simulators.benchmark.methods import BUDGETS, COMPONENTS, METHODS
from ucfrec_simulators.benchmark.plan import RecommendationCells
from ucfrec_simulators.benchmark.tasks import TASKS

BENCHMARK: Final = Benchmark(
    summary="the methods of the paper's Table 2 with built-in policies, ablations, shared "
    "components, sweeps of UCF, a distractor",
    tables={
        "main": Shown("Methods", method_table),
        "shared": Shown("Shared components, one by one", method_table),
        "distractor": Shown("A distractor that causes nothing", distractor_table),
        "sweeps": Shown("Settings of UCF", sweep_table),
    },
    budgets=BUDGETS,
    tasks=TASKS,
    methods={**METHODS, **COMPONENTS},
    plan=RecommendationCells,
    how=MEASUREMENT,
)
