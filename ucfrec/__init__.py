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
    "DecisionRule": "ucfrec.acting.decision",
    "EpisodeStore": "ucfrec.episodes.store",
    "EstimateOptions": "ucfrec.off_policy.evaluate",
    "FeatureTable": "ucfrec.logs.mapping",
    "InputError": "ucfrec.errors",
    "LogFiles": "ucfrec.logs.mapping",
    "LogMapping": "ucfrec.logs.mapping",
    "PrepareOptions": "ucfrec.logs.prepare",
    "Recommender": "ucfrec.python_api.recommender",
    "UCF": "ucfrec.python_api.recommender",
    "prepare": "ucfrec.logs.prepare",
}


def __dir__() -> list[str]:
    # Tab completion offers what users are to use, not the folders of the package.
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    # Lazy, because importing torch takes a second and `ucfrec --help` does not need it.
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'ucfrec' has no attribute {name!r}")
