"""Turn logs into episodes: files, mapping, cleaning, sessions, item embeddings, store."""

from ucfrec.logs.histories import read_histories
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare, validate

__all__ = [
    "Dataset",
    "FeatureTable",
    "LogMapping",
    "PrepareOptions",
    "prepare",
    "read_histories",
    "validate",
]
