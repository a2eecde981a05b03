"""Offline training of recommender policies with the Unified Causal Transformer (UCF)."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.recommender import UCF

__version__ = "0.1.0"
__all__ = ["UCF", "EpisodeStore", "__version__"]


def __getattr__(name: str) -> Any:
    # Importing torch takes a second; `ucfrec --help` does without.
    if name == "EpisodeStore":
        from ucfrec.episodes.store import EpisodeStore

        return EpisodeStore
    if name == "UCF":
        from ucfrec.recommender import UCF

        return UCF
    raise AttributeError(f"module 'ucfrec' has no attribute {name!r}")
