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


def virtual(other: Path) -> h5py.VirtualLayout:
    layout = h5py.VirtualLayout((14,), "f4")
    layout[:] = h5py.VirtualSource(str(other), "rewards", (14,))
    return layout


CHUNKED = {"chunks": (1024,), "compression": "gzip"}
OUTSIDE = "values of rewards lie in another file"


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda file, other: file.update(rewards=h5py.ExternalLink(str(other), "rewards")),
            "rewards is a link to another file",
        ),
        (
            lambda file, _: file.update(rewards=h5py.SoftLink("/actions")),
            "rewards is a link to another name",
        ),
        (
            lambda file, other: file.create_dataset(
                "rewards", (14,), "f4", external=[(str(other), 0, 56)]
            ),
            OUTSIDE,
        ),
        (lambda file, other: file.create_virtual_dataset("rewards", virtual(other)), OUTSIDE),
        (
            lambda file, _: file.create_dataset("rewards", (10**13,), "f4", **CHUNKED),
            r"rewards claims the shape \(10000000000000,\), but only 0 bytes",
        ),
        (
            lambda file, _: file.create_dataset("rewards", (10**12,), "f4"),
            "rewards claims the shape",
        ),
        (lambda file, _: file.create_group("rewards"), "rewards is a group"),
        (
            lambda file, _: file.update(rewards=np.zeros((14, 1, 1), "f4")),
            "not 1 or 2 dimensions",
        ),
        (lambda file, _: file.update(rewards=["a\nb"] * 14), "not numbers"),
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
