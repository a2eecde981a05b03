"""The server as a process: it verifies the run, listens, and ends its requests before itself."""

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.served import trained_run
from ucfrec.commands.cli import main
from ucfrec.runs.trained_policy import TrainedPolicy

httpx = pytest.importorskip("httpx")
pytest.importorskip("uvicorn")
pytest.importorskip("fastapi_offline")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    return trained_run(tmp_path_factory.mktemp("server"))


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


def test_term_ends_it_after_the_requests_in_flight(trained: TrainedPolicy) -> None:
    with served(trained.folder) as (process, address):
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=60) as slow:
            body = b'{"user_id": 1, "k": 3}'
            head = (
                f"POST /recommendations HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n"
            )
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


def test_requests_of_many_clients_are_answered(trained: TrainedPolicy) -> None:
    answers: list[int] = []

    def ask(address: str) -> None:
        with httpx.Client(base_url=address, timeout=60) as client:
            for user in range(10):
                answer = client.post("/recommendations", json={"user_id": user, "k": 4})
                answers.append(len(answer.json()["items"]))

    with served(trained.folder, "--threads", "1") as (_, address):
        clients = [threading.Thread(target=ask, args=(address,)) for _ in range(8)]
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
