"""The demo, made small: every row there, in order, and resumed rather than repeated."""

import json
from pathlib import Path

import pytest

from ucfrec.commands.demo import BEHAVIORS, LEARNERS, WORLDS, DemoConfig, demo

TINY = DemoConfig(
    sessions=400,
    episodes=200,
    settings=("train.steps=20", "crm.epochs=1"),
    context=4,
    dim=16,
)


def test_the_demo_writes_every_row_and_goes_on_where_it_was(tmp_path: Path) -> None:
    rows = demo(tmp_path / "demo", seed=0, config=TINY)
    written = json.loads((tmp_path / "demo" / "results.json").read_text())
    names = {*LEARNERS, *BEHAVIORS}
    assert names == {"logging", "random", "bc", "dt", "ucf-no-augmentation", "ucf", "optimal"}
    for world in WORLDS:
        of_world = {row["policy"]: row for row in written if row["world"] == world}
        assert of_world.keys() == names
        assert max(of_world.values(), key=lambda row: row["R_cum"])["policy"] == "optimal"
        for row in of_world.values():
            assert row["R_cum_low"] <= row["R_cum"] <= row["R_cum_high"]
            assert row["R_avg_pooled"] == pytest.approx(row["R_cum"] / row["length"])
            assert {"command", "versions", "fingerprint", "config"} <= row.keys()
    page = (tmp_path / "demo" / "report.html").read_text()
    for world in WORLDS:
        assert f"R_cum in {world}" in page
        assert all(f"<summary>{world}/{learner}</summary>" in page for learner in LEARNERS)
    weights = tmp_path / "demo" / WORLDS[0] / "dt" / "policy" / "best.safetensors"
    written_at = weights.stat().st_mtime_ns
    again = demo(tmp_path / "demo", seed=0, config=TINY)
    assert weights.stat().st_mtime_ns == written_at
    assert [row["R_cum"] for row in again] == [row["R_cum"] for row in rows]
