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
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.support import light_workers
from tests.test_processes import ended
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.recommending.server import Server, Workers, listening_socket, server_config
from ucfrec.runs.trained_policy import TrainedPolicy

httpx = pytest.importorskip("httpx")
pytest.importorskip("uvicorn")
pytest.importorskip("fastapi_offline")


Process = subprocess.Popen[str]
looks_into_proc = pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks into /proc")


@contextmanager
def started(*command: str, **named: Any) -> Iterator[tuple[Process, str]]:
    """A process of Python, and its first line."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-m", *command], **pipes, **named) as process:
        try:
            yield process, process.stdout.readline()  # type: ignore[union-attr]
        finally:
            process.kill()


@contextmanager
def served(run: Path, *options: str) -> Iterator[tuple[Process, str]]:
    """A server process and its address."""
    command = ("ucfrec.commands.cli", "serve", str(run), "--port", "0", *options)
    with started(*command) as (process, ready):
        assert "ready at http://127.0.0.1:" in ready
        yield process, ready.split("ready at ")[1].split()[0]


def test_two_runs_share_the_users_and_hup_writes_the_exposures_of_every_answer(
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
        process.send_signal(signal.SIGHUP)  # as a terminal that is closed
        _, errors = process.communicate(timeout=60)
        assert (process.returncode, errors) == (0, "ucfrec serve: stopped\n")
    assert {answer["arm"] for answer in answers} == {"a", "b"}
    shown = pd.concat(map(pd.read_parquet, folder.iterdir()))
    names = ["user_id", "arm", "request_id", "position", "item_id", "propensity"]
    expected = [
        (str(a["user_id"]), a["arm"], a["request_id"], position, i["item_id"], i["propensity"])
        for a in answers
        for position, i in enumerate(a["items"], 1)
    ]
    assert sorted(shown[names].itertuples(index=False, name=None)) == sorted(expected)


def wait_for(what: Any, seconds: float = 60) -> None:
    """Return once a function returns something true."""
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.05)


def connected(address: str, timeout: float) -> socket.socket:
    host, port = address.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=timeout)


def answers_of(address: str, sent: bytes) -> bytes:
    """What the server sends until it closes the connection."""
    answer = b""
    with connected(address, 60) as connection:
        with suppress(ConnectionError):  # it may close before all is sent
            connection.sendall(sent)
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
        before, many = resident(process.pid), (head() + head(what=b"GET /nowhere")) * 10_000
        with connected(address, 0.5) as flood:
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


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        *(("allowed-hosts", given, "is not a host") for given in ("a*", "http://a", "", "a:80")),
        pytest.param(
            "exposures", "/proc/self", "/proc/self cannot be written", marks=looks_into_proc
        ),
    ],
)
def test_options_that_say_nothing_are_refused(
    trained: TrainedPolicy, capfd: pytest.CaptureFixture[str], option: str, value: str, said: str
) -> None:
    assert main(["serve", str(trained.folder), "--port", "0", f"--{option}", value]) == 2
    assert said in capfd.readouterr().err


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


# Connections that ask nothing, or take no answer, end; others are not too many.

TAKEN = 0.5


async def sizes(scope: Any, receive: Any, send: Any) -> None:
    """Answers so many bytes as the path says, once the whole request is there."""
    while (await receive()).get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 200})
    await send({"type": "http.response.body", "body": b"a" * int(scope["path"][1:])})


@pytest.fixture
def small() -> Iterator[tuple[Server, int]]:
    """A server of five connections, three of each address, that take so long; and its port."""
    ready = threading.Event()
    server = Server(server_config(sizes, TAKEN, 5, 3, lifespan="off"), lambda _: ready.set())
    with listening_socket("127.0.0.1", 0) as listening:
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        assert ready.wait(20)
        yield server, listening.getsockname()[1]
        server.should_exit = server.force_exit = True
        thread.join()


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        head()[:-4],
        head(what=b"GET /3") + head()[:-4],
        head(b"Content-Length: 9", what=b"POST /3") + b"abc",
        head(what=b"GET /100000000"),
    ],
)
def test_clients_that_take_too_long_are_cut_off(small: tuple[Server, int], sent: bytes) -> None:
    server, port = small
    began = time.monotonic()
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(sent)
        wait_for(lambda: server.server_state.connections, 5)
        wait_for(lambda: not server.server_state.connections, 5)
        assert TAKEN <= time.monotonic() - began < 5 * TAKEN


def test_connections_of_an_address_and_in_all_are_limited(small: tuple[Server, int]) -> None:
    _, port = small
    with ExitStack() as stack:
        clients = [
            stack.enter_context(
                socket.create_connection(("127.0.0.1", port), 9, (f"127.0.0.{number}", 0))
            )
            for number in (1, 1, 1, 1, 2, 2, 2)
        ]
        answers = [client.recv(12) for client in clients]
    refused = b"HTTP/1.1 503"
    assert answers == [b"", b"", b"", refused, b"", b"", refused]
    assert b"aaa" in answers_of(f"http://127.0.0.1:{port}", head(CLOSE, what=b"GET /3"))


# Several processes on one address: they are replaced, ended in order, and outlive no parent.


def workers_of(parent: int) -> set[int]:
    """Numbers of the processes that answer, without multiprocessing's tracker of resources."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    commands = {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    return {child for child, command in commands.items() if b"spawn_main" in command}


@contextmanager
def light(work: str, **environment: str) -> Iterator[tuple[Process, int]]:
    """A parent of two light workers, and their port."""
    place = {"env": os.environ | environment, "cwd": Path(__file__).parents[2]}
    command = ("tests.support.light_workers", work)
    with started(*command, **place, start_new_session=True) as (process, ready):
        yield process, int(ready.split()[-1])


def answered_by(port: int) -> int:
    """Which process answers."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        return int(client.recv(100))


@looks_into_proc
def test_a_worker_that_ends_is_replaced_and_the_address_stays() -> None:
    with light("answer") as (process, port):
        first, other = workers_of(process.pid)
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: answered_by(port) not in (first, other))
        assert other in workers_of(process.pid)
        process.send_signal(signal.SIGTERM)
        printed, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert printed == "in order\nin order\n"
    assert f"worker {first} ended with status -9; another worker starts now\n" in errors


@looks_into_proc
def test_ctrl_c_reaches_workers_by_their_parent_and_a_second_one_hurries_them() -> None:
    with light("answer") as (process, _):
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        time.sleep(0.3)
        os.killpg(process.pid, signal.SIGINT)
        printed, errors = process.communicate(timeout=60)
    assert (printed, errors) == ("forced\nforced\n", "")


@looks_into_proc
def test_workers_end_in_order_when_their_parent_is_killed(tmp_path: Path) -> None:
    with light("answer", TMPDIR=str(tmp_path)) as (process, _):  # it leaves a folder there
        workers = workers_of(process.pid)
        process.kill()
        printed, errors = process.communicate(timeout=60)  # the workers hold stdout until they end
        assert all(ended(worker) for worker in workers)
    assert (printed, errors) == ("in order\nin order\n", "")


@looks_into_proc
def test_workers_that_cannot_start_leave_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with (
        pytest.raises(InputError, match="no model"),
        listening_socket("127.0.0.1", 0) as listening,
        Workers(light_workers.refuse, listening) as workers,
    ):
        workers.start(3)
    assert capfd.readouterr() == ("", "")
    assert not workers_of(os.getpid())


@looks_into_proc
def test_others_go_on_without_a_worker_that_cannot_be_replaced(tmp_path: Path) -> None:
    with light("refuse_later", LIGHT_WORKERS=str(tmp_path)) as (process, port):
        first, other = workers_of(process.pid)
        os.kill(first, signal.SIGKILL)
        assert "another worker starts now" in process.stderr.readline()
        assert "no model; another worker starts in 10 s" in process.stderr.readline()
        assert answered_by(port) == other
        os.kill(other, signal.SIGKILL)
        assert "another worker starts now" in process.stderr.readline()
        assert process.stderr.read().endswith("InputError: no model\n")


@pytest.fixture(scope="module")
def two(
    trained: TrainedPolicy, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Process, str, Path]]:
    """A server of two workers that follows the promoted run of a folder and writes exposures."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("monday", "tuesday"):
        shutil.copytree(trained.folder, folder / name)
    assert main(["promote", str(folder / "monday")]) == 0
    options = ("--workers", "2", "--temperature", "2", "--exposures", str(folder / "shown"))
    with served(folder, *options) as (process, address):
        yield process, address, folder


@contextmanager
def only(worker: int, process: Process) -> Iterator[None]:
    """The other workers answer nothing."""
    others = workers_of(process.pid) - {worker}
    for other in others:
        os.kill(other, signal.SIGSTOP)
    try:
        yield
    finally:
        for other in others:
            os.kill(other, signal.SIGCONT)


def ask(address: str, user: int) -> dict[str, Any]:
    """An answer, on a connection of its own."""
    row = {"item_id": 0, "timestamp": 1_700_000_000_000, "reward": 1.0}
    body = {"user_id": user, "k": 2, "history": [row]}
    answer = httpx.post(f"{address}/recommendations", json=body, timeout=60)
    assert answer.status_code == 200
    return dict(answer.json())


def metrics_of(address: str) -> dict[str, float]:
    """Values of the metrics by name and labels."""
    lines = httpx.get(f"{address}/metrics", timeout=60).text.splitlines()
    pairs = (line.rpartition(" ") for line in lines if not line.startswith("#"))
    return {name: float(value) for name, _, value in pairs}


@looks_into_proc
def test_metrics_are_totals_also_of_workers_gone(two: tuple[Process, str, Path]) -> None:
    process, address, _ = two
    first, other = workers_of(process.pid)
    before = metrics_of(address).get('ucfrec_requests_total{status="200"}', 0.0)
    for worker, users in ((first, [100] * 3), (other, [100_000])):
        with only(worker, process):
            for user in users:
                ask(address, user)
    for worker in (first, other):
        with only(worker, process):
            found = metrics_of(address)
        assert found['ucfrec_requests_total{status="200"}'] == before + 4
        assert found["ucfrec_request_seconds_count"] == before + 4
        assert found["ucfrec_batch_requests_sum"] == before + 4
        assert found['ucfrec_drift{measure="unknown_users"}'] == 1 / 4
        assert found["process_cpu_seconds_total"] > 1
        assert not any("pid=" in name for name in found)
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: len(workers_of(process.pid) - {first, other}) == 1)
    (new,) = workers_of(process.pid) - {first, other}
    with only(new, process):
        ask(address, 100)
        found = metrics_of(address)
    assert found['ucfrec_requests_total{status="200"}'] == before + 5
    assert found['ucfrec_drift{measure="unknown_users"}'] == 1 / 2  # of the living


@looks_into_proc
def test_every_worker_follows_the_promoted_run(two: tuple[Process, str, Path]) -> None:
    process, address, folder = two
    assert main(["promote", str(folder / "tuesday"), "--force"]) == 0
    for worker in workers_of(process.pid):
        with only(worker, process):
            wait_for(lambda: httpx.get(f"{address}/health", timeout=60).json()["name"] == "tuesday")


@looks_into_proc
def test_term_ends_workers_after_their_requests(two: tuple[Process, str, Path]) -> None:
    process, address, folder = two
    workers = workers_of(process.pid)
    answers = []
    for worker in workers:
        with only(worker, process):
            answers += [ask(address, user) for user in range(4)]
    with connected(address, 60) as slow:
        body = b'{"user_id": 1, "k": 3}'
        slow.sendall(head(b"Content-Length: 22", what=b"POST /recommendations") + body[:5])
        ask(address, 1)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
        slow.sendall(body[5:])
        with slow.makefile("rb") as received:
            assert received.readline() == b"HTTP/1.1 200 OK\r\n"
        errors = process.stderr.read()
        assert process.wait(60) == 0
    assert errors.endswith("ucfrec serve: stopped\n")
    assert errors.count("stopped") == 1
    assert all(ended(worker) for worker in workers)
    files = list((folder / "shown").iterdir())
    assert len(files) == len(workers)
    shown = pd.concat(map(pd.read_parquet, files))
    assert {answer["request_id"] for answer in answers} <= set(shown["request_id"])
