"""Micro-batches: one forward pass for all requests that wait, and none that waits for others."""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from ucfrec.errors import InputError
from ucfrec.recommending.metrics import ServingMetrics
from ucfrec.recommending.requests import Request
from ucfrec.recommending.responder import Answer

Outcome = Answer | InputError


class QueueFullError(Exception):
    """More requests wait than may."""


class _Waiting(NamedTuple):
    request: Request
    outcome: "asyncio.Future[Outcome]"


class Batcher:
    """Answers requests of concurrent callers in one thread, as many at once as have come.

    A request that comes while nothing is computed starts at once; those that come meanwhile wait
    for the end of the forward pass and share the next.
    """

    def __init__(
        self,
        answers: Callable[[Sequence[Request]], list[Outcome]],
        metrics: ServingMetrics,
        largest: int,
        queue: int,
    ) -> None:
        """
        Args:
            answers: computes a batch, see `Responder.answers`.
            metrics: receives every batch, and how many requests wait whenever that changes.
            largest: most requests of a batch.
            queue: most requests that wait.
        """
        self._answers, self._metrics = answers, metrics
        self._largest, self._most = largest, queue
        self._queue: deque[_Waiting] = deque()
        self._thread = ThreadPoolExecutor(1, "forward")
        self._running: asyncio.Task[None] | None = None

    async def answer(self, request: Request) -> Outcome:
        """The answer to a request, or what is wrong with it; a cancelled one has no one waiting.

        Raises:
            QueueFullError: too many requests wait.
        """
        if len(self._queue) >= self._most:
            raise QueueFullError
        outcome: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self._queue.append(_Waiting(request, outcome))
        self._metrics.waiting(len(self._queue))
        if self._running is None or self._running.done():
            self._running = asyncio.create_task(self._run())
        return await outcome

    async def close(self) -> None:
        """Answer what waits, and end the thread."""
        if self._running is not None:
            await self._running
        self._thread.shutdown()

    async def _run(self) -> None:
        while batch := self._next():
            began = time.perf_counter()
            requests = [waiting.request for waiting in batch]
            loop = asyncio.get_running_loop()
            try:
                outcomes: Sequence[Outcome | Exception] = await loop.run_in_executor(
                    self._thread, self._answers, requests
                )
            except Exception as error:  # a bug, or out of memory; every caller receives it
                outcomes = [error] * len(batch)
            self._metrics.batch(len(batch), time.perf_counter() - began)
            for waiting, outcome in zip(batch, outcomes, strict=True):
                if waiting.outcome.done():
                    continue
                if isinstance(outcome, Exception) and not isinstance(outcome, InputError):
                    waiting.outcome.set_exception(outcome)
                else:
                    waiting.outcome.set_result(outcome)

    def _next(self) -> list[_Waiting]:
        batch: list[_Waiting] = []
        while self._queue and len(batch) < self._largest:
            waiting = self._queue.popleft()
            if not waiting.outcome.done():
                batch.append(waiting)
        self._metrics.waiting(len(self._queue))
        return batch
