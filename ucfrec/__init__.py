"""Offline training of recommender policies with the Unified Causal Transformer (UCF)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.recommender import UCF, Recommender

__version__ = "0.1.0"
__all__ = ["UCF", "EpisodeStore", "Recommender", "__version__"]

_MODULES = {
    "EpisodeStore": "ucfrec.episodes.store",
    "Recommender": "ucfrec.recommender",
    "UCF": "ucfrec.recommender",
}


def __getattr__(name: str) -> Any:
    # Lazy, because importing torch takes a second and `ucfrec --help` does not need it.
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'ucfrec' has no attribute {name!r}")
