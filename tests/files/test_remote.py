"""Logs and stores on object stores: a real one, moto's server, and one in memory."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.logs import random_log, write
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.remote import Input, Output, _open, local_paths, uri_or_path
from ucfrec.logs.mapping import LogMapping, read_mapping
from ucfrec.logs.prepare import prepare


def write_log(path: Path, later: int = 0) -> Path:
    log = random_log(200, users=9, items=7)
    return write(log.assign(timestamp=log.timestamp + later), path)


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
        more = {"scheme": "http", "allow_bucket_creation": True}
        fs.S3FileSystem(endpoint_override=address, **more).create_dir("logs")
        yield "s3://logs"
        running.stop()


@pytest.fixture(params=["bucket", "memory"])
def place(request: pytest.FixtureRequest) -> str:
    """URI of a folder that other tests do not use."""
    name = re.sub(r"\W", "-", request.node.name)
    if request.param == "bucket":
        return f"{request.getfixturevalue('bucket')}/{name}"
    return f"memory://{name}"


def refused(uri: str, says: str) -> None:
    with pytest.raises(InputError, match=says):  # noqa: SIM117
        with local_paths(argparse.Namespace(logs=[Input(uri)])):
            raise AssertionError("the block must not run")


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
    prepare(files, LogMapping(), tmp_path / "store")
    local = EpisodeStore.open(tmp_path / "store").record
    with local_paths(argparse.Namespace(store=Input(f"{place}/store"))) as options:
        found = EpisodeStore.open(options.store)
        assert found.record.fingerprint == local.fingerprint
        assert found.record.source.files == tuple(f"{place}/logs/{file.name}" for file in files)
        assert not list(found.record.faults(options.store))
        copy = options.store
    assert not copy.exists()
    # A folder of logs; the store is there already.
    assert main(["prepare", f"{place}/logs", "--out", f"{place}/store"]) == 2
    assert f"{place}/store exists already" in capsys.readouterr().err


def test_errors_name_the_place_and_write_nothing(
    tmp_path: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1 nonsense")
    put(tmp_path / "bad.parquet", f"{place}/bad.parquet")
    assert main(["prepare", f"{place}/bad.parquet", "--out", f"{place}/store"]) == 2
    assert f"{place}/bad.parquet cannot be read" in capsys.readouterr().err
    assert main(["prepare", f"{place}/none/x.parquet", "--validate"]) == 2
    assert f"{place}/none/x.parquet" in capsys.readouterr().err
    refused(f"{place}/store", r"has no file|cannot be used")


def test_sizes_are_checked_before_anything_is_copied(
    tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(write_log(tmp_path / "log.parquet"), f"{place}/log.parquet")
    monkeypatch.setattr("shutil.disk_usage", lambda _: argparse.Namespace(free=1000))
    refused(f"{place}/log.parquet", r"more than the 1,000 that are free")


def test_only_the_command_line_names_places(tmp_path: Path, place: str) -> None:
    put(write_log(tmp_path / "log.parquet"), f"{place}/log.parquet")
    with pytest.raises(InputError, match="does not exist"):
        prepare([f"{place}/log.parquet"], LogMapping(), tmp_path / "store")
    mapping = tmp_path / "stranger.toml"
    mapping.write_text(f'[[item_features]]\nfiles = ["{place}/log.parquet"]\nkey = "item_id"\n')
    with pytest.raises(InputError, match="does not exist"):
        prepare([tmp_path / "log.parquet"], read_mapping(mapping), tmp_path / "store")
    assert uri_or_path(Input, Path)("a/b:c//d") == Path("a/b:c//d")
    assert isinstance(uri_or_path(Input, Path)("s3://a"), Input)


def test_an_unknown_kind_of_place_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", "nothing://x/y.parquet", "--validate"]) == 2
    message = capsys.readouterr().err
    assert "nothing://x/y.parquet cannot be used" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("name", ["a\\b.parquet", "..\\b.parquet", "c:b.parquet"])
def test_a_name_that_would_lead_out_of_the_folder_is_refused(name: str) -> None:
    system, folder = _open("memory://names-that-lead-out")
    with system.open(f"{folder}/{name}", "wb") as out:
        out.write(b"1")
    refused("memory://names-that-lead-out", "has a file named")
    system.rm(folder, recursive=True)


def test_a_file_that_changes_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(write_log(tmp_path / "log.parquet"), "memory://changing/log.parquet")
    system, _ = _open("memory://changing")
    found = system.find("/changing", detail=True)
    grown = {name: {**about, "size": about["size"] + 1} for name, about in found.items()}
    monkeypatch.setattr(type(system), "find", lambda *_, **__: grown)
    refused("memory://changing/log.parquet", "changed while it was read")
