"""Offline training of recommender policies with the Unified Causal Transformer (UCF)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.errors import InputError
    from ucfrec.logs.mapping import FeatureTable, LogFiles, LogMapping
    from ucfrec.logs.prepare import PrepareOptions, prepare
    from ucfrec.off_policy.evaluate import EstimateOptions
    from ucfrec.python_api.recommender import UCF, Recommender

__version__ = "0.1.0"
__all__ = [
    "UCF",
    "DecisionRule",
    "EpisodeStore",
    "EstimateOptions",
    "FeatureTable",
    "InputError",
    "LogFiles",
    "LogMapping",
    "PrepareOptions",
    "Recommender",
    "__version__",
    "prepare",
]

_MODULES = {
    "acting.decision": ("DecisionRule",),
    "episodes.store": ("EpisodeStore",),
    "errors": ("InputError",),
    "logs.mapping": ("FeatureTable", "LogFiles", "LogMapping"),
    "logs.prepare": ("PrepareOptions", "prepare"),
    "off_policy.evaluate": ("EstimateOptions",),
    "python_api.recommender": ("UCF", "Recommender"),
}


def __dir__() -> list[str]:
    # Tab completion offers what users are to use, not the folders of the package.
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    # Lazy, because importing torch takes a second and `ucfrec --help` does not need it.
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"ucfrec.{module}"), name)
    raise AttributeError(f"module 'ucfrec' has no attribute {name!r}")
