"""The server as a process: it verifies the run, listens, and ends its requests before itself."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pandas as pd
import pytest

from ucfrec.commands.cli import main
from ucfrec.runs.trained_policy import TrainedPolicy

httpx = pytest.importorskip("httpx")
pytest.importorskip("uvicorn")
pytest.importorskip("fastapi_offline")


@contextmanager
def served(run: Path, *options: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """A server process and its address."""
    command = [sys.executable, "-m", "ucfrec.commands.cli", "serve", str(run), "--port", "0"]
    with subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            ready = process.stdout.readline()
            assert "ready at http://127.0.0.1:" in ready
            yield process, ready.split("ready at ")[1].split()[0]
        finally:
            process.kill()


def test_it_follows_the_promoted_run_and_answers_all_the_while(
    trained: TrainedPolicy, tmp_path: Path
) -> None:
    for name in ("monday", "tuesday"):
        shutil.copytree(trained.folder, tmp_path / name)
    assert main(["promote", str(tmp_path / "monday")]) == 0
    with served(tmp_path) as (_, address):
        assert httpx.get(f"{address}/health").json()["name"] == "monday"
        assert main(["promote", str(tmp_path / "tuesday"), "--force"]) == 0
        deadline = time.monotonic() + 60
        while httpx.get(f"{address}/health").json()["name"] != "tuesday":
            answer = httpx.post(f"{address}/recommendations", json={"user_id": 1, "k": 2})
            assert answer.status_code == 200
            assert time.monotonic() < deadline
        metrics = httpx.get(f"{address}/metrics").text
        assert 'ucfrec_drift{measure="unknown_users"}' in metrics


def test_two_runs_share_the_users_and_term_writes_the_exposures_of_every_answer(
    trained: TrainedPolicy, tmp_path: Path
) -> None:
    for name in ("a", "b"):
        shutil.copytree(trained.folder, tmp_path / name)
    folder = tmp_path / "shown"
    options = ("--split", "a=0.5,b=0.5", "--temperature", "2", "--exposures", str(folder))
    with served(tmp_path, *options) as (process, address):
        answers = [
            httpx.post(f"{address}/recommendations", json={"user_id": user, "k": 2}).json()
            for user in range(20)
        ]
        assert not list(folder.iterdir())
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    assert {answer["arm"] for answer in answers} == {"a", "b"}
    shown = pd.concat(map(pd.read_parquet, folder.iterdir()))
    names = ["user_id", "arm", "request_id", "position", "item_id", "propensity"]
    expected = [
        (str(answer["user_id"]), answer["arm"], answer["request_id"], position, *item)
        for answer in answers
        for position, item in enumerate(
            ((each["item_id"], each["propensity"]) for each in answer["items"]), 1
        )
    ]
    assert sorted(shown[names].itertuples(index=False, name=None)) == sorted(expected)


def test_term_ends_it_after_the_requests_in_flight(trained: TrainedPolicy) -> None:
    with served(trained.folder) as (process, address):
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=60) as slow:
            body = b'{"user_id": 1, "k": 3}'
            head = f"POST /recommendations HTTP/1.1\r\nHost: {host}\r\n"
            head += f"Content-Length: {len(body)}\r\n\r\n"
            slow.sendall(head.encode() + body[:5])
            assert httpx.get(f"{address}/health").status_code == 200
            process.send_signal(signal.SIGTERM)
            time.sleep(0.5)
            slow.sendall(body[5:])
            answer = b""
            while block := slow.recv(65536):
                answer += block
        assert answer.startswith(b"HTTP/1.1 200 OK")
        assert b'"items"' in answer
        _, errors = process.communicate(timeout=60)
        assert (process.returncode, errors) == (0, "ucfrec serve: stopped\n")
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{address}/health")


def answers_of(address: str, *parts: bytes) -> bytes:
    """What the server sends until it closes the connection."""
    host, port = address.removeprefix("http://").split(":")
    answer = b""
    with socket.create_connection((host, int(port)), timeout=60) as connection:
        with suppress(ConnectionError):  # it may close before all is sent
            for part in parts:
                connection.sendall(part)
        with suppress(ConnectionError):
            while block := connection.recv(65536):
                answer += block
    return answer


def head(*lines: bytes, what: bytes = b"GET /health") -> bytes:
    return b"\r\n".join([what + b" HTTP/1.1", b"Host: localhost", *lines, b"", b""])


CLOSE = b"Connection: close"
CHUNKED = head(b"Transfer-Encoding: chunked", CLOSE, what=b"POST /recommendations")
REQUESTS = {
    "headers within the limits": (head(*[b"a: b"] * 90, CLOSE), b"200"),
    "too many headers": (head(*[b"a: b"] * 101, CLOSE), b"431"),
    "a long header": (head(b"a: " + b"b" * 2**17), b"4"),
    "a header without end": (head(b"a: " + b"b" * 2**20)[:-4], b"4"),
    "a long address": (head(what=b"GET /" + b"a" * 2**17), b"4"),
    "trailers without end": (CHUNKED + b"0\r\n" + b"a: b\r\n" * 2**18, b"4"),
    "two lengths": (head(b"Content-Length: 3", b"Content-Length: 4") + b"abcd", b"400"),
    "few requests at once": (head() * 9 + head(CLOSE), b"200"),
    "no HTTP": (b"\x16\x03\x01" * 100 + b"\r\n\r\n", b"400"),
    "another host": (head(CLOSE).replace(b"localhost", b"evil.example"), b"400"),
    "another port": (head(CLOSE).replace(b"localhost", b"localhost:99"), b"200"),
    "an address": (head(CLOSE).replace(b"localhost", b"127.0.0.1"), b"200"),
    "an address of IPv6": (head(CLOSE).replace(b"localhost", b"[::1]:80"), b"200"),
    "a name like ours": (head(CLOSE).replace(b"localhost", b"localhost.evil.example"), b"400"),
}


@pytest.fixture(scope="module")
def address(trained: TrainedPolicy) -> Iterator[str]:
    with served(trained.folder, "--threads", "1") as (_, address):
        yield address


@pytest.mark.parametrize("case", REQUESTS)
def test_heads_are_bounded_and_hosts_checked(address: str, case: str) -> None:
    sent, status = REQUESTS[case]
    assert answers_of(address, sent).startswith(b"HTTP/1.1 " + status)
    assert httpx.get(f"{address}/health").status_code == 200


def resident(process: int) -> int:
    """Megabytes of a process."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) // 1024 for line in lines if line.startswith("VmRSS"))


def cpu_seconds(process: int) -> float:
    """Processor time of a process that is not waited for yet."""
    numbers = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")


def test_pipelined_requests_take_no_memory_and_term_is_obeyed(trained: TrainedPolicy) -> None:
    with served(trained.folder, "--timeout", "1") as (process, address):
        host, port = address.removeprefix("http://").split(":")
        before, many = resident(process.pid), (head() + head(what=b"GET /nowhere")) * 10_000
        with socket.create_connection((host, int(port)), timeout=0.5) as flood:
            with suppress(TimeoutError, ConnectionError):
                for _ in range(30):
                    flood.sendall(many)
            assert httpx.get(f"{address}/health", timeout=20).status_code == 200
            assert resident(process.pid) < before + 100
            began = cpu_seconds(process.pid)
            process.send_signal(signal.SIGTERM)
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            # Answering what was sent would take minutes; the end of any server takes a second.
            assert cpu_seconds(process.pid) - began < 5


@pytest.mark.parametrize("hosts", ["a*", "http://a", "*.*", "", "a:80"])
def test_what_is_no_host_is_refused(
    trained: TrainedPolicy, capsys: pytest.CaptureFixture[str], hosts: str
) -> None:
    assert main(["serve", str(trained.folder), "--port", "0", "--allowed-hosts", hosts]) == 2
    assert "is not a host" in capsys.readouterr().err


def test_requests_of_many_clients_are_answered(address: str) -> None:
    answers: list[int] = []

    def ask() -> None:
        with httpx.Client(base_url=address, timeout=60) as client:
            for user in range(10):
                answer = client.post("/recommendations", json={"user_id": user, "k": 4})
                answers.append(len(answer.json()["items"]))

    clients = [threading.Thread(target=ask) for _ in range(8)]
    for each in clients:
        each.start()
    for each in clients:
        each.join()
    assert answers == [4] * 80


def test_a_damaged_run_and_a_taken_port_are_refused(
    trained: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["serve", str(trained.folder), "--port", port]) == 2
    assert "cannot listen on 127.0.0.1" in capsys.readouterr().err
    items = trained.folder / "items.parquet"
    content = items.read_bytes()
    try:
        items.write_bytes(content[:-1] + b"?")
        assert main(["serve", str(trained.folder), "--port", "0"]) == 2
    finally:
        items.write_bytes(content)
    assert "items.parquet has another content" in capsys.readouterr().err
    assert main(["serve", str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err
