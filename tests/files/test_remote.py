"""Logs and stores on object stores: a real one, moto's server, and one in memory."""

import argparse
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.remote import Input, Output, _opened, fetch, local_paths, uri_or_path
from ucfrec.logs.mapping import LogMapping, read_mapping
from ucfrec.logs.prepare import PrepareOptions, prepare

START = 1_700_000_000_000


def write_log(path: Path, seed: int = 0) -> Path:
    generator = np.random.default_rng(seed)
    log = pd.DataFrame({"user_id": generator.integers(9, size=200)})
    log["item_id"] = generator.integers(7, size=200)
    log["timestamp"] = START + np.arange(200) * 60_000 + seed
    log["reward"] = generator.integers(2, size=200)
    log.to_parquet(path)
    return path


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """URI of a bucket on a server of this machine."""
    server = pytest.importorskip("moto.server", reason="moto is not installed")
    from pyarrow import fs

    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        running.start()
        address = f"127.0.0.1:{running.get_host_and_port()[1]}"
        patch.setenv("AWS_ENDPOINT_URL", f"http://{address}")
        owner = fs.S3FileSystem(
            endpoint_override=address, scheme="http", allow_bucket_creation=True
        )
        owner.create_dir("logs")
        yield "s3://logs"
        running.stop()


@pytest.fixture(params=["bucket", "memory"])
def place(request: pytest.FixtureRequest) -> str:
    """URI of a folder that other tests do not use."""
    name = re.sub(r"\W", "-", request.node.name)
    if request.param == "bucket":
        return f"{request.getfixturevalue('bucket')}/{name}"
    pytest.importorskip("fsspec")
    return f"memory://{name}"


def put(file: Path, uri: str) -> None:
    with local_paths(argparse.Namespace(out=Output(uri))) as options:
        options.out.write_bytes(file.read_bytes())


def test_a_store_is_made_from_remote_logs_in_a_remote_place(
    tmp_path: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [write_log(tmp_path / f"{seed}.parquet", seed) for seed in (1, 2)]
    for file in files:
        put(file, f"{place}/logs/{file.name}")
    assert main(["prepare", f"{place}/logs/*.parquet", "--out", f"{place}/store"]) == 0
    assert f"store: {place}/store" in capsys.readouterr().out
    prepare(files, read_mapping(_empty(tmp_path)), tmp_path / "store")
    local = EpisodeStore.open(tmp_path / "store").record
    with local_paths(argparse.Namespace(store=Input(f"{place}/store"))) as options:
        found = EpisodeStore.open(options.store)
        assert found.record.fingerprint == local.fingerprint
        assert found.record.source.files == tuple(f"{place}/logs/{file.name}" for file in files)
        assert not list(found._columns._sealed.faults())
        copy = options.store
    assert not copy.exists()
    # A folder of logs; the store is there already.
    assert main(["prepare", f"{place}/logs", "--out", f"{place}/store"]) == 2
    assert f"{place}/store exists already" in capsys.readouterr().err


def _empty(folder: Path) -> Path:
    (folder / "mapping.toml").write_text("")
    return folder / "mapping.toml"


def test_errors_name_the_place_and_write_nothing(
    tmp_path: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1 nonsense")
    put(tmp_path / "bad.parquet", f"{place}/bad.parquet")
    assert main(["prepare", f"{place}/bad.parquet", "--out", f"{place}/store"]) == 2
    message = capsys.readouterr().err
    assert f"{place}/bad.parquet cannot be read" in message
    assert main(["prepare", f"{place}/none/x.parquet", "--validate"]) == 2
    assert f"{place}/none/x.parquet" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"has no file|cannot be used"):  # noqa: SIM117
        with local_paths(argparse.Namespace(store=Input(f"{place}/store"))):
            pass


def test_sizes_are_checked_before_anything_is_copied(
    tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(write_log(tmp_path / "log.parquet"), f"{place}/log.parquet")
    monkeypatch.setattr("shutil.disk_usage", lambda _: argparse.Namespace(free=1000))
    with pytest.raises(InputError, match=r"more than the 1,000 that are free"):  # noqa: SIM117
        with local_paths(argparse.Namespace(logs=[Input(f"{place}/log.parquet")])):
            pass


def test_only_the_command_line_names_places(tmp_path: Path, place: str) -> None:
    put(write_log(tmp_path / "log.parquet"), f"{place}/log.parquet")
    with pytest.raises(InputError, match="does not exist"):
        prepare([f"{place}/log.parquet"], read_mapping(_empty(tmp_path)), tmp_path / "store")
    mapping = tmp_path / "stranger.toml"
    mapping.write_text(
        f'[[item_features]]\nfiles = ["{place}/log.parquet"]\nkey = "item_id"\n', encoding="utf-8"
    )
    with pytest.raises(InputError, match="does not exist"):
        prepare([tmp_path / "log.parquet"], read_mapping(mapping), tmp_path / "store")
    assert uri_or_path(Input, Path)("a/b:c//d") == Path("a/b:c//d")
    assert isinstance(uri_or_path(Input, Path)("s3://a"), Input)


def test_an_unknown_kind_of_place_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", "nothing://x/y.parquet", "--validate"]) == 2
    message = capsys.readouterr().err
    assert "nothing://x/y.parquet cannot be used" in message
    assert message.count("\n") == 1


def on_disk(path: Path) -> int:
    """Bytes that a file takes, without its holes."""
    return path.stat().st_blocks * 512


def test_only_columns_that_are_read_are_copied_from_logs(tmp_path: Path, place: str) -> None:
    log = pd.read_parquet(write_log(tmp_path / "log.parquet"))
    log = pd.concat([log] * 20, ignore_index=True)
    log["timestamp"] += np.arange(len(log))
    generator = np.random.default_rng(0)
    log["reward.more"] = generator.normal(size=len(log))
    log["long"] = list(generator.normal(size=(len(log), 100)))
    log.to_parquet(tmp_path / "log.parquet", row_group_size=1000)
    put(tmp_path / "log.parquet", f"{place}/log.parquet")
    options = PrepareOptions(reward='reward * 2 + "reward.more"', session_by="user")
    prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / "local", options)
    with local_paths(argparse.Namespace(log=Input(f"{place}/log.parquet"))) as given:
        size = given.log.stat().st_size
        assert size == (tmp_path / "log.parquet").stat().st_size > 2e6
        assert on_disk(given.log) < 0.1 * size
        prepare([given.log], LogMapping(), tmp_path / "store", options)
        assert on_disk(given.log) < 0.2 * size
        fetch(given.log)
        assert given.log.read_bytes() == (tmp_path / "log.parquet").read_bytes()
    stores = [EpisodeStore.open(tmp_path / name).record.fingerprint for name in ("local", "store")]
    assert stores[0] == stores[1]


def test_only_columns_that_are_read_are_copied_from_a_store(tmp_path: Path, place: str) -> None:
    n = 300_000
    rewards = np.random.default_rng(0).normal(size=n).astype(np.float32)
    steps = {"reward": rewards, "item": np.zeros(n), "timestamp": np.arange(n)}
    EpisodeStore.write(tmp_path / "store", steps, np.full(n // 10, 10), shard_steps=n // 2)
    with local_paths(argparse.Namespace(out=Output(f"{place}/store"))) as options:
        shutil.copytree(tmp_path / "store", options.out)
    with local_paths(argparse.Namespace(store=Input(f"{place}/store"))) as options:
        store = EpisodeStore.open(options.store)
        np.testing.assert_array_equal(store.step_values("reward", *store.all_steps()), rewards)
        for number in range(2):
            shard = options.store / f"shard-0000{number}"
            assert on_disk(shard / "timestamp.npy") == 0
            assert on_disk(shard / "reward.npy") >= 4 * n // 2
    # A column is checked when it is read.
    file = tmp_path / "store" / "shard-00001" / "timestamp.npy"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    put(file, f"{place}/store/shard-00001/timestamp.npy")

    def first(column: str) -> float:
        with local_paths(argparse.Namespace(store=Input(f"{place}/store"))) as options:
            store = EpisodeStore.open(options.store)
            return float(store.step_values(column, np.array([0]), np.array([0]))[0])

    assert first("reward") == rewards[0]
    with pytest.raises(InputError, match=f"{place}/store/shard-00001/timestamp.npy has another"):
        first("timestamp")


def test_a_file_that_changes_meanwhile_is_an_error(tmp_path: Path, place: str) -> None:
    log = pd.DataFrame({"a": np.random.default_rng(0).normal(size=200_000)})
    log.to_parquet(tmp_path / "log.parquet")
    put(tmp_path / "log.parquet", f"{place}/log.parquet")
    with local_paths(argparse.Namespace(log=Input(f"{place}/log.parquet"))) as options:
        pd.concat([log, log]).to_parquet(tmp_path / "log.parquet")
        system, path = _opened(f"{place}/log.parquet")
        with system.open_output_stream(path) as out:
            out.write((tmp_path / "log.parquet").read_bytes())
        with pytest.raises(InputError, match="changed while it was read"):
            fetch(options.log, ["a"])
