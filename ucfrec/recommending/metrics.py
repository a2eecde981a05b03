"""The metrics of a server, in Prometheus' text format: of one process, or of all that share it."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

from ucfrec.recommending.responder import Mean

_SECONDS: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_SIZES: Final = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_DRIFT: Final = "ucfrec_drift"
_WEIGHT: Final = "ucfrec_drift_weight"


class ServingMetrics:
    """What a server has done, in a registry of its own."""

    def __init__(self, drift: Callable[[], Mapping[str, Mean]] = dict, shared: bool = False):
        """
        Args:
            drift: returns what is different in requests, or in the logs of the last update, by
                name.
            shared: the text has the totals of all processes that share the folder
                PROMETHEUS_MULTIPROC_DIR.
        """
        registry = CollectorRegistry()
        self._of_drift, self._shared = drift, shared
        self._collector: Collector = registry
        if shared:
            self._collector = MultiProcessCollector(None)  # type: ignore[no-untyped-call]
        self._requests = Counter(
            "ucfrec_requests",
            "Requests for recommendations, by HTTP status.",
            ["status"],
            registry=registry,
        )
        self._seconds = Histogram(
            "ucfrec_request_seconds",
            "Time from the request's first byte to its answer.",
            buckets=_SECONDS,
            registry=registry,
        )
        self._sizes = Histogram(
            "ucfrec_batch_requests",
            "Requests of a forward pass.",
            buckets=_SIZES,
            registry=registry,
        )
        self._passes = Histogram(
            "ucfrec_batch_seconds",
            "Time of reading and scoring the requests of a forward pass.",
            buckets=_SECONDS,
            registry=registry,
        )
        self._waiting = Gauge(
            "ucfrec_waiting_requests",
            "Requests that wait for a forward pass.",
            registry=registry,
            multiprocess_mode="livesum",
        )
        self._totals, self._weights = (
            Gauge(
                name,
                "Unknown items and users of requests, shares since the run began to answer; and "
                "the drift that the run's update found (update_…).",
                ["measure"],
                registry=registry,
                multiprocess_mode="livesum",
            )
            for name in (_DRIFT, _WEIGHT)
        )
        self._set: dict[str, Mean] = {}
        self._used, self._cpu = 0.0, None
        if shared:
            # `ProcessCollector` would describe whichever process is asked.
            what = "Total user and system CPU time spent in seconds."
            self._cpu = Counter("process_cpu_seconds", what, registry=registry)
            self._update()
        else:
            ProcessCollector(registry=registry)

    def request(self, status: int, seconds: float) -> None:
        """Count a request that was answered."""
        self._requests.labels(str(status)).inc()
        self._seconds.observe(seconds)

    def batch(self, requests: int, seconds: float) -> None:
        """Count a forward pass."""
        self._sizes.observe(requests)
        self._passes.observe(seconds)
        if self._shared:
            self._update()

    def waiting(self, requests: int) -> None:
        """Remember how many requests wait."""
        self._waiting.set(requests)

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        self._update()
        return generate_latest(self)

    def collect(self) -> Iterator[Metric]:
        """All metrics, as `prometheus_client` asks for them."""
        metrics = {metric.name: metric for metric in self._collector.collect()}
        weights = _map_by_measure(metrics.pop(_WEIGHT).samples)
        drift = metrics[_DRIFT]
        totals = _map_by_measure(drift.samples)
        # A measure of a run that answered before is not removed from the files.
        drift.samples = [
            Sample(_DRIFT, {"measure": name}, Mean(totals[name], weights[name]).value)
            for name in self._set
        ]
        yield from metrics.values()

    def _update(self) -> None:
        """Bring up to date what nothing else reports."""
        previous, self._set = self._set, dict(self._of_drift())
        for name, mean in self._set.items():
            if previous.get(name) != mean:
                self._totals.labels(name).set(mean.total)
                self._weights.labels(name).set(mean.weight)
        if self._cpu is not None:
            seconds, self._used = self._used, time.process_time()
            self._cpu.inc(self._used - seconds)


def _map_by_measure(samples: Iterable[Sample]) -> dict[str, float]:
    return {sample.labels["measure"]: sample.value for sample in samples}
