"""Mappings of files and Python; public data sets: downloads, checksums, archives by hand."""

import hashlib
import io
import socket
import sys
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, LogMapping, Release, find_release, load_release, log_files

ROWS = b"user_id,item_id,timestamp,reward\n1,2,2024-05-01,1\n"


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder and the address at which its files are served."""
    folder = tmp_path / "served"
    folder.mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield folder, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


def archive(kind: str, name: str = "data/log.csv") -> bytes:
    file = io.BytesIO()
    if kind == "zip":
        with zipfile.ZipFile(file, "w") as content:
            content.writestr(name, ROWS)
        return file.getvalue()
    with tarfile.open(fileobj=file, mode="w:gz") as tar:
        member = tarfile.TarInfo(name)
        member.size = len(ROWS)
        tar.addfile(member, io.BytesIO(ROWS))
    return file.getvalue()


def dataset(url: str, content: bytes) -> Dataset:
    checksum = f"md5:{hashlib.md5(content).hexdigest()}"
    parts = {"all": "data", "other": "nowhere"}
    release = Release(url, "https://example.org", "CC0", checksum, len(content), parts)
    resolve = lambda paths, given: (log_files(paths), given.over(LogMapping(reward="reward")))  # noqa: E731
    return Dataset("a data set", resolve, {"sample": release})


@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_a_release_is_downloaded_verified_and_unpacked_once(
    served: tuple[Path, str], tmp_path: Path, kind: str
) -> None:
    folder, address = served
    content = archive(kind)
    (folder / f"sample.{kind}").write_bytes(content)
    given = dataset(f"{address}/sample.{kind}", content)
    logs = load_release("generic", given, "sample", tmp_path / "data")
    assert [file.read_bytes() for file in logs.files] == [ROWS]
    assert logs.mapping.reward == "reward"
    (folder / f"sample.{kind}").unlink()
    assert load_release("generic", given, "sample", tmp_path / "data") == logs
    with pytest.raises(InputError, match="has no part 'some'; it has all, other"):
        load_release("generic", given, "sample", tmp_path / "data", "some")
    with pytest.raises(InputError, match="nowhere is missing; delete"):
        load_release("generic", given, "sample", tmp_path / "data", "other")


def test_another_checksum_is_refused(served: tuple[Path, str], tmp_path: Path) -> None:
    folder, address = served
    (folder / "sample.zip").write_bytes(archive("zip") + b"more")
    given = dataset(f"{address}/sample.zip", archive("zip"))
    with pytest.raises(InputError, match=r"sample\.zip has changed: .*, then repeat this"):
        load_release("generic", given, "sample", tmp_path / "data")
    (tmp_path / "data" / "sample.zip").write_bytes(b"broken")
    with pytest.raises(InputError, match=r"has md5 .*, the release .*delete it"):
        load_release("generic", given, "sample", tmp_path / "data")
    assert not (tmp_path / "data" / "sample").exists()


def test_without_a_network_it_says_how_to_do_it_by_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/sample.zip"
    given, folder = dataset(url, archive("zip")), tmp_path / "data"
    with pytest.raises(InputError, match=f"cannot be downloaded .*download {url} .*repeat this"):
        load_release("generic", given, "sample", folder)
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(InputError, match=r"needs pooch; install ucfrec\[datasets\], or download"):
        load_release("generic", given, "sample", folder)
    (folder / "sample.zip").write_bytes(archive("zip"))  # as the message says
    assert load_release("generic", given, "sample", folder).files[0].read_bytes() == ROWS


def test_releases_have_names_and_no_file_that_leads_out_of_the_folder(
    tmp_path: Path,
) -> None:
    folder, content = tmp_path / "data", archive("tar.gz", "../escaped.csv")
    folder.mkdir()
    (folder / "sample.tar.gz").write_bytes(content)
    given = dataset("http://127.0.0.1:9/sample.tar.gz", content)
    with pytest.raises(tarfile.OutsideDestinationError):
        load_release("generic", given, "sample", folder)
    assert not (tmp_path / "escaped.csv").exists()
    assert not (folder / "sample").exists()
    assert find_release({"a": replace(given, releases={}), "b": given}, "sample") == "b"
    with pytest.raises(InputError, match="no data set is called 'x'; there are sample"):
        find_release({"b": given}, "x")
