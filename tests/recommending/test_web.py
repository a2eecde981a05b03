"""The application: answers equal to the command's, one clear error per bad request, limits."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import pandas as pd
import pytest

from tests.support.served import FULL, as_frame, histories, requests_of, responder
from ucfrec.commands.cli import main
from ucfrec.commands.recommend import list_hosts
from ucfrec.recommending.requests import Limits
from ucfrec.recommending.responder import Responder
from ucfrec.runs.trained_policy import TrainedPolicy

httpx = pytest.importorskip("httpx")
pytest.importorskip("fastapi_offline")
pytest.importorskip("prometheus_client")
# After the check that they are installed.
from ucfrec.recommending.web import ServerLimits, application  # noqa: E402


@asynccontextmanager
async def client(by: Responder, *hosts: Any, **limits: Any) -> AsyncIterator[Any]:
    """A client of the application, without a network."""
    app = application(by, ServerLimits(**limits), *hosts)
    transport = httpx.ASGITransport(app=app)
    http = httpx.AsyncClient(transport=transport, base_url="http://test")
    async with app.router.lifespan_context(app), http:
        http.app = app
        yield http


def slow(by: Responder, seconds: float) -> list[int]:
    """Let a responder take its time over its batches, whose sizes are returned."""
    sizes: list[int] = []
    answer = by.answers

    def slowly(requests: Sequence[Any]) -> Any:
        sizes.append(len(requests))
        time.sleep(seconds)
        return answer(requests)

    by.answers = slowly  # type: ignore[method-assign]
    return sizes


def test_answers_are_the_commands_and_share_passes(trained: TrainedPolicy, tmp_path: Path) -> None:
    log = histories()
    log.to_parquet(tmp_path / "log.parquet")
    rule = "--exclude-seen --target 2 --minimum-target 0.1 --reward-weight 0.7 --tag-window 2"
    arguments = [str(trained.folder), str(tmp_path / "log.parquet"), *rule.split()]
    assert main(["recommend", *arguments, "--out", str(tmp_path / "out")]) == 0
    by = responder(trained, rule=FULL)
    sizes = slow(by, 0.05)

    async def ask() -> tuple[list[dict[str, Any]], str]:
        async with client(by, batch=8) as http:
            posts = [http.post("/recommendations", json=each) for each in requests_of(log)]
            found = await asyncio.gather(*posts)
            assert {each.status_code for each in found} == {200}
            metrics = (await http.get("/metrics")).text
            return [each.json() for each in found], metrics

    answers, metrics = asyncio.run(ask())
    expected = pd.read_parquet(tmp_path / "out")
    pd.testing.assert_frame_equal(
        as_frame(answers), expected, check_dtype=False, rtol=1e-5, atol=1e-6
    )
    # The first starts at once, or with those that came in the same moment; the others share.
    assert sum(sizes) == 12
    assert len(sizes) <= 4
    assert max(sizes) <= 8
    assert 'ucfrec_requests_total{status="200"} 12.0' in metrics
    assert f"ucfrec_batch_requests_count {len(sizes)}.0" in metrics


WRONG: dict[str, tuple[bytes, int, str]] = {
    "no JSON": (b"{", 400, "the request is not JSON"),
    "of a stream": (b'{"user_id": 1, "interactions": []}', 400, "interactions: extra inputs"),
    "too many items": (b'{"user_id": 1, "k": 6}', 400, "6 items (k): the limit is 5"),
    "unknown": (b'{"user_id": 1, "candidates": ["\\ud800"]}', 400, ""),
    "too large": (b'{"user_id": "' + b"x" * 2000 + b'"}', 413, "more than 1,000 bytes"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_bad_request_has_one_error(trained: TrainedPolicy, case: str) -> None:
    body, status, message = WRONG[case]

    async def chunks() -> AsyncIterator[bytes]:
        yield body

    async def ask() -> list[Any]:
        async with client(responder(trained, limits=Limits(bytes=1000, k=5), k=5)) as http:
            # With and without its length stated.
            given = (body, chunks(), b'{"user_id": 1}')
            return [await http.post("/recommendations", content=each) for each in given]

    *wrong, right = asyncio.run(ask())
    for each in wrong:
        assert each.status_code == status
        assert each.json().keys() == {"error"}
        assert message in each.json()["error"]
        assert "\n" not in each.json()["error"]
    assert len(right.json()["items"]) == 5


def test_what_waits_too_long_or_is_too_much_is_told_so(trained: TrainedPolicy) -> None:
    by = responder(trained)
    slow(by, 0.4)

    async def never() -> AsyncIterator[bytes]:
        yield b"{"
        await asyncio.sleep(60)

    async def ask() -> tuple[list[int], int]:
        async with client(by, timeout=0.2, queue=2, batch=1) as http:

            async def post() -> int:
                return int((await http.post("/recommendations", json={"user_id": 1})).status_code)

            first = asyncio.create_task(post())
            await asyncio.sleep(0.05)
            rest = await asyncio.gather(*(post() for _ in range(4)))
            unfinished = await http.post("/recommendations", content=never())
            return [await first, *rest], unfinished.status_code

    statuses, unfinished = asyncio.run(ask())
    assert sorted(statuses) == [503, 503, 504, 504, 504]
    assert unfinished == 408


def test_a_defect_is_told_without_its_details(
    trained: TrainedPolicy, capsys: pytest.CaptureFixture[str]
) -> None:
    by = responder(trained)
    by.answers = Mock(side_effect=MemoryError("of 3 GiB"))  # type: ignore[method-assign]

    async def ask() -> Any:
        async with client(by) as http:
            return await http.post("/recommendations", json={"user_id": 1})

    answer = asyncio.run(ask())
    assert answer.status_code == 500
    assert "3 GiB" not in answer.text
    assert "MemoryError" in capsys.readouterr().err


def test_a_client_that_hangs_up_is_no_defect(
    trained: TrainedPolicy, capsys: pytest.CaptureFixture[str]
) -> None:
    part = {"type": "http.request", "body": b'{"user_id": ', "more_body": True}
    receive = AsyncMock(side_effect=[part, {"type": "http.disconnect"}])

    async def ask() -> str:
        path = {"path": "/recommendations", "raw_path": b"", "query_string": b"", "headers": []}
        async with client(responder(trained)) as http:
            await http.app({"type": "http", "method": "POST", **path}, receive, AsyncMock())
            return str((await http.get("/metrics")).text)

    metrics = asyncio.run(ask())
    assert 'ucfrec_requests_total{status="499"} 1.0' in metrics
    assert 'status="500"' not in metrics
    assert capsys.readouterr().err == ""


def test_the_pages_describe_the_requests_and_load_nothing_from_elsewhere(
    trained: TrainedPolicy,
) -> None:
    async def ask() -> list[Any]:
        async with client(responder(trained)) as http:
            paths = ("/health", "/openapi.json", "/docs", "/nothing", "/recommendations")
            return [await http.get(path) for path in paths]

    health, described, page, nothing, wrong_method = asyncio.run(ask())
    assert health.json()["status"] == "ok"
    assert health.json()["rule_hash"] == trained.rule.hash
    body = described.json()["paths"]["/recommendations"]["post"]["requestBody"]
    properties = body["content"]["application/json"]["schema"]["properties"]
    assert {*properties} == {"user_id", "history", "k", "candidates", "new_session", "request_id"}
    assert "timestamp" in properties["history"]["items"]["required"]
    assert page.status_code == 200
    assert "https://" not in page.text
    assert (nothing.status_code, nothing.json()) == (404, {"error": "Not Found"})
    assert (wrong_method.status_code, wrong_method.json()) == (405, {"error": "Method Not Allowed"})


@pytest.mark.parametrize(
    ("hosts", "answered"),
    [
        ("shop.example, *.shop.example", {"shop.example": 200, "a.shop.example": 200, "b": 400}),
        ("Shop.example", {"shop.EXAMPLE:80": 200, "ashop.example": 400, "shop.example:x": 400}),
        ("*.shop.example", {"shop.example": 400, "b/.shop.example@c": 400, "": 400}),
        ("*", {"anything": 200}),
        ("::1", {"[::1]": 200, "[::1]:80": 200, "[::2]:80": 400}),
    ],
)
def test_allowed_hosts(trained: TrainedPolicy, hosts: str, answered: dict[str, int]) -> None:
    given = list_hosts(hosts, "0.0.0.0")

    async def answers() -> dict[str, Any]:
        async with client(responder(trained), given) as http:
            return {host: await http.get("/health", headers={"Host": host}) for host in answered}

    found = asyncio.run(answers())
    assert {host: answer.status_code for host, answer in found.items()} == answered
