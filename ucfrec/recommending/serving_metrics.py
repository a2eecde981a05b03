"""Prometheus metrics of the server."""

from collections.abc import Callable, Mapping
from typing import Final

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)

_SECONDS: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_SIZES: Final = (1, 2, 4, 8, 16, 32, 64, 128, 256)


class ServingMetrics:
    """What one server has done, in a registry of its own."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        self._requests = Counter(
            "ucfrec_requests",
            "Requests for recommendations, by HTTP status.",
            ["status"],
            registry=self._registry,
        )
        self._seconds = Histogram(
            "ucfrec_request_seconds",
            "Time from the request's first byte to its answer.",
            buckets=_SECONDS,
            registry=self._registry,
        )
        self._sizes = Histogram(
            "ucfrec_batch_requests",
            "Requests of a forward pass.",
            buckets=_SIZES,
            registry=self._registry,
        )
        self._passes = Histogram(
            "ucfrec_batch_seconds",
            "Time of reading and scoring the requests of a forward pass.",
            buckets=_SECONDS,
            registry=self._registry,
        )
        self.waiting = Gauge(
            "ucfrec_waiting_requests",
            "Requests that wait for a forward pass.",
            registry=self._registry,
        )

        self.drift: Callable[[], Mapping[str, float]] = dict
        """Returns what is different in requests, or in the logs of the last update, by name."""
        self._drift = Gauge(
            "ucfrec_drift",
            "Unknown items and users of requests, shares since the run began to answer; and the "
            "drift that the run's update found (update_…).",
            ["measure"],
            registry=self._registry,
        )

    def request(self, status: int, seconds: float) -> None:
        """Count a request that was answered."""
        self._requests.labels(str(status)).inc()
        self._seconds.observe(seconds)

    def batch(self, requests: int, seconds: float) -> None:
        """Count a forward pass."""
        self._sizes.observe(requests)
        self._passes.observe(seconds)

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        self._drift.clear()
        for name, value in self.drift().items():
            self._drift.labels(name).set(value)
        return generate_latest(self._registry)
