"""Offline training of recommender policies with the Unified Causal Transformer (UCF)."""

__version__ = "0.1.0"
