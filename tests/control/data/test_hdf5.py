"""HDF5 files that reach outside themselves, or claim more than they hold."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.support.control_files import hopper_like, write_hdf5
from ucfrec.errors import InputError
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.hdf5 import require_inside


def linked(file: h5py.File, other: Path) -> None:
    file["rewards"] = h5py.ExternalLink(str(other), "rewards")


def soft(file: h5py.File, other: Path) -> None:
    file["rewards"] = h5py.SoftLink("/actions")


def stored_outside(file: h5py.File, other: Path) -> None:
    file.create_dataset("rewards", (14,), "f4", external=[(str(other), 0, 56)])


def virtual(file: h5py.File, other: Path) -> None:
    layout = h5py.VirtualLayout((14,), "f4")
    layout[:] = h5py.VirtualSource(str(other), "rewards", (14,))
    file.create_virtual_dataset("rewards", layout)


def huge(file: h5py.File, other: Path) -> None:
    file.create_dataset("rewards", (10**13,), "f4", chunks=(1024,), compression="gzip")


def huge_without_chunks(file: h5py.File, other: Path) -> None:
    file.create_dataset("rewards", (10**12,), "f4")


def group(file: h5py.File, other: Path) -> None:
    file.create_group("rewards")


def deep(file: h5py.File, other: Path) -> None:
    file["rewards"] = np.zeros((14, 1, 1), "f4")


def text(file: h5py.File, other: Path) -> None:
    file["rewards"] = ["a\nb"] * 14


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (linked, "rewards is a link to another file"),
        (soft, "rewards is a link to another name"),
        (stored_outside, "values of rewards lie in another file"),
        (virtual, "values of rewards lie in another file"),
        (huge, r"rewards claims the shape \(10000000000000,\), but only 0 bytes"),
        (huge_without_chunks, "rewards claims the shape"),
        (group, "rewards is a group"),
        (deep, "not 1 or 2 dimensions"),
        (text, "not numbers"),
    ],
)
def test_what_is_not_within_the_file_is_refused(
    tmp_path: Path, make: Callable[[h5py.File, Path], None], says: str
) -> None:
    other = write_hdf5(tmp_path / "other.hdf5", hopper_like())
    columns = hopper_like()
    del columns["rewards"]
    path = write_hdf5(tmp_path / "hopper.hdf5", columns)
    with h5py.File(path, "r+") as file:
        make(file, other)
    with pytest.raises(InputError, match=says) as caught:
        read_d4rl(path)
    assert "\n" not in str(caught.value)


def test_links_in_groups_are_found(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "hopper.hdf5", hopper_like())
    require_inside(path)
    with h5py.File(path, "r+") as file:
        file["infos/more"] = h5py.ExternalLink("/etc/passwd", "/")
    with pytest.raises(InputError, match="more is a link to another file"):
        require_inside(path)


def test_values_that_compress_well_are_read(tmp_path: Path) -> None:
    columns = hopper_like((1000,) * 50)
    columns["actions"][:] = 0
    path = tmp_path / "hopper.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=9)
        file.attrs["env_id"] = "Hopper-v5"
    assert len(read_d4rl(path).rewards) == 50_000
