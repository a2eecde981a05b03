"""Figures lie in the folder they are meant for, whatever they are of."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from ucfrec.reporting.plot_style import save


@pytest.mark.parametrize("name", ["scores-../../outside", "returns-hopper/mine-v0", "a\\b\n:c"])
def test_a_name_does_not_lead_out_of_the_folder(name: str, tmp_path: Path) -> None:
    files = save(Figure(), tmp_path / "figures", name)
    assert {file.suffix for file in files} == {".png", ".svg"}
    assert {file.parent for file in files} == {tmp_path / "figures"}
    assert sorted(tmp_path.rglob("*.*")) == sorted(files)
